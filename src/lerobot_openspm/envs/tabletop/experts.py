"""Scripted experts for the ten tasks, and so for those that are made of them.

They read the true poses and act by the same 7-D actions.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.envs.motions import (
    DOWN,
    Actions,
    Pace,
    ScriptedHand,
    in_world,
    pointing_down,
    yaw_matrix,
)
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.simulator import MAX_STEP_M, MAX_STEP_RAD, TabletopSimulator
from lerobot_openspm.envs.tabletop.tasks import ANY_TASK, SUCCESS_HOLD_STEPS, TASKS
from lerobot_openspm.geometry.se3 import transform, yaw_of

TabletopHand = ScriptedHand[TabletopSimulator]

PACE = Pace(
    MAX_STEP_M, MAX_STEP_RAD, closing_steps=(7, 11), opening_steps=(7, 11), asked_m=MAX_STEP_M,
    asked_rad=MAX_STEP_RAD,
)  # fmt: skip
# Fingers pointing along -x with the camera above: the hand at home, turned by 90 degrees about y.
LEVEL = Rotation.from_euler("y", 90, degrees=True).as_matrix() @ DOWN

HOVER_Z = 0.21
CARRY_Z = 0.26
BOWL_GRASP = np.array([0.0, scene.BOWL_RADIUS - scene.BOWL_WALL / 2, 0.040])
GRASP_Z = {"box": 0.020, "bottle": 0.140}
RELEASE_GAP = 0.003
RETREAT_RISE = 0.12
# How high the underside of a carried object crosses the table: above the bottle, or above bowl and rack.
TRANSIT_Z = {"bowl": 0.175, "box": 0.175, "bottle": 0.095}
DRAWER_PULL = {"drawer_middle": 0.135, "drawer_top": 0.152}
KNOB_TURN = math.radians(98)
KNOB_GRASP_Z = 0.053
# In the cabinet's frame: beside the middle, so that the outer finger finds room in the drawer when it opens.
BOWL_IN_DRAWER_Y = -0.028
# Fingertips level with the rim: there is no room to open them inside the bowl.
BOX_DROP = scene.BOWL_HEIGHT + scene.FINGERTIP_BEYOND_EE - GRASP_Z["box"] - RELEASE_GAP
PLATE_INNER = scene.PLATE_RADIUS - scene.PLATE_RIM_WIDTH - 0.010
FINAL_HOLD_STEPS = 15


def expert_actions(
    simulator: TabletopSimulator,
    task: str,
    rng: np.random.Generator,
    operator: type[TabletopHand] = ScriptedHand,
) -> Actions:
    """Yield the actions that solve `task` from the simulator's present state.

    Step the environment with each action before asking for the next one.

    Args:
        simulator: Simulator of the environment that is stepped.
        task: A name in `ANY_TASK`.
        rng: Source of the demonstration's imperfections.
        operator: Who leads the hand.

    Raises:
        ValueError: No expert does it, as none of `COMBINATION_TASKS`.
    """
    parts = ANY_TASK[task].parts or (task,)
    if unknown := [part for part in parts if part not in EXPERTS]:
        raise ValueError(f"there is no expert for {', '.join(unknown)}, which is never demonstrated")
    hand = operator(simulator, rng, PACE)
    for i, part in enumerate(parts):
        if i > 0:
            # Back up to where every task begins, clear of all that stands on the table.
            hand.closing = False
            yield from hand.retreat(scene.HOME_POSITION[2] - float(simulator.ee_pose()[2, 3]))
        yield from EXPERTS[part](hand)
    yield from hand.hold(FINAL_HOLD_STEPS)


def expert_solves(simulator: TabletopSimulator, task: str) -> bool:
    """Whether the expert does a task in the simulator's present scene, which it leaves changed."""
    held = 0
    for action in expert_actions(simulator, task, np.random.default_rng(0)):
        simulator.apply(action)
        if simulator.is_unstable():
            return False
        held = held + 1 if ANY_TASK[task].is_done(simulator) else 0
        if held >= SUCCESS_HOLD_STEPS:
            return True
    return False


