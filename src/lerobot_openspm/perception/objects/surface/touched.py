"""Where objects stood that patches do not follow: about where they were touched, and then as filmed.

What is hidden at first, or stands half beyond the picture, has no patches to follow; and of what tasks begin
with at many places, they follow one at one place. The hand went to all of them, and its camera saw them on
the way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import Look
from lerobot_openspm.perception.objects.patches.stillness import places_of
from lerobot_openspm.perception.objects.surface.backdrop import Backdrop, distinct
from lerobot_openspm.perception.objects.surface.compare import score_at
from lerobot_openspm.perception.objects.surface.model import YAWS, SurfaceModel
from lerobot_openspm.perception.objects.surface.search import (
    SAME_PLACE_M,
    Freedom,
    Place,
    over_table,
    search,
    settle,
)
from lerobot_openspm.perception.objects.surface.shown import KEPT_SHARE, MAX_SHOWN
from lerobot_openspm.perception.objects.surface.sight import Sight, Surface, sight_of, sights_of
from lerobot_openspm.types import ContactCue, DemonstrationScene, Moment, View

# Pictures that show this share of an object tell where it stands; so many of a film are enough.
SHOWN_SHARE, MAX_VIEWS = 0.5, 8
# A film that agrees with the surface by less than this share of what most do shows something else. Where half
# of the films show it beside the touched point alike, up to so many metres, this share is enough.
ALIKE_SHARE, STEADY_SHARE, STEADY_M, MIN_STEADY = 0.7, 0.45, 0.015, 3
# Another of the kind may have been touched elsewhere on it, this far from where the first one was, metres.
AROUND_M = 0.12
# What stands this much higher than on the table stands on something else, metres.
RAISED_M = 0.02
# Where it is sought again, a remembered place covers what stood so near to it, metres.
COVERED_M = 0.025


@dataclass(frozen=True)
class Touched:
    """About where an object stood.

    Attributes:
        poses: By place, the poses ``(4, 4)`` in each scene, None where it was not touched there. The object's
            frame is that of the first ones; the others may be on another of the kind.
        height: World z of its frame where it stands on the table, metres.
        is_seen: Whether first pictures show it where the first poses are.
    """

    poses: list[list[Array | None]]
    height: float
    is_seen: bool = False


def poses_by_touch(name: str, scenes: Sequence[DemonstrationScene]) -> Touched | None:
    """About where an object stood whose frame is where it was touched; None if it was not.

    The place of the most touches comes first. All poses have one direction.
    """
    places = _by_place(name, scenes)
    if not places:
        return None
    places.sort(key=len, reverse=True)
    height = _height(places[0])
    return Touched([_poses(scenes, own, places[0], height) for own in places], height)


def poses_beside(
    name: str, scenes: Sequence[DemonstrationScene], seen: Sequence[Array | None], height: float
) -> Touched | None:
    """About where an object stood, given its poses where first pictures show it.

    Args:
        name: The object's name.
        scenes: The demonstrations.
        seen: Its poses ``(4, 4)`` in each, None where it is not seen.
        height: World z of its frame where it stands on the table, metres.

    Returns:
        The poses, those that are seen first; None if it was not touched where it is seen.
    """
    places = _by_place(name, scenes)
    own = min(places, key=lambda place: _away_m(scenes, place, seen), default=None)
    if own is None or not np.isfinite(_away_m(scenes, own, seen)):
        return None
    others = [place for place in places if place is not own]
    return Touched([list(seen), *(_poses(scenes, place, own, height) for place in others)], height, True)


def _by_place(name: str, scenes: Sequence[DemonstrationScene]) -> list[list[ContactCue]]:
    return places_of(cue for scene in scenes for cue in scene.cues if cue.name == name)


def _height(place: Sequence[ContactCue]) -> float:
    return float(np.median([cue.point_world[2] for cue in place]))


def _poses(
    scenes: Sequence[DemonstrationScene],
    place: Sequence[ContactCue],
    first: Sequence[ContactCue],
    height: float,
) -> list[Array | None]:
    """Poses where a place was touched; what was grasped higher than the first stands higher by as much."""
    are_grasps = place[0].kind == first[0].kind == "grasp"
    rise = _height(place) - _height(first) if are_grasps else 0.0
    own = [next((cue for cue in scene.cues if any(cue is one for one in place)), None) for scene in scenes]
    return [None if cue is None else se3.from_yaw([*cue.point_world[:2], height + rise], 0.0) for cue in own]


def _away_m(
    scenes: Sequence[DemonstrationScene], place: Sequence[ContactCue], seen: Sequence[Array | None]
) -> float:
    """How far from where it is seen an object was touched, metres: the median; infinite if never there."""
    away = [
        float(np.linalg.norm(T[:2, 3] - cue.point_world[:2]))
        for scene, T in zip(scenes, seen, strict=True)
        for cue in scene.cues
        if T is not None and any(cue is one for one in place)
    ]
    return float(np.median(away)) if away else np.inf


@dataclass(frozen=True)
class Standing:
    """Where films show an object.

    Attributes:
        poses: By place where one of the kind stands, the poses ``(4, 4)`` in each film, None where it hardly
            shows it. First those that tell the object's frame.
        agreement: How well the films agree with it there.
        touched: What was known of it before.
    """

    poses: list[list[Array | None]]
    agreement: float
    touched: Touched

    def on_table(self) -> list[Array | None]:
        """A pose in each film where one of the kind stands on the table, None where it shows none."""
        low, high = self.touched.height - RAISED_M, self.touched.height + RAISED_M
        return [
            next((T for T in film if T is not None and low < T[2, 3] < high), None)
            for film in zip(*self.poses, strict=True)
        ]


def settle_all(
    surfaces: Mapping[str, Surface],
    films: Sequence[Sequence[Moment]],
    touched: Mapping[str, Touched],
    backdrop: Backdrop,
) -> dict[str, Standing]:
    """Where films show objects that were touched, by name; see :func:`settled`."""
    own = {name: poses for name, poses in touched.items() if name in surfaces}
    stood = {name: settled(name, surfaces[name], films, poses, backdrop) for name, poses in own.items()}
    return {name: one for name, one in stood.items() if one is not None}


def settled(
    name: str,
    surface: Surface,
    films: Sequence[Sequence[Moment]],
    touched: Touched,
    backdrop: Backdrop,
) -> Standing | None:
    """Where the films show a surface best; None where they hardly do.

    Args:
        name: The object's name.
        surface: Its surface, as it was learned with the first poses.
        films: The demonstrations' moments.
        touched: About where it stands in each.
        backdrop: What no object is.
    """
    before = [[moment for moment in film if name not in moment.moved] for film in films]
    own = _places(surface, touched.poses[0], before, backdrop)
    usual = float(np.median([place.score for place in own if place is not None] or [0.0]))
    if usual <= 0:
        return None
    stands = [touched.poses[0] if touched.is_seen else _believed(own, ALIKE_SHARE * usual)]
    for poses in touched.poses[1:]:
        around = _places(surface, poses, films, backdrop, touched.height)
        share = STEADY_SHARE if _is_steady(around, poses) else ALIKE_SHARE
        seen = _believed(around, share * usual)
        is_often = 2 * sum(T is not None for T in seen) >= sum(T is not None for T in poses)
        if is_often and all(np.linalg.norm(middle(seen) - middle(one)) > SAME_PLACE_M for one in stands):
            stands.append(seen)
    return Standing(stands, usual, touched)


def middle(poses: Sequence[Array | None]) -> Array:
    """Median place ``(3,)`` of those poses ``(4, 4)`` that there are."""
    return np.median([T[:3, 3] for T in poses if T is not None], axis=0)


def with_places(model: SurfaceModel, stood: Standing, scenes: Sequence[DemonstrationScene]) -> SurfaceModel:
    """A model that knows where it stood, and how well first pictures show that.

    Of what first pictures show badly the films tell what is usual.
    """
    places = [one for poses in stood.poses for one in _places_shown(model, poses, scenes)]
    shown = np.array(places[:MAX_SHOWN]).reshape(-1, 4)
    if stood.touched.is_seen:
        return replace(model, shown=shown)
    typical = float(np.clip(stood.agreement, 0.05, 1.0))
    rival = min(model.rival_agreement, typical)
    # Its frame was where it was touched: at its middle it stays in place however the object is seen turned.
    middle_xy = np.append(model.surface.middle, 0.0)
    surface = replace(model.surface, points=model.surface.points - middle_xy)
    shown[:, :3] += middle_xy
    return replace(model, surface=surface, shown=shown, typical_agreement=typical, rival_agreement=rival)


def _places_shown(
    model: SurfaceModel, poses: Sequence[Array | None], scenes: Sequence[DemonstrationScene]
) -> list[list[float]]:
    """Places (x, y, z) of an object's poses, and how well first pictures agree with it there.

    What they agree with much less than usual at a place was not there.
    """
    usual = _seen_first(model, scenes, poses)
    own = [(place, _seen_first(model, scenes, near)) for place, near in covering(poses)]
    return [[*place, agreed] for place, agreed in own if agreed >= KEPT_SHARE * usual]


def covering(poses: Sequence[Array | None]) -> list[tuple[Array, list[Array | None]]]:
    """The middle of some poses ``(4, 4)``, and some of them until all are near to one of these.

    Returns:
        Their places ``(3,)``, and the poses that are nearest to each.
    """
    own = np.array([[np.inf] * 3 if T is None else T[:3, 3] for T in poses])
    is_there = np.isfinite(own[:, 0])
    places = [middle(poses)]
    while True:
        away = np.linalg.norm(own[:, None] - np.array(places), axis=2)
        furthest = int(np.where(is_there, away.min(1), 0.0).argmax())
        if not is_there[furthest] or away[furthest].min() <= COVERED_M:
            break
        places.append(own[furthest])
    nearest = away.argmin(1)
    groups = [
        (place, [T if nearest[k] == i else None for k, T in enumerate(poses)])
        for i, place in enumerate(places)
    ]
    return [group for group in groups if any(T is not None for T in group[1])]


def _seen_first(
    model: SurfaceModel, scenes: Sequence[DemonstrationScene], poses: Sequence[Array | None]
) -> float:
    """How well first pictures agree with an object at its poses: the median."""
    scores = [
        score_at(model.surface, sights_of(scene.views, model.backdrop), np.array([*T[:3, 3], 0.0]))
        for scene, T in zip(scenes, poses, strict=True)
        if T is not None
    ]
    return float(np.clip(np.median(scores), 0.0, 1.0))


def _believed(places: Sequence[Place | None], enough: float) -> list[Array | None]:
    """Upright poses ``(4, 4)`` of the places that agree well enough."""
    good = [None if one is None or one.score < enough else one.pose[:3] for one in places]
    return [None if one is None else se3.from_yaw(one, 0.0) for one in good]


def _is_steady(places: Sequence[Place | None], poses: Sequence[Array | None]) -> bool:
    """Whether at least half of some films show it at the same place beside where it was touched."""
    offsets = [
        one.pose[:3] - T[:3, 3]
        for one, T in zip(places, poses, strict=True)
        if one is not None and T is not None
    ]
    if len(offsets) < MIN_STEADY:
        return False
    away = np.linalg.norm(offsets - np.median(offsets, axis=0), axis=1)
    return float(np.median(away)) <= STEADY_M


def _places(
    surface: Surface,
    poses: Sequence[Array | None],
    films: Sequence[Sequence[Moment]],
    backdrop: Backdrop,
    table: float | None = None,
) -> list[Place | None]:
    """Where each film shows a surface best at its pose, or around it; None without a pose or a view.

    Args:
        surface: What is sought.
        poses: In each film, ``(4, 4)``.
        films: The demonstrations' moments.
        backdrop: What no object is.
        table: World z of its frame on the table, metres, if it is sought around the poses.
    """
    places: list[Place | None] = []
    for T, film in zip(poses, films, strict=True):
        sights = {} if T is None else _sights(surface, film, T, backdrop)
        places.append(None if T is None or not sights else _place(surface, sights, T, table))
    return places


def _place(surface: Surface, sights: Mapping[str, Sight], T_world_obj: Array, table: float | None) -> Place:
    """Where some views show a surface best, at a pose, or around it as high and on the table."""
    if table is None:
        return settle(surface, sights, np.array([*T_world_obj[:3, 3], 0.0]), Freedom(turns=False))
    area = T_world_obj[:2, 3] + AROUND_M * np.array([[-1.0], [1.0]])
    heights = {float(T_world_obj[2, 3]), table}
    found = [
        search(surface, sights, over_table(surface, area, z), YAWS[:1], Freedom(turns=False))[0]
        for z in heights
    ]
    return max(found, key=lambda place: place.score)


def _sights(
    surface: Surface, film: Sequence[Moment], T_world_obj: Array, backdrop: Backdrop
) -> dict[str, Sight]:
    """Some of the hand's pictures that show much of an object at a pose."""
    points = se3.apply(T_world_obj, surface.coloured)
    shown: dict[str, list[View]] = {}
    for moment in film:
        for camera, view in moment.views.items():
            hidden = backdrop.hidden(camera, view)
            if hidden is None:
                continue
            if Look({camera: view}, hidden={camera: hidden}).seen_share(points) >= SHOWN_SHARE:
                shown.setdefault(camera, []).append(view)
    return {
        f"{camera}, picture {i}": sight_of(view, camera, backdrop, None)
        for camera, views in shown.items()
        for i, view in enumerate(_some(distinct(views)))
    }


def _some(views: list[View]) -> list[View]:
    """At most so many views, evenly from all."""
    chosen = np.linspace(0, len(views) - 1, min(len(views), MAX_VIEWS)).round().astype(int)
    return [views[i] for i in chosen]
