"""What the scripted experts for LIBERO are made of: taking something from above, and putting it somewhere.

Positions are in LIBERO's world frame unless a comment says otherwise: x points from the robot over the table,
y to the robot's left, z up. All lengths are in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lerobot_openspm.envs.libero.simulator import LiberoSimulator
from lerobot_openspm.envs.motions import DOWN, Actions, Pace, ScriptedHand, raised, yaw_matrix
from lerobot_openspm.geometry.se3 import transform, yaw_of

LiberoHand = ScriptedHand[LiberoSimulator]

# Measured: LIBERO's controller covers about a quarter of an action before the next one replaces it.
PACE = Pace(
    step_m=0.012, step_rad=0.065, closing_steps=(14, 18), opening_steps=(8, 11), asked_m=0.05, asked_rad=0.5
)

PRE_GRASP = 0.08
CARRY_RISE = 0.12
# The least height above a place from which an object is lowered to it.
LOWERING = 0.06
RETREAT_RISE = 0.08
RELEASE_GAP = 0.004

# Grasp points from the object's origin, along the world's axes.
# The bowl looks alike from everywhere: always take its rim on the robot's left, which is free in every task.
BOWL_RIM = np.array([0.0, 0.050, 0.046])
CHEESE_MIDDLE = np.array([0.0, 0.0, 0.006])
# Where an object's origin goes, from the origin of what it goes onto.
BOWL_ON_PLATE = np.array([0.0, 0.0, 0.008])


@dataclass(frozen=True)
class Put:
    """Something to pick up and put down.

    Attributes:
        name: What.
        grasp: Where from its origin to grasp it, along the world's axes, or those of a hand that is turned.
        goal: Where its origin goes.
        rise: How high to lift it.
        along: The fingers open along this object's x axis instead of the world's y.
        turn: By which angle the hand is turned about the vertical besides, radians.
        other_turn: In half of the demonstrations the hand is turned by this angle instead, as people differ.
        slant: Where from the goal, seen from above, the lowering begins (3,): it is lowered at a slant.
        like: It is put down with its axes along those of this object, not as it stood.
    """

    name: str
    grasp: np.ndarray
    goal: Callable[[LiberoHand], np.ndarray]
    rise: float = CARRY_RISE
    along: str | None = None
    turn: float = 0.0
    other_turn: float | None = None
    slant: np.ndarray = field(default_factory=lambda: np.zeros(3))
    like: str | None = None


def take_and_put(put: Put, hand: LiberoHand) -> Actions:
    """Grasp from above, lift straight up and place."""
    offset, turn = hand.grasp_noise()
    yaw = put.turn
    if put.other_turn is not None and hand.rng.random() < 0.5:
        yaw = put.other_turn
    if put.along is not None:
        yaw += float(yaw_of(hand.frame(put.along))) - math.pi / 2
    at = hand.origin(put.name) + yaw_matrix(yaw) @ put.grasp + offset
    at_grasp = transform(yaw_matrix(yaw + turn) @ DOWN, at)
    yield from grasp(hand, at_grasp)
    yield from hand.travel(raised(at_grasp, put.rise))
    yield from place(hand, put.name, put.goal(hand), put.slant, put.like)


def grasp(hand: LiberoHand, at_grasp: np.ndarray) -> Actions:
    """Go before T_world_ee `at_grasp`, advance along the fingers and close them."""
    yield from hand.travel(backed(at_grasp, PRE_GRASP))
    yield from hand.advance(at_grasp)
    yield from hand.grip(closing=True)


def place(
    hand: LiberoHand,
    name: str,
    goal: np.ndarray,
    slant: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0),
    like: str | None = None,
) -> Actions:
    """Put the grasped object's origin at a world point (3,), let go and retreat upwards.

    The object crosses the table at the height that it was lifted to, and turns on the way until its axes are
    those of another one that it is to stand `like`. It is lowered straight down or from a `slant` (3,) beside
    the goal.
    """
    release = goal + hand.grasp_noise()[0] + [0.0, 0.0, RELEASE_GAP]
    above = np.array([release[0], release[1], max(hand.origin(name)[2], release[2] + LOWERING)])
    yield from hand.travel(carried(hand, name, above + slant, like))
    yield from hand.advance(carried(hand, name, release, like))
    yield from hand.grip(closing=False)
    yield from hand.retreat(RETREAT_RISE)


def carried(hand: LiberoHand, name: str, goal: np.ndarray, like: str | None = None) -> np.ndarray:
    """T_world_ee that brings the grasped object to a world point (3,).

    The hand keeps its orientation, or turns about the vertical until the object's axes are those of `like`.
    """
    T_world_ee, T_world_obj = hand.simulator.ee_pose(), hand.frame(name)
    turn = 0.0 if like is None else float(yaw_of(hand.frame(like)) - yaw_of(T_world_obj))
    rotation = yaw_matrix(turn)
    position = goal + rotation @ (T_world_ee[:3, 3] - T_world_obj[:3, 3])
    return transform(rotation @ T_world_ee[:3, :3], position)


def backed(T_world_ee: np.ndarray, distance: float) -> np.ndarray:
    """The pose that lies `distance` before another along the fingers."""
    return transform(T_world_ee[:3, :3], T_world_ee[:3, 3] - distance * T_world_ee[:3, 2])


def region(hand: LiberoHand, name: str) -> np.ndarray:
    """Middle of one of LIBERO's regions in the world, (3,)."""
    return np.array(hand.simulator.sim.data.get_site_xpos(name))


def on(name: str, offset: np.ndarray) -> Callable[[LiberoHand], np.ndarray]:
    """A place (3,) from an object's origin, along the world's axes."""
    return lambda hand: hand.origin(name) + offset


def on_region(name: str, offset: np.ndarray) -> Callable[[LiberoHand], np.ndarray]:
    """A place (3,) from the middle of one of LIBERO's regions, along the world's axes."""
    return lambda hand: region(hand, name) + offset
