"""Looking for an object where demonstrations showed it, which first pictures may show badly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import Look
from lerobot_openspm.perception.objects.surface.compare import agreement, samples_at
from lerobot_openspm.perception.objects.surface.search import QUICK_POINTS, Freedom, Place, settle
from lerobot_openspm.perception.objects.surface.sight import Sight, Surface

# It is seen there if pictures agree this share of how they agreed in the demonstrations, and not less than
# this with it.
KEPT_SHARE, LEAST_SEEN = 0.7, 0.15
# It is sought so far around each place, at first at points so far apart, metres.
REACH_M, GRID_M = 0.055, 0.011
# Of what stands half beyond the picture at least this share is in it.
LEAST_INSIDE = 0.3
# So many places are remembered: each is looked at whenever the object is sought.
MAX_SHOWN = 64


def seen_where_shown(
    surface: Surface, sights: Mapping[str, Sight], shown: Array, freedom: Freedom
) -> list[tuple[Place, float]]:
    """The places where an object is seen near where it was shown, and how well.

    Args:
        surface: What is sought.
        sights: The views.
        shown: Where it was shown (x, y, z), and how well first pictures agreed there ``(k, 4)``.
        freedom: What may change beside the horizontal place.

    Returns:
        Places, each with its agreement as a share of that in the demonstrations' first pictures.
    """
    found: list[tuple[Place, float]] = []
    for x, y, z, agreed in shown:
        place = settle(surface, sights, _around(surface, sights, np.array([x, y, z, 0.0])), freedom)
        is_near = np.linalg.norm(place.pose[:3] - [x, y, z]) <= REACH_M
        if is_near and place.score >= max(KEPT_SHARE * agreed, LEAST_SEEN):
            found.append((place, place.score / max(agreed, LEAST_SEEN)))
    return found


def _around(surface: Surface, sights: Mapping[str, Sight], pose: Array) -> Array:
    """Of poses (x, y, z, yaw) ``(4,)`` around one, the one with which all views agree best."""
    samples = samples_at(surface, sights, pose, QUICK_POINTS)
    steps = np.arange(-REACH_M, REACH_M + GRID_M / 2, GRID_M)
    x, y = (one.ravel() for one in np.meshgrid(steps, steps))
    poses = pose + np.stack([x, y, np.zeros(len(x)), np.zeros(len(x))], 1)[np.hypot(x, y) <= REACH_M]
    return poses[int(agreement(samples, sights, poses).argmax())] if samples else pose


def visible_share(look: Look, points_world: Array) -> float:
    """Share of points ``(n, 3)`` that is not hidden, of those that are in the picture.

    An object that first pictures show badly may stand half beyond them, which hides nothing.
    """
    seen, inside = look.seen_share(points_world), replace(look, hidden={}).seen_share(points_world)
    return seen / inside if inside >= LEAST_INSIDE else seen
