"""Where everything stands at the start of an episode: uniform draws, rejected when they come too close."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.envs.tabletop import scene

# (x, y) in the world, metres.
NOMINAL_XY = {
    "bowl": (0.20, 0.05),
    "plate": (0.17, -0.24),
    "box": (0.08, 0.28),
    "bottle": (0.28, -0.08),
    "rack": (0.27, 0.27),
    "cabinet": (-0.22, 0.22),
    "stove": (-0.20, -0.22),
}
OBJECT_RANGE = 0.12
FIXTURE_RANGE = 0.05
FIXTURE_YAW_RANGE = math.radians(20)
FIXTURES = ("cabinet", "stove")
TABLE_X = (-0.40, 0.46)
TABLE_Y = (-0.44, 0.44)
GAP = 0.03
HAND_GAP = 0.01
# Half the diagonal of the palm: what must stay free around a point that is grasped from above.
HAND_RADIUS = 0.055
MAX_TRIES = 20_000
PLATE_MIN_WAY = 0.08
# Before the cabinet (x, half y, its frame): the bottle is taller than a drawer's underside, and a bowl under
# an open drawer could not be taken from above.
DRAWERS_WAY = {"bottle": (0.50, 0.09), "bowl": (0.37, 0.19)}


class LayoutError(RuntimeError):
    """No layout without overlaps was found in the allowed number of tries."""


@dataclass(frozen=True)
class Placement:
    """Pose of an object on the table: x, y in metres, yaw in radians, world frame."""

    x: float
    y: float
    yaw: float

    def to_world(self, local_x: float, local_y: float) -> tuple[float, float]:
        """Carry a point of the object's frame to the world."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return self.x + c * local_x - s * local_y, self.y + s * local_x + c * local_y

    def to_local(self, x: float, y: float) -> tuple[float, float]:
        """Carry a point of the world to the object's frame."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        dx, dy = x - self.x, y - self.y
        return c * dx + s * dy, -s * dx + c * dy


Layout = dict[str, Placement]
# Middle (x, y) and radius in the world, metres.
Disc = tuple[float, float, float]


def sample_layout(rng: np.random.Generator, has_room: Callable[[Layout], bool] | None = None) -> Layout:
    """Draw the placement of every object, uniform within its range, given that nothing is in another's way.

    Args:
        rng: Source of randomness.
        has_room: Whether a layout leaves room for something more; not asked if not given.

    Returns:
        Placement per name in `scene.OBJECT_NAMES`.

    Raises:
        LayoutError: No admissible draw in `MAX_TRIES`.
    """
    for _ in range(MAX_TRIES):
        layout = {name: _draw(name, rng) for name in scene.OBJECT_NAMES}
        if is_admissible(layout) and (has_room is None or has_room(layout)):
            return layout
    raise LayoutError(f"no layout without overlaps in {MAX_TRIES} tries; is the nominal layout too crowded?")


def sample_with_second(
    rng: np.random.Generator, twin: str, is_clear: Callable[[Layout, str], bool]
) -> Layout:
    """Draw a placement of every object and of a second one of a name, which may stand anywhere on the table.

    Args:
        rng: Source of randomness.
        twin: Name of the movable object that stands there twice.
        is_clear: Whether a layout leaves no doubt which of the two is meant.

    Returns:
        Placement per name in `scene.OBJECT_NAMES`, and of ``scene.second(twin)``.

    Raises:
        LayoutError: No clear draw in `MAX_TRIES`.
    """
    for _ in range(MAX_TRIES):
        layout = {name: _draw(name, rng) for name in scene.OBJECT_NAMES}
        x, y = rng.uniform((TABLE_X[0], TABLE_Y[0]), (TABLE_X[1], TABLE_Y[1])).tolist()
        second = Placement(x, y, 0.0)
        # Either one in the other one's place must do: their footprints keep the gap, and so does the hand.
        swapped = {**layout, twin: second}
        (_, _, radius), *_ = footprint_discs(twin, second)
        apart = math.hypot(x - layout[twin].x, y - layout[twin].y) > 2 * radius + HAND_RADIUS
        both = {**layout, scene.second(twin): second}
        if apart and is_clear(both, twin) and is_admissible(layout) and is_admissible(swapped):
            return both
    raise LayoutError(
        f"no clear layout with two of {twin!r} in {MAX_TRIES} tries; is the condition too narrow?"
    )


def _draw(name: str, rng: np.random.Generator) -> Placement:
    fixture = name in FIXTURES
    reach = FIXTURE_RANGE if fixture else OBJECT_RANGE
    turn = FIXTURE_YAW_RANGE if fixture else math.pi
    x, y = NOMINAL_XY[name]
    dx, dy, yaw = rng.uniform((-reach, -reach, -turn), (reach, reach, turn)).tolist()
    return Placement(x + dx, y + dy, yaw)


def is_admissible(layout: Layout) -> bool:
    """Whether no two footprints come too close, all stay on the table and the tasks' ways are free."""
    discs = {name: footprint_discs(name, layout[name]) for name in scene.OBJECT_NAMES if name not in FIXTURES}
    names = list(discs)
    for i, a in enumerate(names):
        if not all(_on_table(*d) for d in discs[a]):
            return False
        for b in names[i + 1 :]:
            if too_close(discs[a], discs[b], GAP) or _hand_blocked(layout, discs, a, b):
                return False
        for fixture in FIXTURES:
            if any(rectangle_distance(fixture, layout[fixture], x, y) < r + GAP for x, y, r in discs[a]):
                return False
    return _ways_are_free(layout, discs)


