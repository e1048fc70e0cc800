"""Learning objects from demonstrations: colours, then poses and shape in turn, then symmetry and frame."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import Examples, Kind
from lerobot_openspm.perception.objects.mask_association import segmented
from lerobot_openspm.perception.objects.shape import colour_bootstrap, hull
from lerobot_openspm.perception.objects.shape.colouring import learn_colours
from lerobot_openspm.perception.objects.shape.first_poses import (
    Patched,
    coloured,
    first_poses,
    masked,
    pictures_of,
    why_nowhere,
)
from lerobot_openspm.perception.objects.shape.fitting import (
    COARSE_CUTS_PX,
    COARSE_PX,
    FINE_CUTS_PX,
    FINE_PX,
    Cloud,
    Fit,
    PosePrior,
    fit,
    measure,
    score,
)
from lerobot_openspm.perception.objects.shape.hull import NoShapeError, Posed, Votes
from lerobot_openspm.perception.objects.shape.model import ShapeModel, from_record
from lerobot_openspm.perception.objects.yaw import search_range, yaw_range
from lerobot_openspm.types import DemonstrationScene, Segmenter

log = logging.getLogger(__name__)

MAX_SCENES = 30
REFERENCES = 2
JUDGES, AXIS_JUDGES = 6, 12
NARROW_YAW = np.deg2rad(60)
ROUNDS, SYMMETRY_ROUNDS = 4, 2
THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.97)
# A more symmetric shape is preferred if it explains the masks as well as this.
SYMMETRY_LOSS = 0.006
# A yaw read into a round body does more harm than a body with corners taken for round, which costs far more.
REVOLUTION_LOSS = 0.035
BODY_OF_REVOLUTION = 24
# A view that fits worse than this share of the scene's best is taken for hidden: what a finger covers in it
# would be carved away from the shape.
CLEAR_VIEW = 0.8
# What may be lost for a shape without the cones above and below that no camera sees.
TRIM_LOSS = 0.0007
NEAR_YAWS = np.deg2rad([-30.0, -10.0, 10.0, 30.0])
TURN_GAIN = 0.008


def learn_shapes(examples: Examples) -> dict[str, ShapeModel]:
    """Learn the shapes of objects, from a segmenter's masks or from the objects' colours."""
    if examples.source != "demonstrations" and examples.segmenter is not None:
        return {}
    floor = min([examples.floor, *(one.height for one in examples.known)])
    if examples.segmenter is not None:
        found = _learn_masked(examples.names, examples.scenes, floor, examples.segmenter)
    else:
        found = {name: _learn_coloured(name, examples.scenes, floor, examples.rng) for name in examples.names}
    for name, why in found.items():
        if isinstance(why, str):
            examples.leave_out(name, why)
    return {name: model for name, model in found.items() if not isinstance(model, str)}


SHAPE = Kind(ShapeModel.kind, learn_shapes, from_record)


def _learn_coloured(
    name: str, scenes: Sequence[DemonstrationScene], floor: float, rng: Generator
) -> ShapeModel | str:
    """Colours and shape of an object from scenes with contact cues; why not, if in vain."""
    with_cue = [i for i, scene in enumerate(scenes) if any(cue.name == name for cue in scene.cues)]
    if len(with_cue) > MAX_SCENES:
        with_cue = sorted(rng.choice(with_cue, MAX_SCENES, replace=False).tolist())
    pictures = [picture for i in with_cue for picture in pictures_of(i, name, scenes[i], floor)]
    if not any(picture.seed().any() for picture in pictures):
        return "no camera sees where the hand touched it"
    reasons: list[str] = []
    for among_others in (False, True):  # a second object just like it hides its colours from the first way
        log_odds = colour_bootstrap.learn_colours(pictures, among_others)
        found = _learn_shape(name, log_odds, coloured(pictures, log_odds))
        if isinstance(found, ShapeModel):
            return found
        reasons.append(found)
    return reasons[0]


def _learn_masked(
    names: Sequence[str], scenes: Sequence[DemonstrationScene], floor: float, segmenter: Segmenter
) -> dict[str, ShapeModel | str]:
    """Shapes of objects from a segmenter's masks; why not, where there are none."""
    models: dict[str, ShapeModel | str] = {}
    for name, pairs in segmented(names, scenes, segmenter).items():
        groups = {i: masked(name, scene, floor, found) for i, (scene, found) in enumerate(pairs)}
        models[name] = _learn_shape(name, None, groups)
    return models


