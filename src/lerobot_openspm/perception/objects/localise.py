"""Finding learned objects in new images, whatever they are known by.

An object known by its shape: candidates from patches of foreground (its colours, or a segmenter's masks),
poses by aligning silhouettes. Those known by patches or boxes are found in modules of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lerobot_openspm.errors import ObservationError, PerceptionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import intersect_plane, project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception import colour
from lerobot_openspm.perception.blobs import find_blobs
from lerobot_openspm.perception.objects.box.localise import localise_box
from lerobot_openspm.perception.objects.mask_association import Instances
from lerobot_openspm.perception.objects.model import BoxModel, KnownObject, ObjectModel, PatchModel
from lerobot_openspm.perception.objects.patches.patches import localise_patches
from lerobot_openspm.perception.objects.shape.fitting import (
    COARSE_PX,
    Cloud,
    Evidence,
    Fit,
    PosePrior,
    fit,
    others,
    verdict,
)
from lerobot_openspm.perception.objects.yaw import canonical
from lerobot_openspm.types import (
    UNKNOWN_YAW_STD,
    Mask,
    PoseEstimate,
    Segmenter,
    Support,
    View,
)

COARSE_CUTS_PX = (30.0, 30.0, 20.0, 12.0)
FINE_CUTS_PX = (6.0, 4.0, 3.0, 3.0)
BLOBS_PER_VIEW = 3
MAX_CANDIDATES = 3
# Candidates with under 20 % of the best one's colour evidence are dropped.
WEAK_SHARE = 0.2
# Candidates that fit less than 70 % as well as the best one are not fitted more finely.
POOR_SHARE = 0.7
# Corners of a box of unit size that stands on its origin.
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
# Visibility is estimated on every 5th point.
SHARE_STEP = 5
# An object that is followed: how far from where it is expected it is looked for before everywhere else, and
# how well it must be seen there for that to be left out.
NEARBY_CUTS_PX = (12.0, 6.0, 4.0, 3.0)
NEARBY_M, NEARBY_HEIGHT_M, NEARBY_RAD = 0.03, 0.003, 0.3
NEARBY_CONFIDENCE = 0.9
# An object this far above or below the plane it was learned on does not stand there.
LIFTED_M = 0.005


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


def localise_all(
    views: Mapping[str, View],
    models: Mapping[str, KnownObject],
    segmenter: Segmenter | None = None,
    hidden: Mapping[str, Mask] | None = None,
    expected: Mapping[str, Array] | None = None,
) -> dict[str, PoseEstimate]:
    """Find several objects in the views of one moment; a segmenter is asked once for all of them.

    Args:
        views: Views by camera name.
        models: The objects by phrase.
        segmenter: Finds the masks of objects that were learned from a segmenter's; None if none were.
        hidden: Pixels ``(H, W)`` by camera name that something may be in front of.
        expected: Poses ``(4, 4)`` by phrase at which objects are looked for first.

    Raises:
        ObservationError: There is no view, or one is malformed.
        PerceptionError: An object needs a segmenter and there is none, or the segmenter cannot be used.
    """
    prepared = {camera: prepare(view) for camera, view in views.items()}
    instances = segmenter.segment(views, list(models)) if segmenter is not None and models else {}
    return {
        name: localise(prepared, model, None, instances.get(name), hidden, (expected or {}).get(name))
        for name, model in models.items()
    }


def localise(
    views: Mapping[str, View | Prepared],
    model: KnownObject,
    freedom: PosePrior | None = None,
    instances: Instances | None = None,
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
        instances: What a segmenter found of the object's phrase, by camera; for objects that were learned
            from a segmenter's masks.
        hidden: Pixels ``(H, W)`` by camera name that something may be in front of; no evidence.
        T_expected: Pose ``(4, 4)`` at which the object is looked for first; elsewhere only if it is not
            there. An object known by a box is sought in all masks, whatever these two say; they only tell
            how much of it is in sight.

    Raises:
        ObservationError: There is no view, or one is malformed.
        PerceptionError: The object was learned from masks, and none are given.
    """
    if not views:
        raise ObservationError("no camera views to look for an object in; pass at least one")
    prepared = [view if isinstance(view, Prepared) else prepare(view) for view in views.values()]
    plain = {name: one.view for name, one in zip(views, prepared, strict=True)}
    hidden = hidden or {}
    if isinstance(model, PatchModel):
        return localise_patches(plain, model, hidden, T_expected)
    if isinstance(model, BoxModel):
        found = localise_box(plain, model, _required(instances, model.name))
        place = found.T_world_obj if found.status == "found" or T_expected is None else T_expected
        corners = model.size * CORNERS
        return replace(found, visible=seen_share(plain, hidden, se3.apply(place, corners)))
    evidence = _evidence(plain, prepared, model, instances, hidden)
    return _localise_shape(plain, evidence, model, freedom or PosePrior(), hidden, T_expected)


