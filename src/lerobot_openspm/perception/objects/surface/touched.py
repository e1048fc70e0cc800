"""Where objects stood that the fixed cameras show badly: about where they were touched, and then as filmed.

What is hidden at first, or stands half beyond the picture, has no patches to follow. The hand went to it all
the same, and its camera saw it on the way.
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
from lerobot_openspm.perception.objects.surface.sight import Sight, Surface, sight_of, sights_of
from lerobot_openspm.types import ContactCue, DemonstrationScene, Moment, View

# Pictures that show this share of an object tell where it stands; so many of a film are enough.
SHOWN_SHARE, MAX_VIEWS = 0.5, 8
# A film that agrees with the surface by less than this share of what most do shows something else.
ALIKE_SHARE = 0.7
# Another of the kind may have been touched elsewhere on it, this far from where the first one was, metres.
AROUND_M = 0.12


def poses_by_touch(name: str, scenes: Sequence[DemonstrationScene]) -> list[list[Array | None]]:
    """Poses ``(4, 4)`` by scene of an object whose frame is where it was touched; None where it was not.

    There is one list for each place that was touched, that of the most touches first; another place may be on
    another of the kind. All poses have one height and one direction.
    """
    places = places_of(cue for scene in scenes for cue in scene.cues if cue.name == name)
    if not places:
        return []
    places.sort(key=len, reverse=True)
    height = float(np.median([cue.point_world[2] for cue in places[0]]))

    def pose(scene: DemonstrationScene, place: Sequence[ContactCue]) -> Array | None:
        own = next((cue for cue in scene.cues if any(cue is one for one in place)), None)
        return None if own is None else se3.from_yaw([*own.point_world[:2], height], 0.0)

    return [[pose(scene, place) for scene in scenes] for place in places]


@dataclass(frozen=True)
class Standing:
    """Where films show an object.

    Attributes:
        poses: By place where one of the kind stands, the poses ``(4, 4)`` in each film, None where it hardly
            shows it. First those of the object that most demonstrations touch.
        agreement: How well the films agree with it there.
    """

    poses: list[list[Array | None]]
    agreement: float


def settled(
    name: str,
    surface: Surface,
    films: Sequence[Sequence[Moment]],
    touched: Sequence[Sequence[Array | None]],
    backdrop: Backdrop,
) -> Standing | None:
    """Where the films show a surface best; None where they hardly do.

    Args:
        name: The object's name.
        surface: Its surface, as it was learned with the first list of poses.
        films: The demonstrations' moments.
        touched: About where it stands in each, as :func:`poses_by_touch` tells.
        backdrop: What no object is.
    """

    def places(
        poses: Sequence[Array | None], shown: Sequence[Sequence[Moment]], around_m: float
    ) -> list[Place | None]:
        return [
            None if T is None else _place(surface, _sights(surface, film, T, backdrop), T, around_m)
            for film, T in zip(shown, poses, strict=True)
        ]

    before = [[moment for moment in film if name not in moment.moved] for film in films]
    own = places(touched[0], before, 0.0)
    usual = float(np.median([place.score for place in own if place is not None] or [0.0]))
    if usual <= 0:
        return None
    stands = [_believed(own, ALIKE_SHARE * usual)]
    for poses in touched[1:]:
        seen = _believed(places(poses, films, AROUND_M), ALIKE_SHARE * usual)
        is_often = 2 * sum(T is not None for T in seen) >= sum(T is not None for T in poses)
        if is_often and all(np.linalg.norm(middle(seen) - middle(one)) > SAME_PLACE_M for one in stands):
            stands.append(seen)
    return Standing(stands, usual)


def _believed(places: Sequence[Place | None], enough: float) -> list[Array | None]:
    """Upright poses ``(4, 4)`` of the places that agree well enough."""
    good = [None if one is None or one.score < enough else one.pose[:3] for one in places]
    return [None if one is None else se3.from_yaw(one, 0.0) for one in good]


def middle(poses: Sequence[Array | None]) -> Array:
    """Median place ``(3,)`` of those poses ``(4, 4)`` that there are."""
    return np.median([T[:3, 3] for T in poses if T is not None], axis=0)


def settle_all(
    surfaces: Mapping[str, Surface],
    films: Sequence[Sequence[Moment]],
    touched: Mapping[str, Sequence[Sequence[Array | None]]],
    backdrop: Backdrop,
) -> dict[str, Standing]:
    """Where films show objects that were touched, by name; see :func:`settled`."""
    own = {name: poses for name, poses in touched.items() if name in surfaces}
    stood = {name: settled(name, surfaces[name], films, poses, backdrop) for name, poses in own.items()}
    return {name: one for name, one in stood.items() if one is not None}


def with_places(model: SurfaceModel, stood: Standing, scenes: Sequence[DemonstrationScene]) -> SurfaceModel:
    """A model that knows where it stood, and how well first pictures show that; films tell what is usual."""
    places = [[*middle(poses), _seen_first(model, scenes, poses)] for poses in stood.poses]
    typical = float(np.clip(stood.agreement, 0.05, 1.0))
    rival = min(model.rival_agreement, typical)
    return replace(model, shown=np.array(places), typical_agreement=typical, rival_agreement=rival)


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


def _place(
    surface: Surface, sights: Mapping[str, Sight], T_world_obj: Array, around_m: float
) -> Place | None:
    """Where some views show a surface best, near a pose or at most so far from it; None without views."""
    if not sights:
        return None
    if around_m == 0:
        return settle(surface, sights, np.array([*T_world_obj[:3, 3], 0.0]), Freedom(turns=False))
    area = T_world_obj[:2, 3] + around_m * np.array([[-1.0], [1.0]])
    ground = over_table(surface, area, float(T_world_obj[2, 3]))
    return search(surface, sights, ground, YAWS[:1], Freedom(turns=False))[0]


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
