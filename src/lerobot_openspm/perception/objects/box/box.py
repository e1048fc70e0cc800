"""Upright boxes around points: the pose and size of an object whose shape nobody learned.

The directions come from the smallest rectangle around the footprint, not from the points' principal axes:
what is seen from one side is two faces of a box, whose principal axis is its diagonal. Where the top is not
seen either, the footprint is a right angle, around which the rectangle along the diagonal is just as small as
that along the faces; then the points decide, which lie near the sides of the right one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.shape import hull

# Corners of a box of unit size that stands on its origin, and points on the rims of the cylinder in it.
_SIGNS = np.array([-0.5, 0.5])
CORNERS = np.stack(np.meshgrid(_SIGNS, _SIGNS, [0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
# Points all over it, and corners: a way that runs through the middle of a side meets some.
GRID = np.stack(
    np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.5, 0.5, 7), [0.0, 0.5, 1.0], indexing="ij"), axis=-1
).reshape(-1, 3)
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
        return se3.apply(self.T_world_obj, (_RIMS if self.is_round else CORNERS) * self.size)


# Rectangles turned by more than this, and not larger than by this factor, are rivals.
RIVAL_RAD, RIVAL_AREA = np.deg2rad(15), 1.15


def oriented_box(points_world: Array, height: float) -> Box:
    """The box on the plane ``z = height`` with the smallest footprint around points ``(n, 3)``."""
    centre, yaw, sides = hull.footprint(points_world)
    rival = _rival(points_world[:, :2], yaw, sides)
    if rival is not None and _hollowness(points_world, *rival) < _hollowness(
        points_world, centre, yaw, sides
    ):
        centre, yaw, sides = rival
    top = max(float(points_world[:, 2].max()) - height, 0.0)
    return Box(se3.from_yaw([*centre, height], np.asarray(yaw)), np.array([*sides, top]))


def _rival(points: Array, yaw: float, sides: Array) -> tuple[Array, float, Array] | None:
    """Another rectangle about as small as that with this yaw and these sides; None if there is none."""
    corners = cv2.convexHull((points * 1000).astype(np.float32))[:, 0].astype(float) / 1000
    edges = np.roll(corners, -1, axis=0) - corners
    yaws = np.arctan2(edges[:, 1], edges[:, 0])
    yaws = yaws[np.abs(se3.wrap_angle(yaws - yaw, np.pi / 2)) > RIVAL_RAD]
    along = np.stack([np.cos(yaws), np.sin(yaws)], axis=1)
    axes = np.stack([along, along[:, ::-1] * [-1, 1]], axis=1)
    reach = np.einsum("kij,nj->kni", axes, corners)
    low, high = reach.min(axis=1), reach.max(axis=1)
    areas = (high - low).prod(axis=1)
    if len(areas) == 0 or areas.min() > RIVAL_AREA * sides.prod():
        return None
    best = int(areas.argmin())
    extent, turn = (high - low)[best], float(yaws[best])
    if extent[1] > extent[0]:
        extent, turn = extent[::-1], turn + np.pi / 2
    centre = (low + high)[best] / 2 @ axes[best]
    return centre, float(se3.wrap_angle(turn, np.pi)), extent


def _hollowness(points: Array, centre: Array, yaw: float, sides: Array) -> float:
    """Mean distance of points from the nearest side of a rectangle around them, metres."""
    own = np.abs((points[:, :2] - centre) @ se3.from_yaw(np.zeros(3), np.asarray(yaw))[:2, :2])
    return float(np.min(sides / 2 - own, axis=1).mean())
