"""Scenes in which every object stands anywhere around the table's middle, at any yaw, beside distractors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.placement import (
    FIXTURES,
    HAND_GAP,
    MAX_TRIES,
    PLATE_MIN_WAY,
    TABLE_X,
    Disc,
    Layout,
    LayoutError,
    Placement,
    footprint_discs,
    hand_discs,
    plate_goal,
    rectangle_distance,
    segment_distance,
    too_close,
)
from lerobot_openspm.envs.tabletop.settings import Setting

MIDDLE = (sum(TABLE_X) / 2, 0.0)
RANGE_M = 0.25
GAP_M = 0.02
# An object that finds no room in so many draws begins the layout anew.
DRAWS_PER_OBJECT = 30
# Before a cabinet whose drawer is opened (x, half y, its frame): the drawer, and the hand that pulls it.
DRAWER_WAY = (0.36, 0.125)
# What must be in reach before it: the hand after it has let go of the handle.
DRAWER_HAND_X = 0.37
REACH_X, REACH_Y = (-0.34, 0.48), (-0.40, 0.44)


def sample_anywhere(rng: np.random.Generator, setting: Setting, parts: Sequence[str]) -> Layout:
    """Draw a placement of everything, uniform within `RANGE_M` of `MIDDLE`, nothing in another's way.

    Args:
        rng: Source of randomness.
        setting: What stands there.
        parts: The tasks that are to be done, of the ten: their ways are kept free.

    Returns:
        Placement per name in `scene.OBJECT_NAMES` and `setting.others`.

    Raises:
        LayoutError: No clear draw in `MAX_TRIES`.
    """
    names = sorted((*scene.OBJECT_NAMES, *setting.others), key=_size, reverse=True)
    for _ in range(MAX_TRIES):
        layout = _draw(rng, names, parts)
        if layout is not None and setting.is_clear(layout, setting.twin):
            return layout
    raise LayoutError(
        f"no clear layout for {', '.join(parts)} in {MAX_TRIES} tries; is the table too crowded?"
    )


def _size(name: str) -> float:
    if name in FIXTURES:
        return 1.0
    return sum(radius for _, _, radius in footprint_discs(name, Placement(0.0, 0.0, 0.0)))


def _draw(rng: np.random.Generator, names: Sequence[str], parts: Sequence[str]) -> Layout | None:
    """One object after the other, the largest first; None where one finds no room."""
    layout: Layout = {}
    for name in names:
        for _ in range(DRAWS_PER_OBJECT):
            dx, dy, yaw = rng.uniform((-RANGE_M, -RANGE_M, -math.pi), (RANGE_M, RANGE_M, math.pi)).tolist()
            at = Placement(MIDDLE[0] + dx, MIDDLE[1] + dy, yaw)
            if _has_room(layout, name, at, parts) and _push_is_free({**layout, name: at}, parts):
                layout[name] = at
                break
        else:
            return None
    return layout


def _has_room(layout: Layout, name: str, at: Placement, parts: Sequence[str]) -> bool:
    opens = any("drawer" in part for part in parts)
    if name in FIXTURES:
        if name == "cabinet" and opens and not _in_reach(*at.to_world(DRAWER_HAND_X, 0.0)):
            return False
        others = {fixture: layout[fixture] for fixture in FIXTURES if fixture in layout}
        return all(_fixtures_apart({name: at, **others}, a, b, opens) for a in others for b in (name,))
    own, grasped = footprint_discs(name, at), _graspable({name: at})
    for fixture in FIXTURES:
        if any(_way_distance(fixture, layout[fixture], x, y, opens) < r + GAP_M for x, y, r in own):
            return False
        if any(rectangle_distance(fixture, layout[fixture], x, y) < r for x, y, r in grasped):
            return False
    for other in (other for other in layout if other not in FIXTURES):
        discs = footprint_discs(other, layout[other])
        if too_close(own, discs, GAP_M) or too_close(grasped, discs, HAND_GAP):
            return False
        if too_close(_graspable({other: layout[other]}), own, HAND_GAP):
            return False
    return True


def _graspable(layout: Layout) -> list[Disc]:
    """What the hand covers when it grasps an object; nothing needs to grasp a distractor."""
    return [disc for name in layout for disc in hand_discs(layout, name)]


def _in_reach(x: float, y: float) -> bool:
    return REACH_X[0] < x < REACH_X[1] and REACH_Y[0] < y < REACH_Y[1]


def _way_distance(fixture: str, at: Placement, x: float, y: float, opens: bool) -> float:
    """Metres from a point to a fixture, the way of its drawers with it if they are opened."""
    away = rectangle_distance(fixture, at, x, y)
    if fixture == "cabinet" and opens:
        local_x, local_y = at.to_local(x, y)
        way_x, way_y = DRAWER_WAY
        beyond_x = max(local_x - way_x, -local_x, 0.0)
        away = min(away, math.hypot(beyond_x, max(abs(local_y) - way_y, 0.0)))
    return away


def _fixtures_apart(layout: Layout, a: str, b: str, opens: bool) -> bool:
    """Whether no point of one rectangle's rim comes too close to the other one."""
    return all(
        _way_distance(one, layout[one], *layout[other].to_world(x, y), opens) > GAP_M
        for one, other in ((a, b), (b, a))
        for x, y in _rim(other)
    )


def _rim(fixture: str) -> list[tuple[float, float]]:
    hx, hy = scene.CABINET_HALF if fixture == "cabinet" else scene.STOVE_HALF
    front = scene.HANDLE_X if fixture == "cabinet" else hx
    ways = (-1.0, -0.5, 0.0, 0.5, 1.0)
    return [(x, way * hy) for x in (-hx, 0.0, front) for way in ways]


def _push_is_free(layout: Layout, parts: Sequence[str]) -> bool:
    """Whether nothing stands between the plate and where it is to be pushed, if it is."""
    if "push_plate" not in parts or not {"plate", "stove"} <= layout.keys():
        return True
    plate, goal = layout["plate"], plate_goal(layout["stove"])
    if math.hypot(goal[0] - plate.x, goal[1] - plate.y) < PLATE_MIN_WAY or not _in_reach(*goal):
        return False
    others = [
        d for name in layout if name not in (*FIXTURES, "plate") for d in footprint_discs(name, layout[name])
    ]
    way = (plate.x, plate.y), goal
    wide = scene.PLATE_RADIUS + HAND_GAP
    steps = [
        (plate.x + share * (goal[0] - plate.x), plate.y + share * (goal[1] - plate.y))
        for share in (0.25, 0.5, 0.75, 1.0)
    ]
    return all(segment_distance(*way, (x, y)) > wide + r for x, y, r in others) and all(
        rectangle_distance(fixture, layout[fixture], *point) > wide
        for fixture in FIXTURES
        if fixture in layout
        for point in steps
    )
