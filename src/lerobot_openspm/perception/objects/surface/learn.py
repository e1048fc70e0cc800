"""Learning surfaces: from all pictures of a film in which an object stands where it stood at first."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import Examples, Kind, Look
from lerobot_openspm.perception.objects.patches.learn import UNFOLLOWED, learn_at_one_place, learn_patches
from lerobot_openspm.perception.objects.patches.model import PatchModel
from lerobot_openspm.perception.objects.surface.backdrop import Backdrop, learn_backdrop
from lerobot_openspm.perception.objects.surface.building import build_surfaces
from lerobot_openspm.perception.objects.surface.carving import Frame, silhouette
from lerobot_openspm.perception.objects.surface.compare import correlation_at, score_at
from lerobot_openspm.perception.objects.surface.model import ANOTHER_SHARE, YAWS, SurfaceModel
from lerobot_openspm.perception.objects.surface.record import from_record
from lerobot_openspm.perception.objects.surface.search import Freedom, Place, over_table, search
from lerobot_openspm.perception.objects.surface.sight import Surface, sight_of, sights_of
from lerobot_openspm.perception.objects.surface.touched import (
    Standing,
    Touched,
    poses_beside,
    poses_by_touch,
    settle_all,
    with_places,
)
from lerobot_openspm.types import DemonstrationScene, Mask, Moment, View

logger = logging.getLogger(__name__)

# What is known by touch is sought in the films, and learned again from there, so often.
SETTLING_ROUNDS = 2
# Of an object whose colours vary less together than this with what the demonstrations' first pictures show,
# the pattern tells nothing; from the second value on it tells all.
PATTERN_SEEN = 0.55, 0.8
# A demonstration in which patches agree less than this may show something else where an object stood.
SHOWN_SHARE = 0.85
# In so many of the demonstrations it is measured what looks most like the object without it; what is this
# near to it is hidden for that, pixels of a picture 256 wide.
RIVAL_SCENES, MARGIN_PX = 6, 6
# So many of a kind that instructions tell apart are looked for in a demonstration's first picture.
MOST_OF_A_KIND = 6

# The views of the demonstrations' first moments, and where an object stands in each: ``T_world_obj`` (4, 4).
FirstSights = Sequence[tuple[Mapping[str, View], Array]]
# Demonstrations with their moments.
Films = Sequence[tuple[DemonstrationScene, Sequence[Moment]]]


def learn_surfaces(examples: Examples) -> dict[str, SurfaceModel | PatchModel]:
    """Learn what hardly moves between demonstrations: its patches, and its surface where there are films.

    What tasks begin with at a few places is kept only with its surface, which finds it anywhere: patches find
    it at one of these places.
    """
    still = learn_patches(examples)
    at_one_place = learn_at_one_place(examples, still)
    near = {**still, **at_one_place}
    left_out = [name for name in examples.names if UNFOLLOWED in examples.left_out.get(name, ())]
    unseen = [name for name in left_out if name not in near]
    surfaces, why = _learn_surfaces(still, at_one_place, unseen, examples)
    alone = {name: model for name, model in still.items() if name not in surfaces}
    if alone and why:
        logger.warning("found only about where they were shown, since %s: %s", why, ", ".join(sorted(alone)))
    for name in at_one_place.keys() - surfaces.keys():
        examples.leave_out(name, f"it begins at a few places, and {why or 'there are no films of it'}")
    return {**alone, **surfaces}


def _learn_surfaces(
    still: Mapping[str, PatchModel],
    at_one_place: Mapping[str, PatchModel],
    unseen: Sequence[str],
    examples: Examples,
) -> tuple[dict[str, SurfaceModel], str]:
    """Surfaces by name, and why the others have none; that is empty where there are no films.

    Args:
        still: What patches find in the first pictures.
        at_one_place: What they find at one of the places where tasks begin with it.
        unseen: What they do not find, though it hardly moves.
        examples: The demonstrations.
    """
    near = {**still, **at_one_place}
    names = [*near, *unseen]
    films = [(scene, scene.film()) for scene in examples.scenes if names and scene.film is not None]
    if not films:
        return {}, ""
    backdrop = learn_backdrop(_pictures(films), examples.floor)
    if backdrop is None:
        return {}, "no camera of the hand shows a table"
    scenes = [scene for scene, _ in films]
    first = [_first_poses(scene, near) for scene in scenes]
    points = {name: _touched(name, scenes, first) for name in near}
    heights = {name: model.height for name, model in near.items()}
    surfaces = build_surfaces(_frames(films, first, backdrop), points, heights, backdrop)
    # Where nothing stands on the table, patches follow the table itself, and not what was touched above it.
    near = {name: model for name, model in near.items() if name in surfaces}
    unseen = [name for name in names if name not in near]
    touched = {name: one for name in unseen if (one := poses_by_touch(name, scenes))}
    for name in unseen:
        points.pop(name, None)
    for name, one in touched.items():
        points[name], heights[name] = np.zeros((1, 3)), one.height
        _put(name, one.poses[0], first)
    touched |= _elsewhere(near.keys() & at_one_place.keys(), scenes, first, heights)
    if unseen:
        surfaces = build_surfaces(_frames(films, first, backdrop), points, heights, backdrop)

    def standing_in(name: str) -> FirstSights:
        return [(scene.views, T[name]) for scene, T in zip(scenes, first, strict=True) if name in T]

    stood: dict[str, Standing] = {}
    for _ in range(SETTLING_ROUNDS if touched else 0):
        stood = settle_all(surfaces, [film for _, film in films], touched, backdrop)
        for name, one in stood.items():
            _put(name, one.on_table(), first)
        surfaces = build_surfaces(_frames(films, first, backdrop), points, heights, backdrop)
    # What the films hardly show where it was touched is not known.
    models = {
        name: _model(
            name, surfaces[name], heights[name], near.get(name), standing_in(name), backdrop, examples
        )
        for name in surfaces
        if name in stood or name not in unseen
    }
    for name in stood.keys() & models.keys():
        models[name] = with_places(models[name], stood[name], scenes)
    return models, "the hand's camera shows too little of its surface"


def _model(
    name: str,
    surface: Surface,
    height: float,
    near: PatchModel | None,
    standing: FirstSights,
    backdrop: Backdrop,
    examples: Examples,
) -> SurfaceModel:
    """What is known of an object by its surface, and by how demonstrations show that where it stands."""
    surface = replace(surface, pattern=_pattern(surface, standing, backdrop))
    typical, rival = _agreements(surface, standing, backdrop, name in examples.told_apart)
    logger.info("surface of %s: %d coloured points, agreement %.2f, without it %.2f",
                name, len(surface.coloured), typical, rival)  # fmt: skip
    return SurfaceModel(name, surface, backdrop, height, typical, rival, near)


def _elsewhere(
    names: Collection[str],
    scenes: Sequence[DemonstrationScene],
    first: Sequence[Mapping[str, Array]],
    heights: Mapping[str, float],
) -> dict[str, Touched]:
    """About where things stood that patches find at one place only, by name."""
    seen = {name: [poses.get(name) for poses in first] for name in sorted(names)}
    found = {name: poses_beside(name, scenes, poses, heights[name]) for name, poses in seen.items()}
    return {name: one for name, one in found.items() if one is not None}


def _put(name: str, poses: Sequence[Array | None], first: Sequence[dict[str, Array]]) -> None:
    """Write down where an object stands in each scene; nowhere in those without a pose."""
    for T, standing in zip(poses, first, strict=True):
        standing.pop(name, None)
        if T is not None:
            standing[name] = T


def _pictures(films: Films) -> dict[str, list[View]]:
    """All pictures by camera."""
    pictures: dict[str, list[View]] = {}
    for _, moments in films:
        for moment in moments:
            for camera, view in moment.views.items():
                pictures.setdefault(camera, []).append(view)
    return pictures


SURFACE = Kind(SurfaceModel.kind, learn_surfaces, from_record)


def _first_poses(scene: DemonstrationScene, near: Mapping[str, PatchModel]) -> dict[str, Array]:
    look = Look(scene.views)
    found = {name: model.localise(look) for name, model in near.items()}
    return {name: one.T_world_obj for name, one in found.items() if one.confidence >= SHOWN_SHARE}


def _frames(
    films: Films,
    first: Sequence[Mapping[str, Array]],
    backdrop: Backdrop,
) -> list[Frame]:
    frames = []
    for (_, moments), poses in zip(films, first, strict=True):
        for moment in moments:
            standing = {name: T for name, T in poses.items() if name not in moment.moved}
            for camera, view in moment.views.items():
                hidden = backdrop.hidden(camera, view)
                foreground = backdrop.foreground(camera, view)
                frames.append(Frame(camera, view, foreground, hidden, standing, not moment.moved))
    return frames


def _touched(name: str, scenes: Sequence[DemonstrationScene], first: Sequence[Mapping[str, Array]]) -> Array:
    """Points ``(k, 3)`` in the object's frame at which it was touched."""
    points = [
        se3.apply(se3.inverse(poses[name]), cue.point_world)
        for scene, poses in zip(scenes, first, strict=True)
        for cue in scene.cues
        if cue.name == name and name in poses
    ]
    return np.array(points).reshape(-1, 3)


