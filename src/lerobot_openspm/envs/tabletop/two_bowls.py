"""When a layout with two bowls that look alike leaves no doubt which one an instruction means."""

from __future__ import annotations

import math
from collections.abc import Callable

from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.placement import Placement

Layout = dict[str, Placement]
# Whether a layout leaves no doubt.
Condition = Callable[[Layout], bool]

# The meant bowl stands nearer to its landmark than this, and the other one further by as much again.
NEAR_M = 0.20
# Of two places a bowl is between, in shares of the way, and how far off the straight way at most.
MIDDLE_SHARES, BETWEEN_M = (0.25, 0.75), 0.06
# The other one is off by this, or stands outside the two.
OFF_M, OUTSIDE_SHARES = 0.15, (-0.2, 1.2)
# Bowls this far apart sideways are left and right of one another without doubt.
SIDE_M = 0.12


def next_to(landmark: str) -> Condition:
    """Only the first bowl stands next to an object."""

    def is_clear(layout: Layout) -> bool:
        return _apart(layout, "bowl", landmark) < NEAR_M < 0.5 * _apart(layout, scene.SECOND_BOWL, landmark)

    return is_clear


def between(a: str, b: str) -> Condition:
    """Only the first bowl stands between two objects."""

    def is_clear(layout: Layout) -> bool:
        share, off = _along(layout, "bowl", a, b)
        other_share, other_off = _along(layout, scene.SECOND_BOWL, a, b)
        is_between = MIDDLE_SHARES[0] < share < MIDDLE_SHARES[1] and off < BETWEEN_M
        is_outside = not OUTSIDE_SHARES[0] < other_share < OUTSIDE_SHARES[1]
        return is_between and (other_off > OFF_M or is_outside)

    return is_clear


def left(layout: Layout) -> bool:
    """The first bowl is the left one, as seen from opposite the robot, which is the front camera's view."""
    return layout["bowl"].y < layout[scene.SECOND_BOWL].y - SIDE_M


def right(layout: Layout) -> bool:
    """The first bowl is the right one, as seen from opposite the robot."""
    return layout["bowl"].y > layout[scene.SECOND_BOWL].y + SIDE_M


def _apart(layout: Layout, a: str, b: str) -> float:
    return math.hypot(layout[a].x - layout[b].x, layout[a].y - layout[b].y)


def _along(layout: Layout, name: str, a: str, b: str) -> tuple[float, float]:
    """Share of the way from `a` to `b` at which an object stands, and its distance from that way, metres."""
    start, end, at = layout[a], layout[b], layout[name]
    dx, dy = end.x - start.x, end.y - start.y
    length = math.hypot(dx, dy)
    along = ((at.x - start.x) * dx + (at.y - start.y) * dy) / length**2
    return along, abs((at.x - start.x) * dy - (at.y - start.y) * dx) / length
