"""Bundle adjustment of one camera and many features (Gauss-Newton with the features eliminated)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.calibration.observations import Observations, sums
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array

NEAR_M = 1e-3
# How far a feature may be from the body's origin, as a standard deviation: keeps equations solvable, no more.
PRIOR_M = 10.0


@dataclass(frozen=True)
class Problem:
    """What is adjusted.

    Attributes:
        observations: Where the tracks were seen.
        feature: Feature of each track ``(n_tracks,)``, from 0; tracks of one feature share its place.
        weights: Weight of each track ``(n_tracks,)``.
        scale_px: Residuals beyond this count by their length and not by its square (pseudo-Huber loss).
        free_focal: Whether the focal length is adjusted too.
    """

    observations: Observations
    feature: NDArray[Any]
    weights: Array
    scale_px: float
    free_focal: bool

    @property
    def n_features(self) -> int:
        """How many features there are."""
        return int(self.feature.max(initial=-1)) + 1

    @property
    def feature_of_place(self) -> NDArray[Any]:
        """Feature of each place ``(m,)``."""
        return self.feature[self.observations.track]


@dataclass(frozen=True)
class Normal:
    """Normal equations with the features apart, for 6 or 7 numbers of the camera.

    Attributes:
        camera: Information ``(features, k, k)`` that each feature brings about the camera.
        features: Information ``(features, 3, 3)`` about each feature.
        cross: Both ``(features, k, 3)``.
        camera_gradient: Right-hand side ``(features, k)`` that each feature brings.
        feature_gradient: Right-hand side ``(features, 3)``.
    """

    camera: Array
    features: Array
    cross: Array
    camera_gradient: Array
    feature_gradient: Array

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array]:
        """Information ``(features, k, k)`` and right-hand side about the camera, the features eliminated."""
        eliminate = self.cross @ np.linalg.inv(damped(self.features, damping))
        information = self.camera - eliminate @ np.swapaxes(self.cross, 1, 2)
        gradient = self.camera_gradient - (eliminate @ self.feature_gradient[..., None])[..., 0]
        return information, gradient


def damped(matrices: Array, damping: float) -> Array:
    """Matrices ``(..., k, k)`` with their diagonals enlarged."""
    return matrices * (1 + damping * np.eye(matrices.shape[-1]))


def points_in_camera(camera: Camera, points: Array, T_mount_body: Array) -> Array:
    """Points ``(m, 3)`` of the body in the camera's frame, each at its own time."""
    in_mount = (T_mount_body[:, :3, :3] @ points[..., None])[..., 0] + T_mount_body[:, :3, 3]
    return (in_mount - camera.T_mount_cam[:3, 3]) @ camera.T_mount_cam[:3, :3]


def residuals(camera: Camera, points: Array, T_mount_body: Array, uv: Array) -> tuple[Array, Array]:
    """Residuals ``(m, 2)`` in pixels of points ``(m, 3)``, and these in the camera's frame."""
    p_cam = points_in_camera(camera, points, T_mount_body)
    depth = np.maximum(p_cam[:, 2:], NEAR_M)
    seen = p_cam[:, :2] / depth * np.array([camera.fx, camera.fy]) + np.array([camera.cx, camera.cy])
    return seen - uv, p_cam


def triangulate(camera: Camera, observations: Observations, feature: NDArray[Any]) -> Array:
    """Places ``(n, 3)`` in the body that least squares of the projection's linear form give each feature.

    Args:
        camera: The camera.
        observations: Where the tracks were seen.
        feature: Feature of each track ``(n_tracks,)``.
    """
    index, n = feature[observations.track], int(feature.max(initial=-1)) + 1
    R, p = observations.T_mount_body[:, :3, :3], observations.T_mount_body[:, :3, 3]
    R_cam_mount = camera.T_mount_cam[:3, :3].T
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    xy = (observations.uv - centre) / focal
    rows = R_cam_mount[:2] - xy[:, :, None] * R_cam_mount[2]
    A, b = rows @ R, -(rows @ (p - camera.T_mount_cam[:3, 3])[..., None])[..., 0]
    AtA, Atb = np.swapaxes(A, 1, 2) @ A, (np.swapaxes(A, 1, 2) @ b[..., None])[..., 0]
    information = sums(index, AtA, n) + 1e-6 * np.eye(3)
    return np.asarray(np.linalg.solve(information, sums(index, Atb, n)[..., None])[..., 0], float)