def _pattern(surface: Surface, standing: FirstSights, backdrop: Backdrop) -> float:
    """How much the pattern of an object tells, from 0 to 1: by how well the demonstrations show it."""
    seen = []
    for views, T in standing:
        sights = sights_of(views, backdrop)
        seen.append(correlation_at(surface, sights, np.array([*T[:3, 3], 0.0])))
    low, high = PATTERN_SEEN
    return float(np.clip((np.median(seen) - low) / (high - low), 0, 1)) if seen else 0.0


def _agreements(
    surface: Surface, standing: FirstSights, backdrop: Backdrop, are_several: bool
) -> tuple[float, float]:
    """How well first pictures agree with the object where it stands, and with the best place without it.

    The first is the median of demonstrations, the second the most of some of them. Where there may be several
    of its kind, the second is without those others too.
    """
    if not standing:
        return 0.05, 0.0
    own = []
    for views, T in standing:
        sights = sights_of(views, backdrop)
        own.append(score_at(surface, sights, np.array([*T[:3, 3], 0.0])))
    typical = float(np.clip(np.median(own), 0.05, 1.0))
    another = ANOTHER_SHARE * typical if are_several else np.inf
    searched = np.unique(np.linspace(0, len(standing) - 1, RIVAL_SCENES).astype(int))
    some = [standing[i] for i in searched]
    rivals = [_best_without(surface, views, T, backdrop, another) for views, T in some]
    return typical, float(np.clip(max(rivals), 0.0, typical))