def footprint_discs(name: str, at: Placement) -> list[Disc]:
    """Cover an object's footprint with discs (x, y, radius), world frame, metres."""
    if name == "rack":
        hx, hy = scene.RACK_HALF
        radius = 0.052
        return [(*at.to_world(x, 0.0), radius) for x in (-(hx - hy + 0.015), 0.0, hx - hy + 0.015)]
    radius = {
        "bowl": scene.BOWL_RADIUS,
        "plate": scene.PLATE_RADIUS,
        "box": math.hypot(*scene.BOX_HALF[:2]),
        "bottle": scene.BOTTLE_RADIUS,
        "mug": scene.MUG_RADIUS + scene.MUG_HANDLE,
        "arch": math.hypot(*scene.ARCH_HALF[:2]),
    }[scene.kind(name)]
    return [(at.x, at.y, radius)]


def hand_discs(layout: Layout, name: str) -> list[Disc]:
    """What the hand covers while it grasps: the bowl's rim on the +y side, the middle of the box."""
    at, name = layout[name], scene.kind(name)
    if name == "bowl":
        return [(at.x, at.y + scene.BOWL_RADIUS, HAND_RADIUS)]
    return [(at.x, at.y, HAND_RADIUS)] if name == "box" else []


def _hand_blocked(layout: Layout, discs: dict, a: str, b: str) -> bool:
    return too_close(hand_discs(layout, a), discs[b], HAND_GAP) or too_close(
        hand_discs(layout, b), discs[a], HAND_GAP
    )


def too_close(a: Sequence[Disc], b: Sequence[Disc], gap: float) -> bool:
    """Whether some disc comes nearer to one of the others than a gap in metres."""
    return any(math.hypot(xa - xb, ya - yb) < ra + rb + gap for xa, ya, ra in a for xb, yb, rb in b)


def _on_table(x: float, y: float, radius: float) -> bool:
    return (
        TABLE_X[0] < x - radius
        and x + radius < TABLE_X[1]
        and TABLE_Y[0] < y - radius
        and y + radius < TABLE_Y[1]
    )


def rectangle_distance(fixture: str, at: Placement, x: float, y: float) -> float:
    """Metres from a point of the world to a fixture's footprint, its handles with it; 0 within."""
    hx, hy = scene.CABINET_HALF if fixture == "cabinet" else scene.STOVE_HALF
    front = scene.HANDLE_X if fixture == "cabinet" else hx
    local_x, local_y = at.to_local(x, y)
    beyond_x = max(local_x - front, -hx - local_x, 0.0)
    return math.hypot(beyond_x, max(abs(local_y) - hy, 0.0))


def plate_goal(stove: Placement) -> tuple[float, float]:
    """Where the plate belongs in `push_plate`: (x, y) in the world, in front of the stove."""
    return stove.to_world(scene.PLATE_GOAL_X, 0.0)


def _ways_are_free(layout: Layout, discs: dict) -> bool:
    """Bottle and bowl stay out of the drawers' way, and nothing between plate and stove."""
    plate = layout["plate"]
    if any(_in_drawers_way(layout, name, way) for name, way in DRAWERS_WAY.items()):
        return False
    goal = plate_goal(layout["stove"])
    if math.hypot(goal[0] - plate.x, goal[1] - plate.y) < PLATE_MIN_WAY:
        return False
    others = [d for name in discs if name != "plate" for d in discs[name]]
    return all(
        segment_distance((plate.x, plate.y), goal, (x, y)) > scene.PLATE_RADIUS + r + HAND_GAP
        for x, y, r in others
    )


def _in_drawers_way(layout: Layout, name: str, way: tuple[float, float]) -> bool:
    local_x, local_y = layout["cabinet"].to_local(layout[name].x, layout[name].y)
    return local_x < way[0] and abs(local_y) < way[1]


def box_beside_drawers(layout: Layout) -> bool:
    """Whether the box can be taken from above beside an open drawer, as the bowl always can."""
    return not _in_drawers_way(layout, "box", DRAWERS_WAY["bowl"])


def room_before_stove(name: str) -> Callable[[Layout], bool]:
    """Whether a thing finds room where the plate is pushed to: the plate does not stand there already."""

    def has_room(layout: Layout) -> bool:
        x, y = plate_goal(layout["stove"])
        (_, _, radius), *_ = footprint_discs(name, layout[name])
        return not too_close([(x, y, radius)], footprint_discs("plate", layout["plate"]), GAP)

    return has_room


def segment_distance(a: tuple, b: tuple, p: tuple) -> float:
    """Metres from a point to the straight way between two others, all (x, y)."""
    ax, ay = b[0] - a[0], b[1] - a[1]
    along = ((p[0] - a[0]) * ax + (p[1] - a[1]) * ay) / (ax * ax + ay * ay)
    along = min(max(along, 0.0), 1.0)
    return math.hypot(a[0] + along * ax - p[0], a[1] + along * ay - p[1])
