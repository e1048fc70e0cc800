"""Rigid transforms as ``(..., 4, 4)`` float64 arrays, batched over every leading axis.

``T_a_b`` takes coordinates in frame b to coordinates in frame a, so adjacent frames match by eye:
``T_a_c = T_a_b @ T_b_c``. Rotations that arrive as quaternions say their order in the name; increments
are rotation vectors (axis times angle, radians).
"""

from __future__ import annotations

# SciPy has no stubs, and T and R are the project's names for transforms and rotations, not constants.
# pyright: reportMissingTypeStubs=false, reportConstantRedefinition=false
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# One radian of rotation weighs as much as this many metres wherever a single distance between poses is
# needed: about the length of a hand, so that both parts move the fingertips by the same amount.
METRES_PER_RADIAN = 0.1


def transform(rotation: ArrayLike, position: ArrayLike) -> Array:
    """Build transforms from rotation matrices ``(..., 3, 3)`` and positions ``(..., 3)`` in metres."""
    rotation, position = np.asarray(rotation, float), np.asarray(position, float)
    batch = np.broadcast_shapes(rotation.shape[:-2], position.shape[:-1])
    T = np.zeros((*batch, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, position, 1.0
    return T


def inverse(T_a_b: ArrayLike) -> Array:
    """Return ``T_b_a`` for transforms ``(..., 4, 4)``, by transposition rather than elimination."""
    T_a_b = np.asarray(T_a_b, float)
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return transform(R_b_a, -(R_b_a @ T_a_b[..., :3, 3:])[..., 0])


def exp_so3(rotvec: ArrayLike) -> Array:
    """Rotation matrices ``(..., 3, 3)`` of rotation vectors ``(..., 3)`` in radians, of any length."""
    rotvec = np.asarray(rotvec, float)
    return Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix().reshape(*rotvec.shape[:-1], 3, 3)


def log_so3(R: ArrayLike) -> Array:
    """Rotation vectors ``(..., 3)`` of at most pi radians, of rotation matrices ``(..., 3, 3)``."""
    R = np.asarray(R, float)
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*R.shape[:-2], 3)


def matrix_from_quat_xyzw(quat_xyzw: ArrayLike) -> Array:
    """Rotation matrices ``(..., 3, 3)`` of unit quaternions ``(..., 4)`` in x, y, z, w order."""
    quat_xyzw = np.asarray(quat_xyzw, float)
    return Rotation.from_quat(quat_xyzw.reshape(-1, 4)).as_matrix().reshape(*quat_xyzw.shape[:-1], 3, 3)


def from_yaw(position: ArrayLike, yaw: ArrayLike) -> Array:
    """Transforms of positions ``(..., 3)`` turned by ``yaw`` ``(...)`` radians about the vertical axis."""
    yaw = np.asarray(yaw, float)
    return transform(exp_so3(np.stack([0 * yaw, 0 * yaw, yaw], axis=-1)), position)


def yaw_of(T: ArrayLike) -> Array:
    """Yaw ``(...)`` in radians of transforms ``(..., 4, 4)``: the heading of their x axis."""
    T = np.asarray(T, float)
    return np.arctan2(T[..., 1, 0], T[..., 0, 0])


def wrap_angle(angle: ArrayLike, period: float = 2 * np.pi) -> Array:
    """Bring angles into ``[-period / 2, period / 2)`` radians."""
    return (np.asarray(angle, float) + period / 2) % period - period / 2


def yaw_equivalents(T_world_obj: Array, period: float) -> list[Array]:
    """Poses ``(4, 4)`` in which an object looks as in the given one, if a turn by `period` changes nothing.

    A body of revolution (period 0) has no yaw to choose: the given pose stands for all.
    """
    count = max(1, round(2 * np.pi / period)) if period > 0 else 1
    return [T_world_obj @ from_yaw(np.zeros(3), np.asarray(k * period)) for k in range(count)]


def apply(T_a_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Take points ``(..., n, 3)`` in frame b to frame a with transforms ``(..., 4, 4)``."""
    T_a_b, points_b = np.asarray(T_a_b, float), np.asarray(points_b, float)
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return points_b @ R_b_a + T_a_b[..., None, :3, 3]


def increment(T_a_from: ArrayLike, T_a_to: ArrayLike) -> Array:
    """The step ``(..., 6)`` in frame a between two poses: displacement, then rotation vector.

    The rotation is left-multiplied, as the actions of operational-space controllers are:
    ``R_a_to = exp_so3(step[3:]) @ R_a_from``.
    """
    T_a_from, T_a_to = np.asarray(T_a_from, float), np.asarray(T_a_to, float)
    turn = T_a_to[..., :3, :3] @ np.swapaxes(T_a_from[..., :3, :3], -1, -2)
    return np.concatenate([T_a_to[..., :3, 3] - T_a_from[..., :3, 3], log_so3(turn)], axis=-1)


def apply_increment(T_a_from: ArrayLike, step: ArrayLike) -> Array:
    """Inverse of :func:`increment`: move poses ``(..., 4, 4)`` by steps ``(..., 6)`` in frame a."""
    T_a_from, step = np.asarray(T_a_from, float), np.asarray(step, float)
    rotation = exp_so3(step[..., 3:]) @ T_a_from[..., :3, :3]
    return transform(rotation, T_a_from[..., :3, 3] + step[..., :3])


def distances(T_a_b: ArrayLike, T_a_c: ArrayLike) -> tuple[Array, Array]:
    """Distance in metres and angle in radians, each ``(...)``, between poses ``(..., 4, 4)``."""
    step = increment(T_a_b, T_a_c)
    return np.linalg.norm(step[..., :3], axis=-1), np.linalg.norm(step[..., 3:], axis=-1)


def distance(T_a_b: ArrayLike, T_a_c: ArrayLike) -> Array:
    """One distance ``(...)`` in metres between poses, a radian counted as :data:`METRES_PER_RADIAN`."""
    metres, radians = distances(T_a_b, T_a_c)
    return metres + METRES_PER_RADIAN * radians


def is_rigid(T: ArrayLike, tolerance: float = 1e-4) -> bool:
    """Whether every ``(..., 4, 4)`` matrix is finite, orthonormal, right-handed and ends in 0 0 0 1."""
    T = np.asarray(T, float)
    if T.shape[-2:] != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[..., :3, :3]
    if np.abs(R).max(initial=0.0) > 1 + tolerance:  # products of huge numbers would overflow
        return False
    orthonormal = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0) < tolerance
    right_handed = bool((np.linalg.det(R) > 0).all())
    bottom = np.abs(T[..., 3, :] - np.array([0, 0, 0, 1.0])).max(initial=0.0) < tolerance
    return bool(orthonormal and right_handed and bottom)
