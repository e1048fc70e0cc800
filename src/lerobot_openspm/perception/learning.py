"""Learning objects from demonstrations: colours, then poses and shape in turn, then symmetry and frame."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import intersect_plane
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception import colour, seeding, shape
from lerobot_openspm.perception.blobs import triangulate
from lerobot_openspm.perception.fitting import Cloud, Evidence, Fit, Freedom, fit, measure, score
from lerobot_openspm.perception.localise import COARSE_CUTS_PX, FINE_CUTS_PX, prepare
from lerobot_openspm.perception.model import ObjectModel
from lerobot_openspm.perception.seeding import Picture
from lerobot_openspm.perception.shape import Posed
from lerobot_openspm.perception.types import Scene

log = logging.getLogger(__name__)

MAX_SCENES = 30
REFERENCES = 3
ROUNDS = 3
THRESHOLDS = (0.6, 0.7, 0.8, 0.9)
# Two rays that are to meet in an object may miss each other by this much, metres.
MAX_RAY_GAP = 0.05
# A more symmetric shape is preferred if it explains the masks as well as this.
SYMMETRY_LOSS = 0.01
BODY_OF_REVOLUTION = 12
YAW_MARGIN = np.deg2rad(20)


def learn_objects(scenes: Sequence[Scene], rng: Generator) -> dict[str, ObjectModel]:
    """Learn every object that some scene hints at.

    Args:
        scenes: First frames and hints of the demonstrations of all tasks.
        rng: Chooses among the demonstrations of an object where there are more than needed.

    Returns:
        Models by name. An object that cannot be learned (never visible, no consistent colour) is left out, and
        the log says so.

    Raises:
        DatasetError: No scene has a hint.
    """
    names = sorted({hint.name for scene in scenes for hint in scene.hints})
    if not names:
        raise DatasetError("no demonstration shows a grasp, contact or release; perception has nothing to learn from")
    floor = min(float(hint.point_world[2]) for scene in scenes for hint in scene.hints) - 0.02
    models = {}
    for name in names:
        model = learn_object(name, scenes, floor, rng)
        if model is not None:
            models[name] = model
    return models


def learn_object(name: str, scenes: Sequence[Scene], floor: float, rng: Generator) -> ObjectModel | None:
    """Learn one object from the scenes that hint at it; None, with a warning, if it cannot be learned."""
    hinted = [i for i, scene in enumerate(scenes) if any(hint.name == name for hint in scene.hints)]
    if len(hinted) > MAX_SCENES:
        hinted = sorted(rng.choice(hinted, MAX_SCENES, replace=False).tolist())
    pictures = [picture for i in hinted for picture in _pictures(i, name, scenes[i], floor)]
    log_odds = seeding.learn_colours(pictures)
    posed, half_size = _first_poses(pictures, log_odds)
    if not posed:
        log.warning("perception: %r was not found near the hints of its %d demonstrations", name, len(hinted))
        return None
    found = _bootstrap(posed, half_size)
    if found is None:
        log.warning("perception: the masks of %r in %d demonstrations agree on no shape", name, len(posed))
        return None
    cloud, posed = found
    return _model(name, log_odds, *_finish(posed, half_size, cloud))


def _pictures(index: int, name: str, scene: Scene, floor: float) -> list[Picture]:
    hints = tuple(hint for hint in scene.hints if hint.name == name)
    later = scene.later_views or {}
    return [
        Picture(
            index, view, prepare(view).bins,
            seeding.changed_pixels(view, later[key]) if key in later else None, hints, floor,
        )
        for key, view in scene.views.items()
    ]  # fmt: skip


def _first_poses(pictures: Sequence[Picture], log_odds: NDArray[np.float32]) -> tuple[list[Posed], float]:
    """Places from the patches' centres, all at one height and yaw 0, and half the size of a cube around the object."""
    groups: dict[int, list[tuple[Picture, Evidence, object]]] = {}
    for picture in pictures:
        evidence = Evidence(picture.view, colour.foreground(picture.bins, log_odds))
        blob = seeding.hinted_blob(picture, log_odds)
        groups.setdefault(picture.scene, []).append((picture, evidence, blob))
    places, singles, sizes = {}, {}, []
    for index, group in groups.items():
        seen = [(one.view, blob) for _, one, blob in group if blob is not None]
        if len(seen) >= 2:
            point, gap = triangulate([view for view, _ in seen], [blob.centre for _, blob in seen])
            if gap < MAX_RAY_GAP:
                places[index] = point
                for view, blob in seen:
                    distance = float(np.linalg.norm(point - view.T_world_cam[:3, 3]))
                    v, u = np.nonzero(blob.mask)
                    reach = np.hypot(u - blob.centre[0], v - blob.centre[1]).max()
                    sizes.append(reach * distance / view.camera.fx)
        elif seen:
            singles[index] = seen[0]
    if not places:
        return [], 0.0
    height = float(np.median([point[2] for point in places.values()]))
    for index, (view, blob) in singles.items():
        places[index] = intersect_plane(view.camera, view.T_world_cam, blob.centre, height)
    posed = [
        Posed(tuple(one for _, one, _ in groups[i]), se3.from_yaw([point[0], point[1], height], 0.0))
        for i, point in sorted(places.items())
    ]
    return posed, 1.25 * float(np.median(sizes))


