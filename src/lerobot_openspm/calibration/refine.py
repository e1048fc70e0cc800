"""From a first estimate to the last: which tracks to believe, which show one feature, how sure it is."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.calibration.adjust import (
    Problem,
    adjust,
    information,
    positive,
    residuals,
    triangulate,
)
from lerobot_openspm.calibration.initial import possible
from lerobot_openspm.calibration.observations import Observations, sums
from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array

# From coarse to fine, in parts of the image height; tracks worse than BELIEVED times that are left out.
SCALES = tuple(px / 256 for px in (8, 8, 4, 4, 2, 2, 1, 1, 0.5, 0.5))
BELIEVED = 2.0
MIN_TRACKS = 30
# No feature may bring more than this share of what is known about any direction of the camera's pose. One
# that the hand holds while it turns stands still in the hand's camera: the hub of the world, it would seem.
MAX_SHARE = 0.04
# A corner of the hand that many episodes show may bring more.
MAX_SHARED = 0.3
# Tracks nearer to one another than about this are taken for one feature.
FEATURE_SIZES_M = (0.008, 0.005, 0.003)
# Median of the square of a standard normal number.
CHI2_MEDIAN = 0.455
TRACK_ERROR, SAME_FEATURE_CHI2, MAX_APART = 0.4 / 256, 9.0, 4.0

logger = logging.getLogger(__name__)


def refine(camera: Camera, observations: Observations, *, free_focal: bool) -> tuple[Camera, Observations]:
    """Adjust to the tracks that agree, with an ever stricter idea of agreement.

    Returns:
        The camera, and the tracks that it explains.

    Raises:
        CalibrationError: Too few tracks agree.
    """
    believed = observations
    for part in SCALES:
        scale_px = part * camera.height
        points = triangulate(camera, observations, np.arange(observations.n_tracks))
        r, p_cam = residuals(camera, points[observations.track], observations.T_mount_body, observations.uv)
        good = (observations.rms(r) < BELIEVED * scale_px) & possible(
            points, p_cam, observations, camera.mount
        )
        if good.sum() < MIN_TRACKS:
            raise CalibrationError(
                f"only {good.sum()} of {len(good)} features agree on a camera, expected at least "
                f"{MIN_TRACKS}; check --mount and --fov_deg, or give more episodes with --episodes=[...]"
            )
        believed, points = observations.select(good), points[good]
        feature = np.arange(believed.n_tracks)
        problem = Problem(believed, feature, np.ones(believed.n_tracks), scale_px, free_focal)
        problem = with_limited_shares(camera, points, problem, MAX_SHARE)
        camera, _ = adjust(camera, points, problem)
        logger.debug("scale %.2f px: %d tracks", scale_px, believed.n_tracks)
    return camera, believed


def with_limited_shares(camera: Camera, points: Array, problem: Problem, limit: float) -> Problem:
    """The problem with less weight for features that would decide alone."""
    by_camera = information(camera, points, problem).by_camera
    brought = sums(problem.feature_of_place, np.swapaxes(by_camera, 1, 2) @ by_camera, problem.n_features)
    weight = np.ones(len(brought))
    for _ in range(20):
        whiten = np.linalg.inv(np.linalg.cholesky(positive((weight[:, None, None] * brought).sum(0))))
        share = weight * np.linalg.norm(whiten @ brought @ whiten.T, ord=2, axis=(1, 2))
        if share.max() <= 1.2 * limit:
            break
        weight *= np.minimum(1, limit / np.maximum(share, 1e-12))
    return replace(problem, weights=problem.weights * weight[problem.feature])


def refine_with_shared_features(
    camera: Camera, observations: Observations, *, free_focal: bool
) -> tuple[Camera, Array, Problem]:
    """Adjust again, with tracks that meet at one place taken for one feature.

    A corner of the hand that is seen before and after a turn, in one episode and in another, has one place on
    the hand: that tells where on the hand all of them are. A camera on the hand sees things that lie
    elsewhere in every episode: there features are shared within an episode only.

    Returns:
        The camera, the features' places ``(n, 3)`` in the body, and the adjusted problem.
    """
    n, scale_px = observations.n_tracks, SCALES[-1] * camera.height
    places = observations.per_track(np.ones(len(observations.track)))
    group = observations.episode * 0 if camera.mount == "world" else observations.episode
    points, problem = np.zeros((0, 3)), Problem(observations, np.arange(n), 1 / places, scale_px, free_focal)
    for size_m in FEATURE_SIZES_M:
        feature = shared_features(camera, observations, group, size_m)
        for _ in range(2):
            problem = Problem(observations, feature, 1 / np.sqrt(places), scale_px, free_focal)
            points = triangulate(camera, observations, feature)
            problem = with_limited_shares(camera, points, problem, MAX_SHARED)
            camera, points = adjust(camera, points, problem)
            rms = observations.rms(problem.residuals(camera, points))
            alone = rms > max(1.5, 500 * size_m) / 256 * camera.height
            feature = np.where(alone, feature.max() + 1 + np.arange(n), feature)
            feature = np.unique(feature, return_inverse=True)[1]
        logger.debug("features of %.0f mm: %d of %d tracks", 1e3 * size_m, len(points), n)
    return camera, points, problem


def shared_features(
    camera: Camera, observations: Observations, group: NDArray[Any], size_m: float
) -> NDArray[Any]:
    """Number ``(n_tracks,)`` of the feature that each track shows; only tracks of a group share one.

    Tracks are taken in the order of how exactly their place is known. One joins the nearest feature if their
    distance is within what both leave open.
    """
    n = observations.n_tracks
    points = triangulate(camera, observations, np.arange(n))
    problem = Problem(observations, np.arange(n), np.ones(n), 10 * camera.height, False)
    places = observations.per_track(np.ones(len(observations.track)))
    own = information(camera, points, problem).features / places[:, None, None]
    own = own / (TRACK_ERROR * camera.height) ** 2 + 1e-2 * np.eye(3)
    covariance = np.linalg.inv(own)
    feature, first = np.full(n, -1), []
    mean, known = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for i in np.argsort(np.linalg.eigvalsh(covariance)[:, -1]):
        apart = points[i] - mean[: len(first)]
        near = np.linalg.norm(apart, axis=1) < MAX_APART * size_m
        near = np.flatnonzero(near & (group[np.array(first, int)] == group[i]))
        if len(near):
            spread = np.linalg.inv(known[near]) + covariance[i] + size_m**2 * np.eye(3)
            chi2 = (apart[near] * np.linalg.solve(spread, apart[near][..., None])[..., 0]).sum(axis=1)
            if chi2.min() < SAME_FEATURE_CHI2:
                j = feature[i] = near[chi2.argmin()]
                total = known[j] + own[i]
                mean[j] = np.linalg.solve(total, known[j] @ mean[j] + own[i] @ points[i])
                known[j] = total
                continue
        feature[i], mean[len(first)], known[len(first)] = len(first), points[i], own[i]
        first.append(i)
    return feature


def variances(camera: Camera, points: Array, problem: Problem) -> Array:
    """Variances ``(k,)`` of the camera's pose (turn, displacement, logarithm of the focal length).

    Places in a track err alike, so each track counts once. Of two estimates the larger: from how far what
    single tracks ask for is spread, and from the residuals. The first holds whatever the errors are like, but
    knows nothing of a direction about which no track says anything.
    """
    seen = problem.observations
    told = information(camera, points, problem)
    to_camera = np.swapaxes(told.by_camera, 1, 2)
    inverse = np.linalg.inv(positive((to_camera @ told.by_camera).sum(axis=0)))
    spread = inverse @ seen.per_track((to_camera @ told.residuals[..., None])[..., 0]).T
    r = problem.residuals(camera, points)
    alike = problem.weights * seen.per_track(np.ones(len(r)))
    from_residuals = np.diag(inverse) * np.median(r**2) / CHI2_MEDIAN * alike.mean()
    return np.maximum((spread**2).sum(axis=1), from_residuals)