@dataclass(frozen=True)
class Put:
    """What to pick up, how high to lift it, and the point of which object's frame its origin goes to."""

    name: str
    carry_z: float
    support: str
    goal: tuple[float, float, float]


def _put(put: Put, hand: TabletopHand) -> Actions:
    yield from _pick(hand, put.name, put.carry_z)
    yield from _place(hand, put.name, in_world(hand.frame(put.support), put.goal))


def _pick(hand: TabletopHand, name: str, carry_z: float) -> Actions:
    """Grasp an object from above and lift it until the hand is at `carry_z`."""
    T_world_obj, yaw = hand.frame(name), 0.0
    if name == "bowl":
        # Always the same side of the world: the bowl looks alike from everywhere, its yaw cannot be followed.
        grasp = T_world_obj[:3, 3] + BOWL_GRASP
    else:
        grasp = _at_height(T_world_obj[:3, 3], GRASP_Z[name])
    if name == "box":
        # Half a turn of the box looks the same: take the smaller turn of the hand.
        yaw = math.remainder(yaw_of(T_world_obj), math.pi)
    offset, turn = hand.grasp_noise()
    grasp, yaw = grasp + offset, yaw + turn
    yield from hand.travel(pointing_down(_at_height(grasp, max(HOVER_Z, grasp[2] + 0.07)), yaw))
    yield from hand.advance(pointing_down(grasp, yaw))
    yield from hand.grip(closing=True)
    yield from hand.travel(pointing_down(_at_height(grasp, carry_z), yaw))


def _place(hand: TabletopHand, name: str, goal: np.ndarray) -> Actions:
    """Put the grasped object's origin at a world point (3,), let go and retreat upwards."""
    release = goal + hand.grasp_noise()[0] + np.array([0.0, 0.0, RELEASE_GAP])
    approach = max(0.05, TRANSIT_Z[name] - release[2])
    yield from hand.travel(_carried(hand, name, release + np.array([0.0, 0.0, approach])))
    yield from hand.advance(_carried(hand, name, release))
    yield from hand.grip(closing=False)
    yield from hand.retreat(RETREAT_RISE)


def _carried(hand: TabletopHand, name: str, goal: np.ndarray) -> np.ndarray:
    """T_world_ee that brings the grasped object to a world point (3,), the hand keeping its yaw."""
    T_world_ee = hand.simulator.ee_pose()
    return pointing_down(T_world_ee[:3, 3] + goal - hand.origin(name), float(yaw_of(T_world_ee)))


def _at_height(point: np.ndarray, z: float) -> np.ndarray:
    return np.array([point[0], point[1], z])


def _open_drawer(name: str, hand: TabletopHand) -> Actions:
    """Take the handle from the front with a level hand, pull along the drawer's axis, let go and back off."""
    cabinet = hand.frame("cabinet")
    offset, turn = hand.grasp_noise()
    rotation = yaw_matrix(float(yaw_of(cabinet)) + turn) @ LEVEL
    height = scene.handle_height(scene.DRAWER_NAMES.index(name)) + float(offset[0])
    bar = scene.HANDLE_X + float(offset[1])

    def at(x: float, z: float) -> np.ndarray:
        return transform(rotation, in_world(cabinet, (x, 0.0, z)))

    yield from hand.travel(at(bar + 0.10, height + 0.16))
    yield from hand.travel(at(bar + 0.08, height))
    yield from hand.advance(at(bar, height))
    yield from hand.grip(closing=True)
    yield from hand.advance(at(bar + DRAWER_PULL[name], height), slowness=0.8)
    yield from hand.grip(closing=False)
    yield from hand.travel(at(bar + DRAWER_PULL[name] + 0.07, height))


