"""Finding a learned object in new images: candidates from colour, poses by aligning silhouettes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from lerobot_openspm.errors import ObservationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import intersect_plane, project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception import colour
from lerobot_openspm.perception.blobs import find_blobs
from lerobot_openspm.perception.fitting import COARSE_PX, Cloud, Evidence, Fit, Freedom, fit
from lerobot_openspm.perception.model import KnownObject, ObjectModel, PatchModel
from lerobot_openspm.perception.patches import localise_patches
from lerobot_openspm.perception.types import UNKNOWN_YAW_STD, Mask, PoseEstimate, Support, View

COARSE_CUTS_PX = (30.0, 30.0, 20.0, 12.0)
FINE_CUTS_PX = (6.0, 4.0, 3.0, 3.0)
BLOBS_PER_VIEW = 3
MAX_CANDIDATES = 3
# A place that so much less of the object's colours suggests than another is no candidate.
WEAK_SHARE = 0.2
# A candidate that fits so much worse than another is not worth a finer look.
POOR_SHARE = 0.7
# A share of points is told by every so many-th.
SHARE_STEP = 5
# An object that is followed: how far from where it is expected it is looked for before everywhere else, and
# how well it must be seen there for that to be left out.
NEARBY_CUTS_PX = (12.0, 6.0, 4.0, 3.0)
NEARBY_M, NEARBY_HEIGHT_M, NEARBY_RAD = 0.03, 0.003, 0.3
# An object this far above or below the plane it was learned on does not stand there.
LIFTED_M = 0.005
NEARBY_CONFIDENCE = 0.9
# Relative to the overlap that is typical of the object's demonstrations.
FOUND_CONFIDENCE = 0.5
RIVAL_SHARE = 0.93


@dataclass(frozen=True)
class Prepared:
    """A view with its colours binned, so that several objects can be sought in it at little cost."""

    view: View

    @cached_property
    def bins(self) -> colour.Bins:
        """Colour bin ``(H, W)`` of every pixel; computed once."""
        return colour.lab_bins(self.view.image)


def prepare(view: View) -> Prepared:
    """Check a view and make it ready for any number of :func:`localise` calls.

    Raises:
        ObservationError: The image is not RGB uint8 of the camera's size, or the camera's pose is not rigid.
    """
    expected = (view.camera.height, view.camera.width, 3)
    if view.image.shape != expected or view.image.dtype != np.uint8:
        raise ObservationError(
            f"image of shape {view.image.shape} and type {view.image.dtype}, expected {expected} of uint8; "
            "scale the camera to the image with Camera.scaled"
        )
    if not se3.is_rigid(view.T_world_cam):
        raise ObservationError("T_world_cam of a view is not a rigid (4, 4) transform; check the hand's pose")
    return Prepared(view)


def localise(
    views: Mapping[str, View | Prepared],
    model: KnownObject,
    freedom: Freedom | None = None,
    hidden: Mapping[str, Mask] | None = None,
    T_expected: Array | None = None,
) -> PoseEstimate:
    """Find an object in the views of one moment.

    Args:
        views: Views, or prepared views, by camera name.
        model: The object.
        freedom: Prior around the start poses; by default the object stands on its support plane, at any place
            and any yaw within the range that its demonstrations showed. An object known by patches is sought
            near its demonstrated places, whatever this says.
        hidden: Pixels ``(H, W)`` by camera name that something may be in front of; no evidence.
        T_expected: Pose ``(4, 4)`` at which the object is looked for first; elsewhere only if it is not
            there.

    Raises:
        ObservationError: There is no view, or one is malformed.
    """
    if not views:
        raise ObservationError("no camera views to look for an object in; pass at least one")
    prepared = [view if isinstance(view, Prepared) else prepare(view) for view in views.values()]
    hidden = hidden or {}
    if isinstance(model, PatchModel):
        pictures = {name: one.view for name, one in zip(views, prepared, strict=True)}
        return localise_patches(pictures, model, hidden, T_expected)
    evidence = [
        Evidence(
            one.view,
            colour.foreground(one.bins, model.log_odds),
            None if name not in hidden else 1 - hidden[name].astype(np.float32),
        )
        for name, one in zip(views, prepared, strict=True)
    ]
    masks = {name: one.probability > 0.5 for name, one in zip(views, evidence, strict=True)}
    cloud = Cloud(model.points.astype(float), model.spacing)
    if T_expected is not None:
        there = fit(evidence, cloud, T_expected, _nearby(model, T_expected), NEARBY_CUTS_PX)
        if there.score >= NEARBY_CONFIDENCE * model.typical_overlap:
            return _estimate("found", there, model, masks, seen_share(evidence, cloud, there.T_world_obj))
    fits = search(evidence, model, freedom or Freedom())
    if not fits:
        share = 1.0 if T_expected is None else seen_share(evidence, cloud, T_expected)
        return PoseEstimate("not_found", np.eye(4), _ignorance(), 0.0, masks, share)
    best = fits[0]
    status = "found" if best.score >= FOUND_CONFIDENCE * model.typical_overlap else "not_found"
    if status == "found" and len(fits) > 1 and fits[1].score > RIVAL_SHARE * best.score:
        status = "ambiguous"
    place = best.T_world_obj if status == "found" or T_expected is None else T_expected
    return _estimate(status, best, model, masks, seen_share(evidence, cloud, place))


def _estimate(
    status: Literal["found", "not_found", "ambiguous"],
    best: Fit,
    model: ObjectModel,
    masks: dict[str, Mask],
    share: float,
) -> PoseEstimate:
    confidence = float(np.clip(best.score / max(model.typical_overlap, 1e-3), 0, 1))
    covariance = best.covariance.copy()
    if model.yaw_period == 0:
        covariance[3, :] = covariance[:, 3] = 0
        covariance[3, 3] = UNKNOWN_YAW_STD**2
    T_world_obj = canonical(best.T_world_obj, model)
    support = _support(best, model, masks)
    return PoseEstimate(status, T_world_obj, covariance, confidence, masks, share, support)


def _support(best: Fit, model: ObjectModel, masks: Mapping[str, Mask]) -> Support:
    """What a fit rests on: views that explain the mask equally well are consistent."""
    seen = best.overlaps[np.isfinite(best.overlaps)]
    consistency = float(seen.min() / max(seen.max(), 1e-6)) if len(seen) else 0.0
    area = float(sum(np.count_nonzero(mask) for mask in masks.values()))
    return Support("shape", area, consistency, model.typical_overlap)


def _nearby(model: ObjectModel, T_expected: Array) -> Freedom:
    """An object that is followed keeps about its yaw, and its height but for one in the air."""
    is_lifted = abs(float(T_expected[2, 3]) - model.height) > LIFTED_M
    return Freedom(
        NEARBY_M, NEARBY_HEIGHT_M if is_lifted else 0.0, 0.0 if model.yaw_period == 0 else NEARBY_RAD
    )


def seen_share(evidence: Sequence[Evidence], cloud: Cloud, T_world_obj: Array) -> float:
    """Share of a model's points that the view that shows it best has in the picture, not hidden."""
    points = se3.apply(T_world_obj, cloud.points[::SHARE_STEP])
    shares = [0.0]
    for one in evidence:
        uv, depth = project(one.view.camera, one.view.T_world_cam, points)
        uv = np.nan_to_num(uv, nan=-1.0)
        size = np.array([one.view.camera.width, one.view.camera.height])
        inside = (depth > 0) & (uv >= 0).all(1) & (uv <= size - 1).all(1)
        if one.visible is not None:
            inside[inside] = one.visible[tuple(np.rint(uv[inside]).astype(int).T[::-1])] > 0.5
        shares.append(float(inside.mean()))
    return max(shares)


