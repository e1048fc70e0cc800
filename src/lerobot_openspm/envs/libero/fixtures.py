"""What scripted experts do to LIBERO's fixtures besides putting things on them.

All lengths are in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.envs.libero.puts import RETREAT_RISE, LiberoHand, grasp, region
from lerobot_openspm.envs.motions import DOWN, Actions, in_world, raised, yaw_matrix
from lerobot_openspm.geometry.se3 import transform

# In the stove's frame. The fingers lean back towards the robot, or its arm would fold up to its limits.
KNOB = np.array([-0.004, 0.001, 0.035])
KNOB_LEAN = math.radians(20)
KNOB_TURN = math.radians(60)

# Middle of a handle in the frame of either cabinet, whose -y points out of the drawers, when they are shut.
HANDLE_X, HANDLE_Y = -0.003, -0.1016
WHITE_HANDLE_Z = {"bottom": 0.041}
HANDLE_HALF_DEPTH = 0.008
# From the middle of a white drawer's region to the inside of its front.
DRAWER_FRONT = 0.076
# Of the closed fingers before the handle's middle when they come down, and when they have shut the drawer.
SHUT_CLEAR, SHUT_TOUCHING = 0.070, 0.018
# Far from the robot on the handle: nearer to it, the palm would pass too near to the bottle beside it.
SHUT_X = 0.022
# The palm leans out of the cabinet, clear of the handles above.
SHUT_LEAN = math.radians(35)
SHUT_LOWERING = 0.10

# In the microwave's frame, whose -y points out of it: the hinge, at the height of fingers that reach below
# the upper edge of the door, while the palm stays above it.
HINGE = np.array([-0.1725, -0.088, 0.178])
# In the door's frame, whose x points from the hinge along it: where it is pushed, and its outside.
DOOR_X, DOOR_Y = 0.18, -0.025
# The angle of a door that is as far open as it goes, radians.
DOOR_OPEN = -2.094
# Of the closed fingers' middle before the door's outside: when they come down, on the way, and at the end.
DOOR_CLEAR, DOOR_TOUCHING, DOOR_PRESSED = 0.070, 0.012, 0.002


def turn_on_stove(hand: LiberoHand) -> Actions:
    """Take the knob from above, turn it and let go."""
    offset, turn = hand.grasp_noise()
    stove = hand.frame("stove")
    lean = Rotation.from_rotvec([0.0, KNOB_LEAN, 0.0]).as_matrix()
    at_knob = transform(stove[:3, :3] @ yaw_matrix(turn) @ lean @ DOWN, in_world(stove, KNOB) + offset)
    yield from grasp(hand, at_knob)
    yield from hand.advance(transform(yaw_matrix(KNOB_TURN) @ at_knob[:3, :3], at_knob[:3, 3]))
    yield from hand.grip(closing=False)
    yield from hand.retreat(RETREAT_RISE)


def in_open_drawer(name: str, offset: np.ndarray) -> Callable[[LiberoHand], np.ndarray]:
    """A place (3,) in a drawer of the white cabinet that is open.

    From half-way between its front and the handles above it, where a bowl just fits; along the world's axes.
    """

    def place(hand: LiberoHand) -> np.ndarray:
        cabinet, middle = hand.frame("cabinet"), region(hand, f"white_cabinet_1_{name}_region")
        local = cabinet[:3, :3].T @ (middle - cabinet[:3, 3])
        local[1] = (local[1] - DRAWER_FRONT + HANDLE_Y - HANDLE_HALF_DEPTH) / 2
        return in_world(cabinet, local) + offset

    return place


def shut_drawer(name: str, hand: LiberoHand) -> Actions:
    """Lower closed fingers before the handle of a drawer of the white cabinet and push it shut.

    The fingers close in the air: mining tells a push after a put by a closed hand that first goes down.
    """
    cabinet = hand.frame("cabinet")
    offset, turn = hand.grasp_noise()
    open_by = -hand.simulator.joint_position(f"white_cabinet_1_{name}_level")
    lean = Rotation.from_rotvec([SHUT_LEAN, 0.0, 0.0]).as_matrix() @ yaw_matrix(-math.pi / 2) @ DOWN
    rotation = cabinet[:3, :3] @ yaw_matrix(turn) @ lean

    def before(out: float) -> np.ndarray:
        point = np.array([SHUT_X, HANDLE_Y - out, WHITE_HANDLE_Z[name]])
        return transform(rotation, in_world(cabinet, point) + offset)

    start = before(open_by + SHUT_CLEAR)
    yield from hand.travel(raised(start, SHUT_LOWERING))
    yield from hand.grip(closing=True)
    yield from hand.advance(start)
    yield from hand.advance(before(SHUT_TOUCHING), slowness=0.7)
    yield from hand.retreat(SHUT_LOWERING)


def shut_microwave(hand: LiberoHand) -> Actions:
    """Lower closed fingers beyond the open door of the microwave and push it shut.

    The hand comes down clear of a door that is as far open as it goes, because how far this one is open is
    hardly seen. It keeps its orientation and goes round a corner half-way, as the door goes round its hinge.
    """
    microwave = hand.frame("microwave")
    offset, turn = hand.grasp_noise()
    rotation = microwave[:3, :3] @ yaw_matrix(turn) @ DOWN

    def before(angle: float, out: float) -> np.ndarray:
        point = HINGE + yaw_matrix(angle) @ [DOOR_X, DOOR_Y - out, 0.0]
        return transform(rotation, in_world(microwave, point) + offset)

    start = before(DOOR_OPEN, DOOR_CLEAR)
    yield from hand.travel(raised(start, SHUT_LOWERING))
    yield from hand.grip(closing=True)
    yield from hand.advance(start)
    yield from hand.advance(before(DOOR_OPEN / 2, DOOR_TOUCHING), slowness=0.7)
    yield from hand.advance(before(0.0, DOOR_PRESSED), slowness=0.7)
    yield from hand.retreat(SHUT_LOWERING)