def _learn_shape(
    name: str, log_odds: NDArray[np.float32] | None, groups: Mapping[int, list[Patched]]
) -> ShapeModel | str:
    posed, half_size = first_poses(groups)
    if not posed:
        return why_nowhere(groups)
    try:
        cloud, posed = _bootstrap(posed, half_size)
        return _model(name, log_odds, *_finish(posed, half_size, cloud))
    except NoShapeError:
        return "what stands out where the hand touched it has another shape in every demonstration"


def _bootstrap(posed: list[Posed], half_size: float) -> tuple[Cloud, list[Posed]]:
    """A first common shape: that of the scene whose own hull, turned and moved, explains the others best."""
    order = sorted(
        range(len(posed)), key=lambda i: -sum(bool((e.probability > 0.5).any()) for e in posed[i].evidence)
    )
    yaws = np.arange(8) * np.pi / 4
    judges = [posed[i] for i in order[:JUDGES]]
    best: tuple[float, Cloud] | None = None
    for reference in order[:REFERENCES]:
        cloud = hull.vote([posed[reference]], half_size).cloud(0.9)
        if cloud is None:
            continue
        total = float(np.median([_fit_yaws(scene, cloud, yaws).score for scene in judges]))
        if best is None or total > best[0]:
            best = (total, cloud)
    if best is None:
        raise NoShapeError
    cloud = best[1]
    anyhow = [_fit_yaws(scene, cloud, yaws) for scene in posed]
    # What keeps to about one direction in every scene must not be turned for a trifle: a fixture that looks
    # alike from two sides would end up with either.
    alike = [_fit_yaws(scene, cloud, NEAR_YAWS) for scene in posed]
    lost = float(np.mean([one.score - other.score for one, other in zip(anyhow, alike, strict=True)]))
    return cloud, _moved(posed, alike if lost < TURN_GAIN else anyhow)


def _finish(posed: list[Posed], half_size: float, cloud: Cloud) -> tuple[Cloud, list[Posed], float, Array]:
    """Shape and poses in turn; then the most symmetric shape that explains the masks as well.

    Returns:
        The shape, the poses, the yaw period (0 for a body of revolution), and the score of every scene.
    """
    limits = (-np.inf, np.inf)
    for round_index in range(ROUNDS):
        if round_index == 2:
            posed = _aligned_axis(posed, half_size, cloud, limits)
        votes = hull.vote(_reliable(posed, cloud), half_size, hull.around(cloud, half_size))
        reliable = _reliable(posed, cloud)
        cloud, threshold = _best_cloud(reliable, votes, limits, cloud)
        limits = _trimmed(reliable, votes, threshold)
        cloud = votes.cloud(threshold, limits) or cloud
        posed = _moved(posed, [_refit(scene, cloud, 2 * np.pi) for scene in posed])
        posed, cloud, limits = _centred(posed, cloud, limits)
    cloud, posed, period = _symmetrise(posed, half_size, cloud, limits)
    fits = [_refit(scene, cloud, period) for scene in posed]
    return cloud, _moved(posed, fits), period, np.array([one.score for one in fits])


