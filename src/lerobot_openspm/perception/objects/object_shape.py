"""What a shape backend says of an object: its box, upright in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import Segmentation, View


@dataclass(frozen=True)
class ObjectShape:
    """An object's place and size.

    Attributes:
        T_world_obj: Upright pose ``(4, 4)``: origin at the footprint's centre, x along its long side.
        extents: Length, width and height ``(3,)`` along that frame's axes, metres.
        quality: From 0 to 1: how well the shape explains what was seen.
        tilt: Angle in radians by which the shape was turned to stand upright.
    """

    T_world_obj: Array
    extents: Array
    quality: float
    tilt: float = 0.0


class ShapeBackend(Protocol):
    """Finds the shape of one segmented object: the paper's "local object shape and principal axes"."""

    def describe(
        self, view: View, segmentation: Segmentation, points_world: Array | None = None
    ) -> ObjectShape:
        """The object's shape.

        Args:
            view: The view that shows the object best.
            segmentation: Of the object in that view.
            points_world: Points ``(n, 3)`` of the object's surface in the world, metres.

        Raises:
            PerceptionError: The backend cannot be used, or what was seen is too little for it.
        """
        ...


@dataclass(frozen=True)
class Upright:
    """A box made upright.

    Attributes:
        T_world_obj: Upright pose ``(4, 4)``: origin at the footprint's centre, x along its long side.
        extents: Length, width and height ``(3,)``, metres.
        tilt: Angle in radians between the vertical and the box's axis nearest to it, at most 0.956.
        vertical_axis: Number of the box's axis that became vertical.
    """

    T_world_obj: Array
    extents: Array
    tilt: float
    vertical_axis: int


def make_upright(T_world_box: Array, extents: Array) -> Upright:
    """Turn a box about its centre, by the least angle, until one of its axes is vertical.

    Of the two directions along the long side, which a box does not tell apart, x takes the one with a heading
    from -90 up to 90 degrees.

    Args:
        T_world_box: Pose ``(4, 4)`` of the box, its origin at the box's centre.
        extents: Of the box along its own axes ``(3,)``, metres.
    """
    R = T_world_box[:3, :3]
    vertical = int(np.abs(R[2]).argmax())
    axis = R[:, vertical] * (1.0 if R[2, vertical] >= 0 else -1.0)
    tilt = float(np.arctan2(np.hypot(axis[0], axis[1]), axis[2]))
    # The turn about axis x z by the angle between the two takes the axis to the vertical.
    across = np.array([axis[1], -axis[0], 0.0])
    length = float(np.linalg.norm(across))
    turn = se3.exp_so3(across / length * tilt) if length > 1e-12 else np.eye(3)
    level = [k for k in range(3) if k != vertical]
    long, short = sorted(level, key=lambda k: -extents[k])
    heading = turn @ R[:, long]
    yaw = float(se3.wrap_angle(np.arctan2(heading[1], heading[0]), np.pi))
    foot = T_world_box[:3, 3] - [0.0, 0.0, extents[vertical] / 2]
    size = np.asarray(extents, float)[[long, short, vertical]]
    return Upright(se3.from_yaw(foot, yaw), size, tilt, vertical)
