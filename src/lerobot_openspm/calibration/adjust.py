"""Bundle adjustment of one camera and many features, by SciPy's sparse least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_array

from lerobot_openspm.calibration.observations import Observations, sums
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array

NEAR_M = 1e-3
# Standard deviation of a feature's distance from the body's origin: wide, it only keeps equations solvable.
PRIOR_M = 10.0
MAX_EVALUATIONS = 20


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

    def residuals(self, camera: Camera, points: Array) -> Array:
        """Residuals ``(m, 2)`` in pixels of features ``(n, 3)``."""
        seen = self.observations
        return residuals(camera, points[self.feature_of_place], seen.T_mount_body, seen.uv)[0]

    def robust_weights(self, r: Array) -> Array:
        """Weights ``(m,)`` of places with residuals ``(m, 2)``: the loss lowers those of large residuals."""
        return self.weights[self.observations.track] / np.sqrt(1 + (r**2).sum(axis=1) / self.scale_px**2)


def residuals(camera: Camera, points: Array, T_mount_body: Array, uv: Array) -> tuple[Array, Array]:
    """Residuals ``(m, 2)`` in pixels of points ``(m, 3)`` of the body, each seen at its own time.

    Returns:
        The residuals, and the points in the camera's frame ``(m, 3)``.
    """
    in_mount = (T_mount_body[:, :3, :3] @ points[..., None])[..., 0] + T_mount_body[:, :3, 3]
    p_cam = (in_mount - camera.T_mount_cam[:3, 3]) @ camera.T_mount_cam[:3, :3]
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


def linearise(camera: Camera, points: Array, problem: Problem) -> tuple[Array, Array, Array]:
    """Residuals and their derivatives.

    Args:
        camera: The camera.
        points: Features ``(n, 3)``.
        problem: What is adjusted.

    Returns:
        Residuals ``(m, 2)``; their derivatives ``(m, 2, k)`` by the camera's turn and displacement in its
        mount's axes and, if it is free, by the focal length's logarithm; and ``(m, 2, 3)`` by the feature.
    """
    seen = problem.observations
    r, p_cam = residuals(camera, points[problem.feature_of_place], seen.T_mount_body, seen.uv)
    depth, focal = np.maximum(p_cam[:, 2], NEAR_M), np.array([camera.fx, camera.fy])
    by_p_cam = np.zeros((len(r), 2, 3))
    by_p_cam[:, [0, 1], [0, 1]] = focal / depth[:, None]
    by_p_cam[:, :, 2] = -p_cam[:, :2] * focal / depth[:, None] ** 2
    by_mount = by_p_cam @ camera.T_mount_cam[:3, :3].T
    # A turn w of the camera moves a point at d from it by -w x d, seen from the camera.
    d = p_cam @ camera.T_mount_cam[:3, :3].T
    by_camera = [np.asarray(np.cross(by_mount, d[:, None]), float), -by_mount]
    if problem.free_focal:
        by_camera.append((p_cam[:, :2] / depth[:, None] * focal)[:, :, None])
    return r, np.concatenate(by_camera, axis=2), by_mount @ seen.T_mount_body[:, :3, :3]


@dataclass(frozen=True)
class Information:
    """The linearised problem at a camera and features, with the features eliminated (Schur complement).

    Attributes:
        residuals: Weighted residuals ``(m, 2)``.
        by_camera: Their derivatives ``(m, 2, k)`` by the camera, given that every feature moves to where it
            fits the moved camera best.
        features: Information matrices ``(n, 3, 3)`` of the features for a given camera.
    """

    residuals: Array
    by_camera: Array
    features: Array


def information(camera: Camera, points: Array, problem: Problem) -> Information:
    """Linearise at a camera and features ``(n, 3)``, and eliminate the features."""
    r, by_camera, by_point = linearise(camera, points, problem)
    root, feature, n = np.sqrt(problem.robust_weights(r)), problem.feature_of_place, problem.n_features
    by_camera, by_point = root[:, None, None] * by_camera, root[:, None, None] * by_point
    to_point = np.swapaxes(by_point, 1, 2)
    features = sums(feature, to_point @ by_point, n) + (problem.scale_px / PRIOR_M) ** 2 * np.eye(3)
    follows = np.linalg.solve(features, sums(feature, to_point @ by_camera, n))
    return Information(root[:, None] * r, by_camera - by_point @ follows[feature], features)


def positive(matrix: Array) -> Array:
    """An information matrix with a floor, so that it can be inverted where a direction is unknown."""
    return matrix + 1e-12 * np.trace(matrix) * np.eye(len(matrix))


def moved(camera: Camera, step: Array) -> Camera:
    """A camera after a step: rotation vector, displacement, change of the focal length's logarithm."""
    T = se3.transform(
        se3.exp_so3(step[:3]) @ camera.T_mount_cam[:3, :3], camera.T_mount_cam[:3, 3] + step[3:6]
    )
    grown = float(np.exp(step[6])) if len(step) > 6 else 1.0
    return replace(camera, T_mount_cam=T, fx=camera.fx * grown, fy=camera.fy * grown)


