"""The tabletop's dimensions and names: a hand, four movable objects, a rack, a cabinet, a stove.

World frame: z up, table top at z = 0. Every object frame has its origin at the centre of the footprint, on
the support surface; the cabinet's and the stove's x axes point out of their fronts.
The `ee` frame sits between the fingertips; its z axis points out of the hand (down at home), the fingers
open along its y axis.
"""

from typing import Literal

# Bowl: a ring of upright boxes. Thin enough a rim for the fingers to close around.
BOWL_RADIUS = 0.055
BOWL_WALL = 0.0045
BOWL_HEIGHT = 0.050
BOWL_FLOOR = 0.006
PLATE_RADIUS = 0.085
PLATE_RIM_WIDTH = 0.005
PLATE_RIM_HEIGHT = 0.014
PLATE_FLOOR = 0.006
BOX_HALF = (0.030, 0.020, 0.015)
BOTTLE_RADIUS = 0.022
BOTTLE_BODY_HEIGHT = 0.110
BOTTLE_NECK_RADIUS = 0.012
BOTTLE_HEIGHT = 0.160
RACK_HALF = (0.070, 0.045)
RACK_SHELF_HEIGHT = 0.050
RACK_RAIL_HEIGHT = 0.012
CABINET_HALF = (0.100, 0.120)
CABINET_HEIGHT = 0.210
DRAWER_PITCH = 0.066
DRAWER_TRAVEL = 0.160
DRAWER_HALF_WIDTH = 0.104
DRAWER_FRONT_X = 0.110
HANDLE_X = 0.145
MUG_RADIUS = 0.032
MUG_HEIGHT = 0.085
MUG_HANDLE = 0.018
ARCH_HALF = (0.045, 0.020, 0.035)
ARCH_OPENING = (0.022, 0.040)
STOVE_HALF = (0.110, 0.100)
STOVE_HEIGHT = 0.025
BURNER_X = -0.030
BURNER_RADIUS = 0.070
BURNER_TOP = 0.030
KNOB_X = 0.080
KNOB_RANGE = 2.0
PLATE_GOAL_X = 0.220
FINGER_TRAVEL = 0.040
FINGERTIP_BEYOND_EE = 0.008
HOME_POSITION = (-0.12, 0.0, 0.40)
TIMESTEP_S = 0.0025

OBJECT_NAMES = ("bowl", "plate", "box", "bottle", "rack", "cabinet", "stove")
# Numbers in the simulator's own segmentation; 0 is everything else.
OBJECT_LABELS = {name: number for number, name in enumerate(OBJECT_NAMES, 1)}
MOVABLE_NAMES = ("bowl", "plate", "box", "bottle")
# Never demonstrated, and of the colours of bowl and box: only their shapes tell that they are neither.
DISTRACTOR_NAMES = ("mug", "arch")
DRAWER_NAMES = ("drawer_bottom", "drawer_middle", "drawer_top")
CAMERA_NAMES = ("front", "side", "wrist")
# The frame that carries each camera.
CAMERA_MOUNTS: dict[str, Literal["world", "ee"]] = {"front": "world", "side": "world", "wrist": "ee"}


def second(name: str) -> str:
    """Name of another object just like a movable one, in scenes whose instruction tells which is meant."""
    return f"second_{name}"


def kind(name: str) -> str:
    """What an object is: the name of the one that it is just like, if it is a second one."""
    return name.removeprefix("second_")


def drawer_height(index: int) -> float:
    """Height of the underside of drawer `index` (0 bottom, 2 top) above the table, in metres."""
    return 0.008 + DRAWER_PITCH * index


def handle_height(index: int) -> float:
    """Height of the centre of the handle of drawer `index`, in metres."""
    return drawer_height(index) + 0.031