def _best_without(
    surface: Surface, views: Mapping[str, View], T_world_obj: Array, backdrop: Backdrop, another: float
) -> float:
    """How well the best place on the table agrees where none is: without the one that stands at a pose.

    What agrees so well as `another` is another of its kind, and left out as well.
    """
    ground = over_table(surface, backdrop.reach, float(T_world_obj[2, 3]))
    points, best = np.empty((0, 3)), Place(np.append(T_world_obj[:3, 3], se3.yaw_of(T_world_obj)), np.inf)
    for _ in range(MOST_OF_A_KIND):
        T = best.T_world_obj
        points = np.concatenate([points, se3.apply(T, surface.points)])
        covered = {c: _covered(view, points, surface.spacing) for c, view in views.items()}
        sights = {c: sight_of(view, c, backdrop, covered[c]) for c, view in views.items()}
        best = search(surface, sights, ground, YAWS, Freedom(turns=True))[0]
        if best.score < another:
            break
    return best.score


def _covered(view: View, points: Array, spacing: float) -> Mask:
    """Pixels ``(H, W)`` around points ``(n, 3)`` of an object in the world."""
    frame = Frame("", view, np.ones(view.image.shape[:2], bool), None, {})
    drawn = np.isfinite(silhouette(frame, points, spacing)).astype(np.uint8)
    margin = 2 * round(MARGIN_PX * view.camera.width / 256) + 1
    return cv2.dilate(drawn, np.ones((margin, margin), np.uint8)).astype(bool)