def _localise_shape(
    views: Mapping[str, View],
    evidence: Sequence[Evidence],
    model: ObjectModel,
    freedom: PosePrior,
    hidden: Mapping[str, Mask],
    T_expected: Array | None,
) -> PoseEstimate:
    masks = {name: one.probability > 0.5 for name, one in zip(views, evidence, strict=True)}
    cloud = Cloud(model.points.astype(float), model.spacing)

    def share(T_world_obj: Array) -> float:
        return seen_share(views, hidden, se3.apply(T_world_obj, cloud.points[::SHARE_STEP]))

    if T_expected is not None:
        there = fit(evidence, cloud, T_expected, _nearby(model, T_expected), NEARBY_CUTS_PX)
        if there.score >= NEARBY_CONFIDENCE * model.typical_overlap:
            return _estimate([there], model, masks, share(there.T_world_obj))
    fits = search(evidence, model, freedom)
    if not fits:
        in_sight = 1.0 if T_expected is None else share(T_expected)
        return PoseEstimate("not_found", np.eye(4), _ignorance(), 0.0, masks, in_sight)
    estimate = _estimate(fits, model, masks, 1.0)
    place = fits[0].T_world_obj if T_expected is None or estimate.status == "found" else T_expected
    return replace(estimate, visible=share(place))


def _estimate(
    fits: Sequence[Fit], model: ObjectModel, masks: dict[str, Mask], visible: float
) -> PoseEstimate:
    """The best of several fits, the best first, and what the others say of it."""
    best, scores = fits[0], [one.score for one in fits]
    status, confidence = verdict(scores, model.typical_overlap)
    places = [canonical(one.T_world_obj, model.yaw_period, model.yaw_centre) for one in fits]
    covariance = best.covariance.copy()
    if model.yaw_period == 0:
        covariance[3, :] = covariance[:, 3] = 0
        covariance[3, 3] = UNKNOWN_YAW_STD**2
    support, alike = (
        _support(best, model, masks),
        tuple(places[1 : 1 + others(scores, model.typical_overlap)]),
    )
    return PoseEstimate(status, places[0], covariance, confidence, masks, visible, support, alike)


def _support(best: Fit, model: ObjectModel, masks: Mapping[str, Mask]) -> Support:
    """What a fit rests on: views that explain the mask equally well are consistent."""
    seen = best.overlaps[np.isfinite(best.overlaps)]
    consistency = float(seen.min() / max(seen.max(), 1e-6)) if len(seen) else 0.0
    area = float(sum(np.count_nonzero(mask) for mask in masks.values()))
    return Support("shape", area, consistency, model.typical_overlap)


def _nearby(model: ObjectModel, T_expected: Array) -> PosePrior:
    """An object that is followed keeps about its yaw, and its height but for one in the air."""
    is_lifted = abs(float(T_expected[2, 3]) - model.height) > LIFTED_M
    return PosePrior(
        NEARBY_M, NEARBY_HEIGHT_M if is_lifted else 0.0, 0.0 if model.yaw_period == 0 else NEARBY_RAD
    )


def seen_share(views: Mapping[str, View], hidden: Mapping[str, Mask], points_world: Array) -> float:
    """Share of points ``(n, 3)`` that are in the picture and not hidden, in the view that shows most."""
    shares = [0.0]
    for name, view in views.items():
        uv, depth = project(view.camera, view.T_world_cam, points_world)
        uv = np.nan_to_num(uv, nan=-1.0)
        size = np.array([view.camera.width, view.camera.height])
        inside = (depth > 0) & (uv >= 0).all(1) & (uv <= size - 1).all(1)
        if name in hidden:
            inside[inside] = ~hidden[name][tuple(np.rint(uv[inside]).astype(int).T[::-1])]
        shares.append(float(inside.mean()))
    return max(shares)


def _evidence(
    views: Mapping[str, View],
    prepared: Sequence[Prepared],
    model: ObjectModel,
    instances: Instances | None,
    hidden: Mapping[str, Mask],
) -> list[Evidence]:
    """Every view with the foreground probability of the object's pixels, and what of it is in sight."""
    if model.log_odds is None:
        evidence = masked_evidence(views, _required(instances, model.name))
    else:
        evidence = [Evidence(one.view, colour.foreground(one.bins, model.log_odds)) for one in prepared]
    visible = [None if name not in hidden else 1 - hidden[name].astype(np.float32) for name in views]
    return [replace(one, visible=mask) for one, mask in zip(evidence, visible, strict=True)]


def masked_evidence(views: Mapping[str, View], instances: Instances) -> list[Evidence]:
    """Every view with all instances of a phrase as foreground, in the order of the views."""
    evidence = []
    for name, view in views.items():
        mask = np.zeros(view.image.shape[:2], np.float32)
        for one in instances.get(name, ()):
            mask[one.mask] = 1.0
        evidence.append(Evidence(view, mask, camera=name))
    return evidence


def _required(instances: Instances | None, name: str) -> Instances:
    if instances is None:
        raise PerceptionError(
            f"{name!r} was learned from a segmenter's masks, and is to be found without them; give the "
            "segmenter that it was learned with"
        )
    return instances


def search(evidence: Sequence[Evidence], model: ObjectModel, freedom: PosePrior) -> list[Fit]:
    """Fits at distinct places, the best first."""
    cloud = Cloud(model.points.astype(float), model.spacing)
    if model.yaw_period == 0:
        freedom = PosePrior(freedom.position, freedom.height, 0.0)
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


def _distinct(fits: list[Fit], radius: float) -> list[Fit]:
    kept: list[Fit] = []
    for one in fits:
        places = [other.T_world_obj[:2, 3] for other in kept]
        if all(np.linalg.norm(one.T_world_obj[:2, 3] - place) > 0.7 * radius for place in places):
            kept.append(one)
    return kept


def _ignorance() -> Array:
    return np.diag([1.0, 1.0, 1.0, UNKNOWN_YAW_STD**2])