def _bootstrap(posed: list[Posed], half_size: float) -> tuple[Cloud, list[Posed]] | None:
    """A first common shape: that of the scene whose own hull, turned and moved, explains the others best."""
    complete = sorted(range(len(posed)), key=lambda i: -sum(float((e.probability > 0.5).any()) for e in posed[i].evidence))
    yaws = np.arange(8) * np.pi / 4
    best: tuple[float, Cloud, list[Posed]] | None = None
    for reference in complete[:REFERENCES]:
        cloud = shape.vote([posed[reference]], half_size, np.zeros(1)).cloud(0.9)
        if cloud is None:
            continue
        fits = [_fit_yaws(scene, cloud, yaws) for scene in posed]
        total = float(np.median([one.score for one in fits]))
        if best is None or total > best[0]:
            best = (total, cloud, _moved(posed, fits))
    return None if best is None else (best[1], best[2])


def _finish(posed: list[Posed], half_size: float, cloud: Cloud) -> tuple[Cloud, list[Posed], float, Array]:
    """Shape and poses in turn; then the most symmetric shape that explains the masks as well.

    Returns:
        The shape, the poses, the yaw period (0 for a body of revolution), and the score of every scene.
    """
    for _ in range(ROUNDS):
        cloud, _ = _best_cloud(_reliable(posed, cloud), half_size, np.zeros(1), cloud)
        posed = _moved(posed, [fit(s.evidence, cloud, s.T_world_obj, Freedom(), (8.0, *FINE_CUTS_PX)) for s in posed])
    reliable = _reliable(posed, cloud)
    cloud, plain = _best_cloud(reliable, half_size, np.zeros(1), cloud)
    period = 2 * np.pi
    for order in (BODY_OF_REVOLUTION, 4, 2):
        turns = np.arange(order) * 2 * np.pi / order
        symmetric, worth = _best_cloud(reliable, half_size, turns, cloud)
        if worth > plain - SYMMETRY_LOSS:
            cloud, period = symmetric, 0.0 if order == BODY_OF_REVOLUTION else 2 * np.pi / order
            break
    freedom = Freedom(yaw=0.0) if period == 0 else Freedom()
    fits = [fit(s.evidence, cloud, s.T_world_obj, freedom, FINE_CUTS_PX) for s in posed]
    return cloud, _moved(posed, fits), period, np.array([one.score for one in fits])


def _best_cloud(posed: Sequence[Posed], half_size: float, turns: Array, fallback: Cloud) -> tuple[Cloud, float]:
    """The hull at the vote threshold that explains the masks best, and its mean score."""
    votes = shape.vote(posed, half_size, turns)
    best, worth = fallback, -1.0
    for threshold in THRESHOLDS:
        cloud = votes.cloud(threshold)
        if cloud is None:
            continue
        value = float(np.mean([score(measure(scene.evidence, cloud, scene.T_world_obj)) for scene in posed]))
        if value > worth:
            best, worth = cloud, value
    return best, worth


def _reliable(posed: Sequence[Posed], cloud: Cloud) -> list[Posed]:
    """The scenes, without the views in which the object is hidden and without those that fit badly as a whole."""
    kept = []
    for scene in posed:
        overlaps = measure(scene.evidence, cloud, scene.T_world_obj)
        best = np.nanmax(overlaps, initial=0.0)
        good = [one for one, value in zip(scene.evidence, overlaps) if value > 0.75 * best]
        kept.append((best, Posed(tuple(good), scene.T_world_obj)))
    level = 0.8 * float(np.median([best for best, _ in kept]))
    return [scene for best, scene in kept if best >= level and scene.evidence]


def _fit_yaws(scene: Posed, cloud: Cloud, yaws: Array) -> Fit:
    place = scene.T_world_obj[:3, 3]
    fits = [fit(scene.evidence, cloud, se3.from_yaw(place, yaw), Freedom(), COARSE_CUTS_PX) for yaw in yaws]
    return max(fits, key=lambda one: one.score)


def _moved(posed: Sequence[Posed], fits: Sequence[Fit]) -> list[Posed]:
    return [replace(scene, T_world_obj=one.T_world_obj) for scene, one in zip(posed, fits)]


def _model(
    name: str, log_odds: NDArray[np.float32], cloud: Cloud, posed: list[Posed], period: float, scores: Array
) -> ObjectModel:
    """Put the frame at the footprint's centre, x along its long side, and summarise the demonstrations' yaws."""
    centre, turn = shape.footprint(cloud.points)
    bottom = float(cloud.points[:, 2].min()) - cloud.spacing / 2
    turn = 0.0 if period == 0 else turn
    T_old_new = se3.from_yaw([*centre, bottom], turn)
    points = se3.apply(se3.inverse(T_old_new), cloud.points)
    yaws = np.array([se3.yaw_of(scene.T_world_obj) for scene in posed])[scores > 0.8 * np.median(scores)] + turn
    yaw_centre, halfwidth = _yaw_range(yaws, period)
    height = float(np.median([scene.T_world_obj[2, 3] for scene in posed])) + bottom
    return ObjectModel(
        name, log_odds, points.astype(np.float32), cloud.spacing, height, period, yaw_centre, halfwidth,
        float(np.median(scores)),
    )  # fmt: skip


def _yaw_range(yaws: Array, period: float) -> tuple[float, float]:
    """Middle and half width of the yaws to search: all of the period unless the demonstrations kept to a part."""
    if period == 0:
        return 0.0, 0.0
    ordered = np.sort(np.mod(yaws, period))
    gaps = np.diff(np.append(ordered, ordered[0] + period))
    widest = int(gaps.argmax())
    halfwidth = (period - gaps[widest]) / 2
    centre = float(se3.wrap_angle(ordered[(widest + 1) % len(ordered)] + halfwidth, 2 * np.pi))
    if halfwidth > 0.3 * period:
        return centre, period / 2
    return centre, float(min(halfwidth + YAW_MARGIN, period / 2))
