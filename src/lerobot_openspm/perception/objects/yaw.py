"""Yaws of objects that look alike from several sides: one of them is chosen, the same one every time."""

from __future__ import annotations

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

# How far beyond the demonstrated yaws an object is still expected.
MARGIN = np.deg2rad(20)
# Yaws within this share of the period, to either side of their middle, keep to one part of it.
NARROW_SHARE = 0.2
# ... and are believed to do so where objects that turn at will would by less than this chance.
CHANCE = 0.05


def canonical(T_world_obj: Array, period: float, centre: float) -> Array:
    """An upright pose ``(4, 4)`` with its yaw brought to within half a period of ``centre`` (radians)."""
    if period == 0:
        return se3.from_yaw(T_world_obj[:3, 3], 0.0)
    turn = se3.wrap_angle(se3.yaw_of(T_world_obj) - centre, period)
    return se3.from_yaw(T_world_obj[:3, 3], centre + turn)


def yaw_range(yaws: Array, period: float) -> tuple[float, float]:
    """Middle and half width of the part of the period that the demonstrations kept to, or all of it."""
    if period == 0:
        return 0.0, 0.0
    centre, halfwidth = _arc(yaws, period)
    if halfwidth > NARROW_SHARE * period:
        return centre, period / 2
    return centre, float(min(halfwidth + MARGIN, period / 2))


def search_range(yaws: Array, period: float) -> tuple[float, float]:
    """Middle and half width of the yaws to search: a part of the period only if it is sure to be one.

    One yaw, or two or three that happen to lie near each other, do not tell that an object hardly turns: n
    yaws, each as likely as any other, all lie within some share f of the period with probability n f^(n-1).
    """
    centre, halfwidth = yaw_range(yaws, period)
    if period == 0 or halfwidth >= period / 2:
        return centre, halfwidth
    n, share = len(yaws), 2 * _arc(yaws, period)[1] / period
    return (centre, halfwidth) if n * share ** (n - 1) < CHANCE else (centre, period / 2)


def _arc(yaws: Array, period: float) -> tuple[float, float]:
    """Middle and half width of the smallest arc of the period that holds all yaws."""
    ordered = np.sort(np.mod(yaws, period))
    gaps = np.diff(np.append(ordered, ordered[0] + period))
    widest = int(gaps.argmax())
    halfwidth = float(period - gaps[widest]) / 2
    return float(se3.wrap_angle(ordered[(widest + 1) % len(ordered)] + halfwidth, 2 * np.pi)), halfwidth
