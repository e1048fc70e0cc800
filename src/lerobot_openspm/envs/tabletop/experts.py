"""Scripted experts for the ten tasks, and so for those that are made of them.

They read the true poses and act by the same 7-D actions.
"""

import math
from collections.abc import Callable

import numpy as np

from lerobot_openspm.envs.motions import (
    LEVEL_ROTATION,
    TABLETOP_PACE,
    Actions,
    ScriptedHand,
    pointing_down,
    pose,
    yaw_matrix,
)
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.simulator import TabletopSimulator
from lerobot_openspm.envs.tabletop.tasks import ANY_TASK, TASKS

HOVER_Z = 0.21
CARRY_Z = 0.26
BOWL_GRASP = np.array([0.0, scene.BOWL_RADIUS - scene.BOWL_WALL / 2, 0.040])
BOX_GRASP_Z = 0.020
BOTTLE_GRASP_Z = 0.140
RELEASE_GAP = 0.003
# How high the underside of a carried object crosses the table: above the bottle, or above bowl and rack.
TRANSIT_Z = {"bowl": 0.175, "box": 0.175, "bottle": 0.095}
DRAWER_PULL = {"drawer_middle": 0.135, "drawer_top": 0.152}
KNOB_TURN = math.radians(98)
KNOB_GRASP_Z = 0.053
# In the cabinet's frame: beside the middle, so that the outer finger finds room in the drawer when it opens.
BOWL_IN_DRAWER_Y = -0.028
PLATE_INNER = scene.PLATE_RADIUS - scene.PLATE_RIM_WIDTH - 0.010
FINAL_HOLD_STEPS = 15


def expert_actions(
    simulator: TabletopSimulator,
    task: str,
    rng: np.random.Generator,
    operator: type[ScriptedHand[TabletopSimulator]] = ScriptedHand,
) -> Actions:
    """Yield the actions that solve `task` from the simulator's present state.

    Step the environment with each action before asking for the next one.

    Args:
        simulator: Simulator of the environment that is stepped.
        task: A name in `ANY_TASK`.
        rng: Source of the demonstration's imperfections.
        operator: Who leads the hand.
    """
    hand = operator(simulator, rng, TABLETOP_PACE)
    for i, part in enumerate(ANY_TASK[task].parts or (task,)):
        if i > 0:
            hand.closing = False
            yield from _rise(hand)
        yield from EXPERTS[part](hand)
    yield from hand.hold(FINAL_HOLD_STEPS)


def _rise(hand: ScriptedHand) -> Actions:
    """Up to where every task begins, clear of all that stands on the table."""
    T_world_ee = hand.simulator.ee_pose()
    yield from _retreat(hand, scene.HOME_POSITION[2] - float(T_world_ee[2, 3]))


def _above(point: np.ndarray, z: float) -> np.ndarray:
    return np.array([point[0], point[1], z])


def _yaw(T_world_obj: np.ndarray) -> float:
    return math.atan2(T_world_obj[1, 0], T_world_obj[0, 0])


