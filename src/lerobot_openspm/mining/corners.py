"""Corners of the hand's path: which of them matter, and how pronounced they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

# Corners closer than this to an end of the path, or to another corner, are dropped.
MIN_SPACING_M = 0.02
# A corner is never as certain as a gripper transition, so that a judge of phases may rename it.
MAX_CONFIDENCE = 0.9


def path_coordinates(T_world_ee: Array) -> Array:
    """Poses ``(n, 4, 4)`` as points ``(n, 6)`` in metres, rotations scaled to metres at the hand."""
    turn = se3.increment(T_world_ee[:1], T_world_ee)[:, 3:]
    return np.concatenate([T_world_ee[:, :3, 3], se3.METRES_PER_RADIAN * turn], axis=1)


def spaced_corners(points: Array, tolerance: Array) -> list[int]:
    """The corners of a path that keep their distance from its ends and from one another."""
    found: list[int] = []
    for corner in corners(points, tolerance).tolist():
        ends = [0, len(points) - 1, *found[-1:]]
        if np.linalg.norm(points[corner] - points[ends], axis=-1).min() >= MIN_SPACING_M:
            found.append(corner)
    return found


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


def corner_confidence(points: Array, corner: int, reach: int = 4) -> float:
    """How sharply the path turns or slows at a corner; 0.5 for passing straight and fast."""
    before = points[corner] - points[max(corner - reach, 0)]
    after = points[min(corner + reach, len(points) - 1)] - points[corner]
    norms = np.linalg.norm(before) * np.linalg.norm(after)
    turning = 0.5 * (1 - float(before @ after) / norms) if norms > 1e-9 else 1.0
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    usual = float(np.median(steps))
    slowing = 1 - float(steps[max(corner - 1, 0) : corner + 1].mean()) / usual if usual > 1e-9 else 0.0
    return float(np.clip(0.5 + max(turning, 0.5 * slowing), 0.5, MAX_CONFIDENCE))