def _aligned_axis(
    posed: list[Posed], half_size: float, cloud: Cloud, limits: tuple[float, float]
) -> list[Posed]:
    """All poses moved by the one world displacement that makes the hull explain the masks best.

    Where the object hardly turns between scenes, places that are all off by the same few millimetres yield
    nearly as good a hull, and refitting corrects them too slowly; so the displacement is searched for.
    """
    _, halfwidth = yaw_range(np.array([se3.yaw_of(scene.T_world_obj) for scene in posed]), 2 * np.pi)
    if halfwidth > NARROW_YAW:
        return posed
    worth_asking = hull.around(cloud, half_size)

    def shifted(scenes: Sequence[Posed], x: float, y: float) -> list[Posed]:
        T_world_moved = se3.from_yaw([x, y, 0.0], 0.0)
        return [replace(scene, T_world_obj=T_world_moved @ scene.T_world_obj) for scene in scenes]

    def value(x: float, y: float) -> float:
        moved = shifted(judges, x, y)
        body, _ = _best_cloud(moved, hull.vote(moved, half_size, worth_asking), limits, cloud)
        return float(np.mean([score(measure(s.evidence, body, s.T_world_obj, FINE_PX)) for s in moved]))

    reliable = _reliable(posed, cloud)
    judges = reliable[:: max(1, len(reliable) // AXIS_JUDGES)]
    place, best = (0.0, 0.0), value(0.0, 0.0)
    for step in (0.012, 0.006, 0.003):
        for dx, dy in ((step, 0), (-step, 0), (0, step), (0, -step)):
            tried = (place[0] + dx, place[1] + dy)
            if (worth := value(*tried)) > best:
                place, best = tried, worth
    log.debug("perception: places moved by %.1f and %.1f mm", 1e3 * place[0], 1e3 * place[1])
    return shifted(posed, *place)


def _symmetrise(
    posed: list[Posed], half_size: float, cloud: Cloud, limits: tuple[float, float]
) -> tuple[Cloud, list[Posed], float]:
    """The most symmetric shape that explains the masks as well as the free one, poses and yaw period."""
    _, halfwidth = search_range(np.array([se3.yaw_of(scene.T_world_obj) for scene in posed]), 2 * np.pi)
    free = float(
        np.mean([one.score for one in (_refit(scene, cloud, 2 * np.pi) for scene in _reliable(posed, cloud))])
    )
    for order in (BODY_OF_REVOLUTION, 4, 2):
        period = 0.0 if order == BODY_OF_REVOLUTION else 2 * np.pi / order
        # Where the yaws are sure to keep to a part of the circle, nothing needs the symmetry, nor shows it.
        if period > 0 and halfwidth < period / 2:
            continue
        turned, moved = cloud, posed
        for _ in range(SYMMETRY_ROUNDS):
            reliable = _reliable(moved, turned)
            votes = hull.vote(reliable, half_size, hull.around(turned, half_size)).turned(order)
            turned, _ = _best_cloud(reliable, votes, limits, turned)
            moved = _moved(moved, [_refit(scene, turned, period) for scene in moved])
        worth = float(
            np.mean(
                [score(measure(s.evidence, turned, s.T_world_obj, FINE_PX)) for s in _reliable(moved, turned)]
            )
        )
        log.debug(
            "perception: symmetry of order %d explains %.3f of the masks, none %.3f", order, worth, free
        )
        if worth > free - (REVOLUTION_LOSS if period == 0 else SYMMETRY_LOSS):
            return turned, moved, period
    return cloud, posed, 2 * np.pi


def _best_cloud(
    posed: Sequence[Posed], votes: Votes, limits: tuple[float, float], fallback: Cloud
) -> tuple[Cloud, float]:
    """The hull at the vote threshold that explains the masks best, and that threshold."""
    best, chosen, worth = fallback, THRESHOLDS[0], -1.0
    for threshold in THRESHOLDS:
        cloud = votes.cloud(threshold, limits)
        if cloud is None:
            continue
        value = _worth(posed, cloud)
        if value > worth:
            best, chosen, worth = cloud, threshold, value
    return best, chosen


def _trimmed(posed: Sequence[Posed], votes: Votes, threshold: float) -> tuple[float, float]:
    """Limits in z between which the hull explains the masks as well as the whole hull.

    Cameras that all look down leave a hull with a cone below the object and a roof above, which no view
    can tell from it. They are cut off as far as that costs nothing: there is the support plane.
    """
    full = votes.cloud(threshold)
    if full is None:
        return -np.inf, np.inf
    limits = (float(full.points[:, 2].min()), float(full.points[:, 2].max()))
    judges = posed[:: max(1, len(posed) // JUDGES)]
    worth, half = _worth(judges, full), 0.51 * votes.spacing
    for end in (0, 1):
        step = 4 * votes.spacing
        while step > 0.9 * votes.spacing:
            low, high = (limits[0] + step, limits[1]) if end == 0 else (limits[0], limits[1] - step)
            cloud = votes.cloud(threshold, (low - half, high + half))
            if cloud is not None and _worth(judges, cloud) > worth - TRIM_LOSS:
                limits = (low, high)
            else:
                step /= 2
    return limits[0] - half, limits[1] + half


def _worth(posed: Sequence[Posed], cloud: Cloud) -> float:
    return float(np.mean([score(measure(scene.evidence, cloud, scene.T_world_obj)) for scene in posed]))


def _centred(
    posed: list[Posed], cloud: Cloud, limits: tuple[float, float]
) -> tuple[list[Posed], Cloud, tuple[float, float]]:
    """The same with the frame's axis through the footprint's centre and the origin half way up."""
    middle = (float(cloud.points[:, 2].min()) + float(cloud.points[:, 2].max())) / 2
    shift = np.array([*hull.footprint(cloud.points)[0], middle])
    T_old_new = se3.from_yaw(shift, 0.0)
    moved = [replace(scene, T_world_obj=scene.T_world_obj @ T_old_new) for scene in posed]
    return moved, Cloud(cloud.points - shift, cloud.spacing), (limits[0] - middle, limits[1] - middle)


def _refit(scene: Posed, cloud: Cloud, period: float) -> Fit:
    prior = PosePrior(yaw=0.0) if period == 0 else PosePrior()
    return fit(scene.evidence, cloud, scene.T_world_obj, prior, FINE_CUTS_PX)


def _reliable(posed: Sequence[Posed], cloud: Cloud) -> list[Posed]:
    """The scenes that fit well, without the views in which the object is hidden; at least one."""
    kept = []
    for scene in posed:
        overlaps = measure(scene.evidence, cloud, scene.T_world_obj)
        best = np.nanmax(overlaps, initial=0.0)
        good = [one for one, value in zip(scene.evidence, overlaps, strict=True) if value > CLEAR_VIEW * best]
        kept.append((best, Posed(tuple(good), scene.T_world_obj)))
    level = 0.8 * float(np.median([best for best, _ in kept]))
    reliable = [scene for best, scene in kept if best >= level and scene.evidence]
    if not reliable:
        raise NoShapeError
    return reliable


def _fit_yaws(scene: Posed, cloud: Cloud, yaws: Array) -> Fit:
    place = scene.T_world_obj[:3, 3]
    fits = [
        fit(scene.evidence, cloud, se3.from_yaw(place, yaw), PosePrior(), COARSE_CUTS_PX, COARSE_PX)
        for yaw in yaws
    ]
    return max(fits, key=lambda one: one.score)


def _moved(posed: Sequence[Posed], fits: Sequence[Fit]) -> list[Posed]:
    return [replace(scene, T_world_obj=one.T_world_obj) for scene, one in zip(posed, fits, strict=True)]


def _model(
    name: str,
    log_odds: NDArray[np.float32] | None,
    cloud: Cloud,
    posed: list[Posed],
    period: float,
    scores: Array,
) -> ShapeModel:
    """Put the frame at the footprint's centre, x along its long side; summarise the demonstrations."""
    centre, turn, _ = hull.footprint(cloud.points)
    bottom = float(cloud.points[:, 2].min()) - cloud.spacing / 2
    turn = 0.0 if period == 0 else turn
    T_old_new = se3.from_yaw([*centre, bottom], turn)
    points = se3.apply(se3.inverse(T_old_new), cloud.points)
    yaws = (
        np.array([se3.yaw_of(scene.T_world_obj) for scene in posed])[scores > 0.8 * np.median(scores)] + turn
    )
    yaw_centre, halfwidth = search_range(yaws, period)
    height = float(np.median([scene.T_world_obj[2, 3] for scene in posed])) + bottom
    # What has no sides needs no colours to tell them by.
    colours = learn_colours(posed, cloud) if period == 2 * np.pi else None
    return ShapeModel(
        name, log_odds, points.astype(np.float32), cloud.spacing, height, period, yaw_centre, halfwidth,
        float(np.median(scores)), colours,
    )  # fmt: skip