def adjust(camera: Camera, points: Array, problem: Problem) -> tuple[Camera, Array]:
    """Minimise the robust sum of residuals over the camera and the features.

    Args:
        camera: Where to begin.
        points: Features ``(n, 3)`` in the body to begin with.
        problem: What is adjusted to what.

    Returns:
        The camera and the features.
    """
    start, scale, feature = information(camera, points, problem), problem.scale_px, problem.feature_of_place
    # Unknowns are scaled to unit standard deviation: SciPy's iterative solver (LSMR) then needs few steps.
    about_camera = np.einsum("mij,mik->jk", start.by_camera, start.by_camera)
    camera_unit = scale * np.linalg.inv(np.linalg.cholesky(positive(about_camera))).T
    point_unit = scale * np.swapaxes(np.linalg.inv(np.linalg.cholesky(start.features)), 1, 2)
    k, m = len(camera_unit), len(feature)
    columns, ends = _sparsity(k, feature)

    def at(x: Array) -> tuple[Camera, Array]:
        return moved(camera, camera_unit @ x[:k]), points + (point_unit @ x[k:].reshape(-1, 3, 1))[..., 0]

    def errors(x: Array) -> Array:
        return problem.residuals(*at(x)).ravel() / scale

    def jacobian(x: Array) -> csr_array:
        # Derivatives by a turn added to the present one, while the unknown is the turn from the start. The
        # two differ by an invertible matrix, so the minimum is the same.
        _, by_camera, by_point = linearise(*at(x), problem)
        values = np.concatenate([by_camera @ camera_unit, by_point @ point_unit[feature]], axis=2)
        return csr_array((values.ravel() / scale, columns, ends), shape=(2 * m, len(x)))

    def loss(squares: Array) -> Array:
        """Pseudo-Huber loss of the length of a place's residual, shared by its two coordinates."""
        root = np.sqrt(1 + squares.reshape(-1, 2).sum(axis=1))
        weight = problem.weights[problem.observations.track]
        return np.stack([weight * (root - 1), weight / root, np.zeros(m)]).repeat(2, axis=1)

    found = least_squares(
        errors,
        np.zeros(k + points.size),
        jac=jacobian,  # pyright: ignore[reportArgumentType]
        loss=loss,  # pyright: ignore[reportArgumentType]
        ftol=1e-6,
        max_nfev=MAX_EVALUATIONS,
        # Where the hand hardly turns, LSMR's own tolerance of 1e-6 ends millimetres away from the minimum.
        tr_options={"atol": 1e-9, "btol": 1e-9},
    )
    return at(found.x)


def _sparsity(k: int, feature: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where a Jacobian's entries stand: their columns row by row, and where each row ends.

    Each of a place's two rows has `k` entries for the camera, and three for the place's feature.
    """
    m = len(feature)
    of_camera = np.broadcast_to(np.arange(k), (m, 2, k))
    of_point = np.broadcast_to((k + 3 * feature[:, None] + np.arange(3))[:, None], (m, 2, 3))
    return np.concatenate([of_camera, of_point], axis=2).ravel(), (k + 3) * np.arange(2 * m + 1)
