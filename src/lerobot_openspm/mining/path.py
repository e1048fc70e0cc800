"""Simplifying a path of poses: which of its corners matter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array


def path_coordinates(T_world_ee: Array) -> Array:
    """Poses ``(n, 4, 4)`` as points ``(n, 6)`` in metres, rotations scaled to metres at the hand."""
    turn = se3.increment(T_world_ee[:1], T_world_ee)[:, 3:]
    return np.concatenate([T_world_ee[:, :3, 3], se3.METRES_PER_RADIAN * turn], axis=1)


def corners(points: Array, tolerance: Array) -> NDArray[np.int64]:
    """Indices of the corners of a polyline through the points, ends excluded (Ramer, Douglas, Peucker).

    Args:
        points: Path ``(n, d)``.
        tolerance: Distance ``(n,)`` by which each point may lie off the simplified path. It may differ from
            point to point: near contacts little may be lost, in free space a detour does not matter.
    """
    found: list[int] = []
    spans = [(0, len(points) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        distance = _distance_to_chord(points[first : last + 1])
        outside = distance > tolerance[first : last + 1]
        if outside.any():
            # It turns where it is furthest off, not where the tolerance is smallest, near the contact.
            corner = first + int(np.argmax(np.where(outside, distance, 0.0)))
            found.append(corner)
            spans += [(first, corner), (corner, last)]
    return np.array(sorted(found), dtype=np.int64)


def _distance_to_chord(points: Array) -> Array:
    """Distance ``(n,)`` of each point from the segment between the first and the last one."""
    start, chord = points[0], points[-1] - points[0]
    length2 = float(chord @ chord)
    along = np.clip((points - start) @ chord / length2, 0, 1) if length2 > 1e-12 else np.zeros(len(points))
    return np.linalg.norm(points - start - along[:, None] * chord, axis=1)
