"""Whether what was taken for an upright object lies on its side, or upside down."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.shape.fitting import (
    COARSE_CUTS_PX,
    COARSE_PX,
    Cloud,
    Evidence,
    PosePrior,
    fit,
)

# It is asked where an object fits less well than this, relative to its demonstrations, but has anything to do
# with what is seen.
ASKED_BELOW, ASKED_ABOVE = 0.92, 0.3
# Lying, it must fit better by this, relative to its demonstrations.
BETTER_BY = 0.06
# Tipped over it lies this near to where it would stand upright, metres.
NEAR_M = 0.12
YAWS = np.arange(8) * np.pi / 4
# About which axis of the object, and how far, degrees. What is round tips to all sides alike.
ROUND_TURNS = (("x", 90), ("x", -90), ("x", 180))
TURNS = (*ROUND_TURNS, ("y", 90), ("y", -90))


def lying(cloud: Cloud, is_round: bool) -> list[Cloud]:
    """The cloud on each of its other sides: footprint's middle at the origin, lowest points on z = 0."""
    clouds = []
    for axis, degrees in ROUND_TURNS if is_round else TURNS:
        points = cloud.points @ Rotation.from_euler(axis, degrees, degrees=True).as_matrix().T
        low, high = points.min(axis=0), points.max(axis=0)
        under = [*(low[:2] + high[:2]) / 2, low[2] - cloud.spacing / 2]
        clouds.append(Cloud(points - under, cloud.spacing))
    return clouds


def has_tipped(
    evidence: Sequence[Evidence],
    clouds: Sequence[Cloud],
    places: Sequence[Array],
    upright: float,
    typical_overlap: float,
) -> bool:
    """Whether an object explains the views clearly better lying than upright.

    Args:
        evidence: The views.
        clouds: The object on its other sides, see :func:`lying`.
        places: Points ``(3,)`` on the support plane where it may lie.
        upright: Score of the best upright fit.
        typical_overlap: Score of the object's own demonstrations.
    """
    if not ASKED_ABOVE * typical_overlap <= upright < ASKED_BELOW * typical_overlap:
        return False
    enough = upright + BETTER_BY * typical_overlap
    for cloud in clouds:
        for place in places:
            for yaw in YAWS:
                start = se3.from_yaw(place, float(yaw))
                if fit(evidence, cloud, start, PosePrior(), COARSE_CUTS_PX, COARSE_PX).score > enough:
                    return True
    return False