def _bowl_in_top_drawer(hand: TabletopHand) -> Actions:
    yield from _open_drawer("drawer_top", hand)
    yield from hand.retreat(0.10)
    yield from _pick(hand, "bowl", carry_z=0.32)
    front = scene.CABINET_HALF[0] + hand.simulator.joint_position("drawer_top")
    middle = (scene.CABINET_HALF[0] + front) / 2
    goal = (middle, BOWL_IN_DRAWER_Y, scene.drawer_height(2) + 0.008)
    yield from _place(hand, "bowl", in_world(hand.frame("cabinet"), goal))


def _push_plate(hand: TabletopHand) -> Actions:
    """Lower the closed fingers into the plate and drag it by its inner rim; it centres itself behind them."""
    goal = in_world(hand.frame("stove"), (scene.PLATE_GOAL_X, 0, 0))[:2]
    plate = hand.origin("plate")[:2]
    way = (goal - plate) / np.linalg.norm(goal - plate)
    z = scene.PLATE_FLOOR + scene.FINGERTIP_BEYOND_EE + 0.003
    hand.closing = True
    start = np.append(plate + way * 0.03, z) + hand.grasp_noise()[0]
    yield from hand.travel(pointing_down(_at_height(start, 0.12)))
    yield from hand.advance(pointing_down(start))
    yield from hand.advance(pointing_down(np.append(goal + way * PLATE_INNER, z)), slowness=0.6)
    for _ in range(3):
        short = float((goal - hand.origin("plate")[:2]) @ way)
        if short < 0.008:
            break
        ee = hand.simulator.ee_pose()[:2, 3]
        yield from hand.advance(pointing_down(np.append(ee + way * short, z)), slowness=0.4)
    yield from hand.retreat(RETREAT_RISE)


def _turn_on_stove(hand: TabletopHand) -> Actions:
    stove = hand.frame("stove")
    offset, turn = hand.grasp_noise()
    grasp = in_world(stove, (scene.KNOB_X, 0, KNOB_GRASP_Z)) + offset
    yaw = float(yaw_of(stove)) + turn
    yield from hand.travel(pointing_down(_at_height(grasp, 0.15), yaw))
    yield from hand.advance(pointing_down(grasp, yaw))
    yield from hand.grip(closing=True)
    yield from hand.advance(pointing_down(grasp, yaw + KNOB_TURN), slowness=0.8)
    yield from hand.grip(closing=False)
    yield from hand.retreat(RETREAT_RISE)


_CABINET_TOP = (0, 0, scene.CABINET_HEIGHT)
_PUTS = {
    "bowl_on_plate": Put("bowl", CARRY_Z, "plate", (0, 0, scene.PLATE_FLOOR)),
    "bowl_on_stove": Put("bowl", CARRY_Z, "stove", (scene.BURNER_X, 0, scene.BURNER_TOP)),
    "bowl_on_cabinet": Put("bowl", scene.CABINET_HEIGHT + 0.12, "cabinet", _CABINET_TOP),
    "box_in_bowl": Put("box", CARRY_Z, "bowl", (0, 0, BOX_DROP)),
    "bottle_on_cabinet": Put(
        "bottle", GRASP_Z["bottle"] + scene.CABINET_HEIGHT + 0.06, "cabinet", _CABINET_TOP
    ),
    "bottle_on_rack": Put("bottle", GRASP_Z["bottle"] + 0.13, "rack", (0, 0, scene.RACK_SHELF_HEIGHT)),
}
EXPERTS: dict[str, Callable[[TabletopHand], Actions]] = {
    **{task: partial(_put, put) for task, put in _PUTS.items()},
    "open_middle_drawer": partial(_open_drawer, "drawer_middle"),
    "bowl_in_top_drawer": _bowl_in_top_drawer,
    "push_plate": _push_plate,
    "turn_on_stove": _turn_on_stove,
}
if set(EXPERTS) != set(TASKS):
    raise RuntimeError(f"tasks without an expert: {set(TASKS) ^ set(EXPERTS)}")