def _in_frame(T_world_obj: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    return T_world_obj[:3, :3] @ np.array([x, y, z]) + T_world_obj[:3, 3]


def _pick(hand: ScriptedHand, grasp: np.ndarray, yaw: float, carry_z: float) -> Actions:
    """Grasp from above at a world point (3,) and lift to `carry_z`."""
    offset, turn = hand.grasp_noise()
    grasp, yaw = grasp + offset, yaw + turn
    yield from hand.travel(pointing_down(_above(grasp, max(HOVER_Z, grasp[2] + 0.07)), yaw))
    yield from hand.advance(pointing_down(grasp, yaw))
    yield from hand.grip(closing=True)
    yield from hand.travel(pointing_down(_above(grasp, carry_z), yaw))


def _place(hand: ScriptedHand, name: str, goal: np.ndarray) -> Actions:
    """Put the grasped object's origin at a world point (3,), let go and retreat upwards."""
    release = goal + hand.grasp_noise()[0] + np.array([0.0, 0.0, RELEASE_GAP])
    approach = max(0.05, TRANSIT_Z[name] - release[2])
    yield from hand.travel(_carried(hand, name, release + np.array([0.0, 0.0, approach])))
    yield from hand.advance(_carried(hand, name, release))
    yield from hand.grip(closing=False)
    yield from _retreat(hand)


def _carried(hand: ScriptedHand, name: str, goal: np.ndarray) -> np.ndarray:
    """T_world_ee that brings the grasped object to a world point (3,), the hand keeping its orientation."""
    T_world_ee = hand.simulator.ee_pose()
    moved = T_world_ee[:3, 3] + goal - hand.simulator.object_poses()[name][:3, 3]
    yaw = math.atan2(T_world_ee[1, 0], T_world_ee[0, 0])
    return pointing_down(moved, yaw)


def _retreat(hand: ScriptedHand, height: float = 0.12) -> Actions:
    T_world_ee = hand.simulator.ee_pose()
    T_world_ee[2, 3] += height
    yield from hand.travel(T_world_ee)


def _pick_bowl(hand: ScriptedHand, carry_z: float = CARRY_Z) -> Actions:
    # Always the same side of the world: the bowl looks alike from everywhere, so its yaw cannot be followed.
    bowl = hand.simulator.object_poses()["bowl"][:3, 3]
    yield from _pick(hand, bowl + BOWL_GRASP, 0.0, carry_z)


def _bowl_on_plate(hand: ScriptedHand) -> Actions:
    yield from _pick_bowl(hand)
    yield from _place(
        hand, "bowl", _in_frame(hand.simulator.object_poses()["plate"], 0, 0, scene.PLATE_FLOOR)
    )


def _bowl_on_stove(hand: ScriptedHand) -> Actions:
    yield from _pick_bowl(hand)
    stove = hand.simulator.object_poses()["stove"]
    yield from _place(hand, "bowl", _in_frame(stove, scene.BURNER_X, 0, scene.BURNER_TOP))


def _bowl_on_cabinet(hand: ScriptedHand) -> Actions:
    yield from _pick_bowl(hand, carry_z=scene.CABINET_HEIGHT + 0.12)
    cabinet = hand.simulator.object_poses()["cabinet"]
    yield from _place(hand, "bowl", _in_frame(cabinet, 0, 0, scene.CABINET_HEIGHT))


def _box_in_bowl(hand: ScriptedHand) -> Actions:
    poses = hand.simulator.object_poses()
    box = poses["box"]
    # Half a turn of the box looks the same: take the smaller turn of the hand.
    yaw = math.remainder(_yaw(box), math.pi)
    yield from _pick(hand, _above(box[:3, 3], BOX_GRASP_Z), yaw, CARRY_Z)
    # Fingertips level with the rim: there is no room to open them inside the bowl.
    drop = scene.BOWL_HEIGHT + scene.FINGERTIP_BEYOND_EE - BOX_GRASP_Z - RELEASE_GAP
    yield from _place(hand, "box", _in_frame(hand.simulator.object_poses()["bowl"], 0, 0, drop))


def _pick_bottle(hand: ScriptedHand, carry_z: float) -> Actions:
    bottle = hand.simulator.object_poses()["bottle"][:3, 3]
    yield from _pick(hand, _above(bottle, BOTTLE_GRASP_Z), 0.0, carry_z)


def _bottle_on_cabinet(hand: ScriptedHand) -> Actions:
    yield from _pick_bottle(hand, BOTTLE_GRASP_Z + scene.CABINET_HEIGHT + 0.06)
    cabinet = hand.simulator.object_poses()["cabinet"]
    yield from _place(hand, "bottle", _in_frame(cabinet, 0, 0, scene.CABINET_HEIGHT))


def _bottle_on_rack(hand: ScriptedHand) -> Actions:
    yield from _pick_bottle(hand, BOTTLE_GRASP_Z + 0.13)
    rack = hand.simulator.object_poses()["rack"]
    yield from _place(hand, "bottle", _in_frame(rack, 0, 0, scene.RACK_SHELF_HEIGHT))


def _open_drawer(hand: ScriptedHand, name: str) -> Actions:
    """Take the handle from the front with a level hand, pull along the drawer's axis, let go and back off."""
    cabinet = hand.simulator.object_poses()["cabinet"]
    offset, turn = hand.grasp_noise()
    rotation = yaw_matrix(_yaw(cabinet) + turn) @ LEVEL_ROTATION
    height = scene.handle_height(scene.DRAWER_NAMES.index(name)) + float(offset[0])
    bar = scene.HANDLE_X + float(offset[1])

    def at(x: float, z: float) -> np.ndarray:
        return pose(_in_frame(cabinet, x, 0.0, z), rotation)

    yield from hand.travel(at(bar + 0.10, height + 0.16))
    yield from hand.travel(at(bar + 0.08, height))
    yield from hand.advance(at(bar, height))
    yield from hand.grip(closing=True)
    yield from hand.advance(at(bar + DRAWER_PULL[name], height), slowness=0.8)
    yield from hand.grip(closing=False)
    yield from hand.travel(at(bar + DRAWER_PULL[name] + 0.07, height))


def _open_middle_drawer(hand: ScriptedHand) -> Actions:
    yield from _open_drawer(hand, "drawer_middle")


def _bowl_in_top_drawer(hand: ScriptedHand) -> Actions:
    yield from _open_drawer(hand, "drawer_top")
    yield from _retreat(hand, 0.10)
    yield from _pick_bowl(hand, carry_z=0.32)
    cabinet = hand.simulator.object_poses()["cabinet"]
    front = scene.CABINET_HALF[0] + hand.simulator.joint_position("drawer_top")
    middle = (scene.CABINET_HALF[0] + front) / 2
    goal = _in_frame(cabinet, middle, BOWL_IN_DRAWER_Y, scene.drawer_height(2) + 0.008)
    yield from _place(hand, "bowl", goal)


def _push_plate(hand: ScriptedHand) -> Actions:
    """Lower the closed fingers into the plate and drag it by its inner rim; it centres itself behind them."""
    poses = hand.simulator.object_poses()
    goal = _in_frame(poses["stove"], scene.PLATE_GOAL_X, 0, 0)[:2]
    plate = poses["plate"][:2, 3]
    way = (goal - plate) / np.linalg.norm(goal - plate)
    z = scene.PLATE_FLOOR + scene.FINGERTIP_BEYOND_EE + 0.003
    hand.closing = True
    start = np.append(plate + way * 0.03, z) + hand.grasp_noise()[0]
    yield from hand.travel(pointing_down(_above(start, 0.12)))
    yield from hand.advance(pointing_down(start))
    yield from hand.advance(pointing_down(np.append(goal + way * PLATE_INNER, z)), slowness=0.6)
    for _ in range(3):
        error = goal - hand.simulator.object_poses()["plate"][:2, 3]
        short = float(error @ way)
        if short < 0.008:
            break
        ee = hand.simulator.ee_pose()[:2, 3]
        yield from hand.advance(pointing_down(np.append(ee + way * short, z)), slowness=0.4)
    yield from _retreat(hand)


def _turn_on_stove(hand: ScriptedHand) -> Actions:
    stove = hand.simulator.object_poses()["stove"]
    offset, turn = hand.grasp_noise()
    grasp = _in_frame(stove, scene.KNOB_X, 0, KNOB_GRASP_Z) + offset
    yaw = _yaw(stove) + turn
    yield from hand.travel(pointing_down(_above(grasp, 0.15), yaw))
    yield from hand.advance(pointing_down(grasp, yaw))
    yield from hand.grip(closing=True)
    yield from hand.advance(pointing_down(grasp, yaw + KNOB_TURN), slowness=0.8)
    yield from hand.grip(closing=False)
    yield from _retreat(hand)


EXPERTS: dict[str, Callable[[ScriptedHand], Actions]] = {
    "bowl_on_plate": _bowl_on_plate,
    "bowl_on_stove": _bowl_on_stove,
    "bowl_on_cabinet": _bowl_on_cabinet,
    "box_in_bowl": _box_in_bowl,
    "bottle_on_cabinet": _bottle_on_cabinet,
    "bottle_on_rack": _bottle_on_rack,
    "open_middle_drawer": _open_middle_drawer,
    "bowl_in_top_drawer": _bowl_in_top_drawer,
    "push_plate": _push_plate,
    "turn_on_stove": _turn_on_stove,
}
if set(EXPERTS) != set(TASKS):
    raise RuntimeError(f"tasks without an expert: {set(TASKS) ^ set(EXPERTS)}")
