"""A whole memory built by hand: entries, objects of all kinds, a robot, a camera."""

from dataclasses import replace

import numpy as np
from tests.memory.builders import entry, key_pose, pick_and_place, robot
from tests.perception.builders import box_model, masked_model, model, patch_model

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.vector_layout import parse_layout
from lerobot_openspm.memory.entry import Axis
from lerobot_openspm.memory.memory import Memory

SLIDE = Axis("slide", np.array([0.0, -0.6, 0.8]), 0.15)


NAMES = ("x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "gripper")
LAYOUTS = (parse_layout(NAMES, "state"), parse_layout(NAMES[:3] + NAMES[6:], "action"))


def merged_entry(**changes):
    """An entry with the spread of several demonstrations around its key poses."""
    spread = np.random.default_rng(1).normal(0, 0.01, (9, 6))
    merged = tuple(replace(pose, covariance=np.cov(spread.T)) for pose in pick_and_place())
    return entry(key_poses=merged, **changes)


def a_memory(**changes):
    T = se3.transform(se3.exp_so3([0.3, 0.2, 0.1]), [0.1, 0.2, 0.3])
    entries = (
        entry("put the bowl on the plate", source="local/demos#0"),
        entry("open the top drawer", [key_pose("cabinet", T, "open", axis=SLIDE)], source="local/demos#1"),
    )
    fields = {
        "entries": entries,
        "objects": {
            "bowl": model("bowl", 1),
            "cream cheese box": model("cream cheese box", 2, np.pi),
            "stove": patch_model("stove"),
            "rack": box_model("rack"),
            "mug": masked_model("mug"),
        },
        "robot": robot(),
        "cameras": {"observation.images.front": Camera(64, 48, 50.1, 50.2, 31.5, 23.5, "ee", T)},
        "perception": "demonstrations",
        "simulator_objects": ("bowl", "plate"),
    }
    return Memory(**{**fields, **changes})


def same(a, b):
    """Whether two of anything are equal, arrays bit by bit and with their types."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f), getattr(b, f)) for f in a.__dataclass_fields__)
    return type(a) is type(b) and a == b
