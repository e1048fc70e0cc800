"""What else stands on the table beside what the ten tasks need, and where all of it may stand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.placement import Layout

# Whether a layout leaves no doubt that the first of two objects of this name is meant.
Condition = Callable[[Layout, str], bool]

# The meant object stands nearer to its landmark than this, and the other one further by as much again.
NEAR_M = 0.20
# Of two places an object is between, in shares of the way, and how far off the straight way at most.
MIDDLE_SHARES, BETWEEN_M = (0.25, 0.75), 0.06
# The other one is off by this, or stands outside the two.
OFF_M, OUTSIDE_SHARES = 0.15, (-0.2, 1.2)
# Objects this far apart sideways are left and right of one another without doubt.
SIDE_M = 0.12


@dataclass(frozen=True)
class Setting:
    """A scene with two objects that look alike.

    Attributes:
        twin: Name of the movable object that stands there twice; the other one is ``scene.second(twin)``.
        is_clear: Whether a layout leaves no doubt that the first of the two is meant.
        is_anywhere: Whether every object stands anywhere near the table's middle, at any yaw, and the
            distractors with them; else only the second object may stand anywhere.
    """

    twin: str
    is_clear: Condition
    is_anywhere: bool = False

    @property
    def others(self) -> tuple[str, ...]:
        """Names of what stands there beside the objects of the ten tasks."""
        return (scene.second(self.twin), *(scene.DISTRACTOR_NAMES if self.is_anywhere else ()))


def not_told(layout: Layout, name: str) -> bool:
    """Neither of the two is meant, so nothing has to be clear."""
    return True


def next_to(landmark: str) -> Condition:
    """Only the first object stands next to another one."""

    def is_clear(layout: Layout, name: str) -> bool:
        return _apart(layout, name, landmark) < NEAR_M < 0.5 * _apart(layout, scene.second(name), landmark)

    return is_clear


def between(a: str, b: str) -> Condition:
    """Only the first object stands between two others."""

    def is_clear(layout: Layout, name: str) -> bool:
        share, off = _along(layout, name, a, b)
        other_share, other_off = _along(layout, scene.second(name), a, b)
        is_between = MIDDLE_SHARES[0] < share < MIDDLE_SHARES[1] and off < BETWEEN_M
        is_outside = not OUTSIDE_SHARES[0] < other_share < OUTSIDE_SHARES[1]
        return is_between and (other_off > OFF_M or is_outside)

    return is_clear


def left(layout: Layout, name: str) -> bool:
    """The first object is the left one, as seen from opposite the robot, which is the front camera's view."""
    return layout[name].y < layout[scene.second(name)].y - SIDE_M


def right(layout: Layout, name: str) -> bool:
    """The first object is the right one, as seen from opposite the robot."""
    return layout[name].y > layout[scene.second(name)].y + SIDE_M


def _apart(layout: Layout, a: str, b: str) -> float:
    return math.hypot(layout[a].x - layout[b].x, layout[a].y - layout[b].y)


def _along(layout: Layout, name: str, a: str, b: str) -> tuple[float, float]:
    """Share of the way from `a` to `b` at which an object stands, and its distance from that way, metres."""
    start, end, at = layout[a], layout[b], layout[name]
    dx, dy = end.x - start.x, end.y - start.y
    length = math.hypot(dx, dy)
    along = ((at.x - start.x) * dx + (at.y - start.y) * dy) / length**2
    return along, abs((at.x - start.x) * dy - (at.y - start.y) * dx) / length
