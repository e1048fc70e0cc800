"""Scripted experts for LIBERO's tasks: they read the true poses and act by the same 7-D actions.

All of libero_goal's are here; `picks` has those of libero_spatial and libero_object, `long_tasks` those of
libero_10.

Positions are in LIBERO's world frame unless a comment says otherwise: x points from the robot over the table,
y to the robot's left, z up; the table's top is at z = 0.9. All lengths are in metres. Every object is always
grasped at the same place of it, every grasp and every release is approached on a straight line from a pose
that is clear of everything, and carried objects cross the table high above what stands on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.envs.libero.fixtures import HANDLE_X, HANDLE_Y, turn_on_stove
from lerobot_openspm.envs.libero.long_tasks import LONG
from lerobot_openspm.envs.libero.picks import OBJECT, SPATIAL
from lerobot_openspm.envs.libero.puts import (
    BOWL_ON_PLATE,
    BOWL_RIM,
    CHEESE_MIDDLE,
    PACE,
    PRE_GRASP,
    RETREAT_RISE,
    LiberoHand,
    Put,
    backed,
    grasp,
    on,
    on_region,
    place,
    region,
    take_and_put,
)
from lerobot_openspm.envs.libero.simulator import LiberoSimulator
from lerobot_openspm.envs.motions import DOWN, Actions, in_world, raised, yaw_matrix
from lerobot_openspm.geometry.se3 import transform

FINAL_HOLD_STEPS = 15

# A grasp point from the object's origin, along the world's axes.
BOTTLE_NECK = np.array([0.0, 0.0, 0.135])

# Where an object's origin goes, from the origin of what it goes onto.
CHEESE_IN_BOWL = np.array([0.0, 0.0, 0.040])
# In the rack's frame: a third up the tilted upper shelf, far from both of its ends.
BOTTLE_ON_RACK = np.array([0.0, -0.050, 0.240])
# From the middles of LIBERO's regions.
BOWL_ON_BURNER = np.array([0.0, 0.0, 0.020])
BOWL_IN_DRAWER = np.array([0.0, 0.0, -0.020])
# Nearer to the robot than the middle of the top, where a hand above a bottle would need a straight arm.
BOTTLE_ON_CABINET = np.array([-0.050, 0.020, 0.0])
CABINET_CARRY_RISE = 0.275
DRAWER_CARRY_RISE = 0.25
RACK_CARRY_RISE = 0.33

# In the cabinet's frame, whose -y points out of the drawers.
HANDLE_Z = {"top": 0.184, "middle": 0.1104}
DRAWER_PULL = 0.15
DRAWER_BACK_OFF = 0.06
# The open drawer overhangs the bowl: the hand leans away, and the bowl moves aside before it rises.
BOWL_LEAN = math.radians(35)
BOWL_ASIDE = np.array([-0.02, 0.09, 0.08])

# Of the ee behind the plate's origin when it stands clear, and when both fingers touch the edge.
PLATE_CLEAR, PLATE_TOUCHING = 0.085, 0.063
# Fingertips low over the table, or they climb onto the plate.
PLATE_PUSH_Z = 0.009
# The palm leans over the plate, clear of the drawers' handles behind it.
PLATE_LEAN = math.radians(15)
# Past the bowl first, then to the goal: a little beyond the region's middle, since the plate lags behind.
PLATE_FIRST_LEG = 0.08
PLATE_HALF_WAY = 0.4
PLATE_GOAL = np.array([-0.010, 0.0, 0.0])

# The hand in the cabinet's frame: pointing into its front, one finger above the other.
LEVEL = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


def expert_actions(
    simulator: LiberoSimulator,
    task: str,
    rng: np.random.Generator,
    operator: type[LiberoHand] = LiberoHand,
) -> Actions:
    """Yield the actions (7,) that solve `task` from the simulator's present state.

    Step the simulator with each action before asking for the next one.

    Args:
        simulator: The simulator that is stepped.
        task: A name in `EXPERTS`.
        rng: Source of the demonstration's imperfections.
        operator: Who leads the hand.
    """
    hand = operator(simulator, rng, PACE)
    yield from EXPERTS[task](hand)
    yield from hand.hold(FINAL_HOLD_STEPS)


def _open_drawer(name: str, hand: LiberoHand) -> Actions:
    """Take the handle from the front with a level hand, pull along the drawer's axis, let go and back off.

    The handles stand above one another, too close for fingers that come from above.
    """
    cabinet = hand.frame("cabinet")
    offset, turn = hand.grasp_noise()
    rotation = cabinet[:3, :3] @ yaw_matrix(turn) @ LEVEL
    handle = np.array([HANDLE_X + offset[0], HANDLE_Y, HANDLE_Z[name] + offset[1]])

    def at(out: float) -> np.ndarray:
        return transform(rotation, in_world(cabinet, handle - [0.0, out, 0.0]))

    yield from grasp(hand, at(0.0))
    yield from hand.advance(at(DRAWER_PULL))
    yield from hand.grip(closing=False)
    yield from hand.travel(at(DRAWER_PULL + DRAWER_BACK_OFF))


def _bowl_in_top_drawer(hand: LiberoHand) -> Actions:
    yield from _open_drawer("top", hand)
    offset, turn = hand.grasp_noise()
    rotation = yaw_matrix(turn) @ Rotation.from_rotvec([-BOWL_LEAN, 0.0, 0.0]).as_matrix() @ DOWN
    at_rim = transform(rotation, hand.origin("bowl") + BOWL_RIM + offset)
    yield from grasp(hand, at_rim)
    aside = transform(rotation, at_rim[:3, 3] + BOWL_ASIDE)
    yield from hand.travel(aside)
    yield from hand.travel(raised(aside, DRAWER_CARRY_RISE - BOWL_ASIDE[2]))
    yield from place(hand, "bowl", region(hand, "wooden_cabinet_1_top_region") + BOWL_IN_DRAWER)


def _push_plate(hand: LiberoHand) -> Actions:
    """Push the plate's edge with both fingertips of the open hand: two points of contact keep it straight."""
    plate = hand.origin("plate")
    offset, turn = hand.grasp_noise()
    corner = plate + np.array([0.0, PLATE_FIRST_LEG, 0.0])
    goal = region(hand, "main_table_stove_front_region") + PLATE_GOAL
    lean = Rotation.from_rotvec([-PLATE_LEAN, 0.0, 0.0]).as_matrix() @ yaw_matrix(math.pi / 2) @ DOWN

    def behind(middle: np.ndarray, heading: float, distance: float) -> np.ndarray:
        """T_world_ee with the plate's middle straight ahead; heading 0 looks along the world's y."""
        rotation = yaw_matrix(heading)
        position = middle + offset - distance * rotation[:, 1]
        position[2] = plate[2] + PLATE_PUSH_Z
        return transform(yaw_matrix(turn) @ rotation @ lean, position)

    start = behind(plate, 0.0, PLATE_CLEAR)
    yield from hand.travel(backed(start, PRE_GRASP))
    yield from hand.advance(start)
    yield from hand.advance(behind(corner, 0.0, PLATE_TOUCHING), slowness=0.7)
    heading = math.atan2(corner[0] - goal[0], goal[1] - corner[1])
    # The hand rises while it turns, by as much as the plate is high: arrive low half-way.
    half_way = corner + PLATE_HALF_WAY * (goal - corner)
    for middle in (half_way, goal):
        yield from hand.advance(behind(middle, heading, PLATE_TOUCHING), slowness=0.7)
    yield from hand.retreat(RETREAT_RISE)