def search(evidence: Sequence[Evidence], model: ObjectModel, freedom: Freedom) -> list[Fit]:
    """Fits at distinct places, the best first."""
    cloud = Cloud(model.points.astype(float), model.spacing)
    if model.yaw_period == 0:
        freedom = Freedom(freedom.position, freedom.height, 0.0)
    starts = []
    for point in candidates(evidence, model):
        turned = [
            fit(evidence, cloud, se3.from_yaw(point, yaw), freedom, COARSE_CUTS_PX, COARSE_PX)
            for yaw in model.search_yaws()
        ]
        starts.append(max(turned, key=lambda one: one.score))
    enough = POOR_SHARE * max((one.score for one in starts), default=0.0)
    fits = [
        fit(evidence, cloud, start.T_world_obj, freedom, FINE_CUTS_PX)
        for start in starts
        if start.score > 0 and start.score >= enough
    ]
    fits.sort(key=lambda one: -one.score)
    return _distinct(fits, model.radius)


def candidates(evidence: Sequence[Evidence], model: ObjectModel) -> list[Array]:
    """Places ``(3,)`` of the object's origin that patches of its colours suggest, the most likely first."""
    votes: list[tuple[Array, float]] = []
    middle = model.height + model.middle_height
    for one in evidence:
        for blob in find_blobs(one.probability, 12, BLOBS_PER_VIEW):
            point = intersect_plane(one.view.camera, one.view.T_world_cam, blob.centre, middle)
            distance = float(np.linalg.norm(point - one.view.T_world_cam[:3, 3]))
            expected = (one.view.camera.focal_px / distance) ** 2 * model.points.std(axis=0)[:2].prod() * 12
            # The pixel that the plane's point comes from must lie ahead of the camera, not behind it.
            if (point - one.view.T_world_cam[:3, 3]) @ one.view.T_world_cam[:3, 2] > 0:
                votes.append((point, min(blob.area / max(expected, 1.0), 1.0) * (1.0 if blob.whole else 0.3)))
    places: list[Array] = []
    strength: list[float] = []
    for point, weight in sorted(votes, key=lambda vote: -vote[1]):
        near = [
            i for i, place in enumerate(places) if np.linalg.norm(place[:2] - point[:2]) < 0.6 * model.radius
        ]
        if near:
            i = near[0]
            places[i] = (places[i] * strength[i] + point * weight) / (strength[i] + weight)
            strength[i] += weight
        else:
            places.append(point)
            strength.append(weight)
    order = np.argsort(-np.array(strength), kind="stable")[:MAX_CANDIDATES]
    order = [i for i in order if strength[i] >= WEAK_SHARE * max(strength)]
    return [np.array([places[i][0], places[i][1], model.height]) for i in order]


def canonical(T_world_obj: Array, model: ObjectModel) -> Array:
    """The same pose with its yaw brought to within half a period of the demonstrations' middle yaw."""
    if model.yaw_period == 0:
        return se3.from_yaw(T_world_obj[:3, 3], 0.0)
    turn = se3.wrap_angle(se3.yaw_of(T_world_obj) - model.yaw_centre, model.yaw_period)
    return se3.from_yaw(T_world_obj[:3, 3], model.yaw_centre + turn)


def _distinct(fits: list[Fit], radius: float) -> list[Fit]:
    kept: list[Fit] = []
    for one in fits:
        places = [other.T_world_obj[:2, 3] for other in kept]
        if all(np.linalg.norm(one.T_world_obj[:2, 3] - place) > 0.7 * radius for place in places):
            kept.append(one)
    return kept


def _ignorance() -> Array:
    return np.diag([1.0, 1.0, 1.0, UNKNOWN_YAW_STD**2])