def normal_equations(camera: Camera, points: Array, problem: Problem) -> Normal:
    """Linearise at a camera and at features ``(n, 3)``; the camera turns and moves in its mount's axes."""
    seen, feature = problem.observations, problem.feature_of_place
    r, p_cam = residuals(camera, points[feature], seen.T_mount_body, seen.uv)
    depth, focal = np.maximum(p_cam[:, 2], NEAR_M), np.array([camera.fx, camera.fy])
    by_p_cam = np.zeros((len(r), 2, 3))
    by_p_cam[:, [0, 1], [0, 1]] = focal / depth[:, None]
    by_p_cam[:, :, 2] = -p_cam[:, :2] * focal / depth[:, None] ** 2
    by_mount = by_p_cam @ camera.T_mount_cam[:3, :3].T
    # A turn w of the camera moves a point at d from it by -w x d, seen from the camera.
    d = p_cam @ camera.T_mount_cam[:3, :3].T
    parts = [np.cross(by_mount, d[:, None]), -by_mount]
    if problem.free_focal:
        parts.append((p_cam[:, :2] / depth[:, None] * focal)[:, :, None])
    by_camera, by_point = np.concatenate(parts, axis=2), by_mount @ seen.T_mount_body[:, :3, :3]
    weight = problem.weights[seen.track] / np.sqrt(1 + (r**2).sum(axis=1) / problem.scale_px**2)
    weighted_camera = np.swapaxes(weight[:, None, None] * by_camera, 1, 2)
    weighted_point = np.swapaxes(weight[:, None, None] * by_point, 1, 2)
    n, r = problem.n_features, r[..., None]
    prior = (problem.scale_px / PRIOR_M) ** 2
    return Normal(
        camera=sums(feature, weighted_camera @ by_camera, n),
        features=sums(feature, weighted_point @ by_point, n) + prior * np.eye(3),
        cross=sums(feature, weighted_camera @ by_point, n),
        camera_gradient=-sums(feature, (weighted_camera @ r)[..., 0], n),
        feature_gradient=-sums(feature, (weighted_point @ r)[..., 0], n) - prior * points,
    )


def moved(camera: Camera, step: Array) -> Camera:
    """A camera after a step: rotation vector, displacement, change of the focal length's logarithm."""
    T = se3.transform(
        se3.exp_so3(step[:3]) @ camera.T_mount_cam[:3, :3], camera.T_mount_cam[:3, 3] + step[3:6]
    )
    grown = float(np.exp(step[6])) if len(step) > 6 else 1.0
    return replace(camera, T_mount_cam=T, fx=camera.fx * grown, fy=camera.fy * grown)


def adjust(camera: Camera, points: Array, problem: Problem, iterations: int = 20) -> tuple[Camera, Array]:
    """Minimise the robust sum of residuals over the camera and the features (Levenberg-Marquardt).

    Args:
        camera: Where to begin.
        points: Features ``(n, 3)`` in the body to begin with.
        problem: What is adjusted to what.
        iterations: At most so many steps.

    Returns:
        The camera and the features.
    """
    damping, cost = 1e-4, _cost(camera, points, problem)
    for _ in range(iterations):
        normal = normal_equations(camera, points, problem)
        for _attempt in range(10):
            step, point_steps = _step(normal, damping)
            trial, trial_points = moved(camera, step), points + point_steps
            trial_cost = _cost(trial, trial_points, problem)
            if trial_cost <= cost:
                break
            damping *= 8
        else:
            return camera, points
        gain, camera, points, cost = cost - trial_cost, trial, trial_points, trial_cost
        damping = max(damping / 8, 1e-9)
        if gain < 1e-6 * cost:
            break
    return camera, points


def _step(normal: Normal, damping: float) -> tuple[Array, Array]:
    information, gradient = normal.reduced(damping)
    total = information.sum(axis=0) + damping * np.diag(np.diag(normal.camera.sum(axis=0)))
    step = np.linalg.solve(total, gradient.sum(axis=0))
    left = normal.feature_gradient - np.swapaxes(normal.cross, 1, 2) @ step
    return step, np.linalg.solve(damped(normal.features, damping), left[..., None])[..., 0]


def _cost(camera: Camera, points: Array, problem: Problem) -> float:
    seen = problem.observations
    r, _ = residuals(camera, points[problem.feature_of_place], seen.T_mount_body, seen.uv)
    loss = 2 * problem.scale_px**2 * (np.sqrt(1 + (r**2).sum(axis=1) / problem.scale_px**2) - 1)
    prior = (problem.scale_px * points / PRIOR_M) ** 2
    return float((problem.weights[seen.track] * loss).sum() + prior.sum())