def _on_rack(hand: LiberoHand) -> np.ndarray:
    return in_world(hand.frame("rack"), BOTTLE_ON_RACK)


_TOP = "wooden_cabinet_1_top_side"
_PUTS = {
    "put_the_bowl_on_the_stove": Put("bowl", BOWL_RIM, on_region("flat_stove_1_cook_region", BOWL_ON_BURNER)),
    "put_the_wine_bottle_on_top_of_the_cabinet": Put(
        "bottle", BOTTLE_NECK, on_region(_TOP, BOTTLE_ON_CABINET), CABINET_CARRY_RISE
    ),
    "put_the_bowl_on_top_of_the_cabinet": Put(
        "bowl", BOWL_RIM, on_region(_TOP, np.zeros(3)), CABINET_CARRY_RISE
    ),
    "put_the_cream_cheese_in_the_bowl": Put("cheese", CHEESE_MIDDLE, on("bowl", CHEESE_IN_BOWL)),
    "put_the_bowl_on_the_plate": Put("bowl", BOWL_RIM, on("plate", BOWL_ON_PLATE)),
    "put_the_wine_bottle_on_the_rack": Put("bottle", BOTTLE_NECK, _on_rack, RACK_CARRY_RISE),
}
EXPERTS: dict[str, Callable[[LiberoHand], Actions]] = {
    **{task: partial(take_and_put, put) for task, put in {**_PUTS, **SPATIAL, **OBJECT}.items()},
    **LONG,
    "open_the_middle_drawer_of_the_cabinet": partial(_open_drawer, "middle"),
    "open_the_top_drawer_and_put_the_bowl_inside": _bowl_in_top_drawer,
    "push_the_plate_to_the_front_of_the_stove": _push_plate,
    "turn_on_the_stove": turn_on_stove,
}
