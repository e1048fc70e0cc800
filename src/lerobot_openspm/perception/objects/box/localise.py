"""Finding an object known by its box in a segmenter's masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import intersect_plane
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.box.box import Box
from lerobot_openspm.perception.objects.box.outline import OutlineFit, fit_outlines, outline, overlap
from lerobot_openspm.perception.objects.mask_association import Instances, Sighting, sightings, whole_mask
from lerobot_openspm.perception.objects.model import BoxModel
from lerobot_openspm.perception.objects.shape import fitting
from lerobot_openspm.perception.objects.yaw import canonical
from lerobot_openspm.types import UNKNOWN_YAW_STD, PoseEstimate, View

# A box turned by more than this from where a fit begins may slip into a turn by a quarter.
START_YAWS = np.arange(4) * np.pi / 4
# Two bodies nearer than this share of their radius are one.
SAME_PLACE = 0.7


@dataclass(frozen=True)
class Placed:
    """A body fitted to one object's masks, and how well it covers them in all views."""

    fit: OutlineFit
    score: float


def localise_box(views: Mapping[str, View], model: BoxModel, instances: Instances) -> PoseEstimate:
    """Find an object known by its box in the views of one moment.

    The covariance follows from how the pixels of the outlines bind the pose, in the views that show the
    object, from what remains of their residuals, and from the segmenter's confidence.

    Args:
        views: Views by camera name.
        model: The object.
        instances: What a segmenter found of its phrase, by camera; any number of instances in each.
    """
    radius = float(np.hypot(model.size[0], model.size[1])) / 2
    found = sightings(views, instances, model.height + model.size[2] / 2, radius)
    placed = [(place(views, sighting, model), sighting) for sighting in found]
    placed.sort(key=lambda pair: -pair[0].score)
    placed = _distinct(placed, radius)
    if not placed:
        return PoseEstimate("not_found", np.eye(4), np.diag([1.0, 1.0, 1.0, UNKNOWN_YAW_STD**2]), 0.0, {})
    best, sighting = placed[0]
    scores = [one.score for one, _ in placed]
    status, confidence = fitting.verdict(scores, model.typical_overlap)
    places = [canonical(one.fit.body.T_world_obj, model.box_period, model.yaw_centre) for one, _ in placed]
    masks = {camera: one.mask for camera, one in sighting.items()}
    alike = tuple(places[1 : 1 + fitting.others(scores, model.typical_overlap)])
    return PoseEstimate(status, places[0], best.fit.covariance, confidence, masks, others=alike)


def place(views: Mapping[str, View], sighting: Sighting, model: BoxModel) -> Placed:
    """Fit the model's body, on its support plane, to one object's masks."""
    outlines = [outline(views[camera], one.mask, one.confidence) for camera, one in sighting.items()]
    start = _start(views, sighting, model)
    yaws = np.zeros(1) if model.is_round else START_YAWS
    fits = [fit_outlines(outlines, Box(se3.from_yaw(start, yaw), model.size, model.is_round)) for yaw in yaws]
    best = min(fits, key=lambda one: one.residual_px)
    return Placed(best, coverage(views, sighting, best.body))


def coverage(views: Mapping[str, View], sighting: Sighting, body: Box) -> float:
    """How well a body covers the masks, from 0 to 1; a view that should show it but does not counts as 0."""
    overlaps = [
        overlap(view, sighting[camera].mask if camera in sighting else None, body)
        for camera, view in views.items()
    ]
    return fitting.score(np.array(overlaps))


def _distinct(placed: list[tuple[Placed, Sighting]], radius: float) -> list[tuple[Placed, Sighting]]:
    """Those that are not at the place of a better one: a part of a mask is no second object."""
    kept: list[tuple[Placed, Sighting]] = []
    for one in placed:
        place_of = one[0].fit.body.T_world_obj[:2, 3]
        others = [other.fit.body.T_world_obj[:2, 3] for other, _ in kept]
        if all(np.linalg.norm(place_of - other) > SAME_PLACE * radius for other in others):
            kept.append(one)
    return kept


def _start(views: Mapping[str, View], sighting: Sighting, model: BoxModel) -> Array:
    """Footprint's centre ``(3,)`` on the support plane to start from: where the masks' centres meet."""
    blobs = {camera: blob for camera, one in sighting.items() if (blob := whole_mask(one.mask))}
    names = [camera for camera, blob in blobs.items() if blob.whole] or list(blobs)
    middle = model.height + model.size[2] / 2
    points = [intersect_plane(views[n].camera, views[n].T_world_cam, blobs[n].centre, middle) for n in names]
    return np.array([*np.mean(points, axis=0)[:2], model.height])
