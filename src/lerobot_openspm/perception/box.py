"""Upright boxes around points: the pose and size of an object whose shape nobody learned.

The directions come from the smallest rectangle around the footprint, not from the points' principal axes:
what is seen from one side is two faces of a box, whose principal axis is its diagonal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception import shape

# Corners of a box of unit size, and points on the rims of the cylinder inscribed in it.
_SIGNS = np.array([-0.5, 0.5])
_CORNERS = np.stack(np.meshgrid(_SIGNS, _SIGNS, [0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
_ANGLES = np.arange(32) * 2 * np.pi / 32
_RIMS = np.concatenate([
    np.stack([np.cos(_ANGLES) / 2, np.sin(_ANGLES) / 2, np.full(len(_ANGLES), z)], axis=1) for z in (0.0, 1.0)
])  # fmt: skip


@dataclass(frozen=True)
class Box:
    """An upright box, or the upright cylinder inscribed in it.

    Attributes:
        T_world_obj: Pose ``(4, 4)``: origin at the footprint's centre on the support plane, x along the first
            side.
        size: Extent ``(3,)`` along the box's own axes, metres; the long side first where it was measured.
        is_round: Whether the cylinder is meant.
    """

    T_world_obj: Array
    size: Array
    is_round: bool = False

    def vertices(self) -> Array:
        """Points in the world ``(n, 3)`` whose convex hull the body is."""
        return se3.apply(self.T_world_obj, (_RIMS if self.is_round else _CORNERS) * self.size)


def oriented_box(points_world: Array, height: float) -> Box:
    """The box on the plane ``z = height`` with the smallest footprint around points ``(n, 3)``."""
    centre, yaw, sides = shape.footprint(points_world)
    top = max(float(points_world[:, 2].max()) - height, 0.0)
    return Box(se3.from_yaw([*centre, height], np.asarray(yaw)), np.array([*sides, top]))
