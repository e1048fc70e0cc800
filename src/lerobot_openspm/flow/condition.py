"""The condition of the flow model, and the frame of its actions.

``paper``: current pose, target pose, their relative pose and the progress, all in the world; actions in the
world. ``equivariant``: the relative pose and the progress in the frame of the target; actions in that frame.
A scene that is moved and turned as a whole looks the same to the second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.types import Conditioning

# Relative poses are given at several scales: the coarse one covers the whole way, the fine ones resolve the
# last centimetres, where at a single scale millimetres would be lost in the noise.
POSITION_SCALES_M = (0.2, 0.03, 0.006)
ROTATION_SCALES_RAD = (1.0, 0.1)
_RELATIVE = 3 * len(POSITION_SCALES_M) + 3 * len(ROTATION_SCALES_RAD)
_COMMON = 3 + len(PHASES)
CONDITION_DIM: dict[Conditioning, int] = {
    "paper": 18 + _RELATIVE + _COMMON,
    "equivariant": _RELATIVE + _COMMON,
}


@dataclass(frozen=True)
class Query:
    """Current pose, target pose and progress: ``c_t`` of the paper, batched over ``(...)``.

    Attributes:
        T_world_ee: Current hand pose ``(..., 4, 4)``.
        T_world_target: Target key pose ``(..., 4, 4)``.
        progress: Fraction ``(...)`` of the segment that is done, the paper's tau, 0 to 1.
        closed: Whether the gripper is closed on the way, ``(...)`` of 0 and 1.
        opening: Gripper opening ``(...)`` as a fraction of the open gripper's.
        phase: Index ``(...)`` into :data:`PHASES` of the phase that ends at the target. The paper's condition
            lacks it, but between the same two poses a carried object moves along an arc through the air, and
            a pushed one along the table.
    """

    T_world_ee: Array
    T_world_target: Array
    progress: Array
    closed: Array
    opening: Array
    phase: NDArray[np.int64]


def progress(T_world_start: ArrayLike, T_world_ee: ArrayLike, T_world_target: ArrayLike) -> Array:
    """Progress tau ``(...)`` along a segment, by the fraction of its length that remains.

    It depends on geometry and not on time, so that it does not run ahead during a pause.
    """
    whole = np.maximum(se3.distance(T_world_start, T_world_target), 1e-3)
    return np.clip(1 - se3.distance(T_world_ee, T_world_target) / whole, 0.0, 1.0)


def encode(query: Query, conditioning: Conditioning) -> Array:
    """Condition vectors ``(..., CONDITION_DIM[conditioning])`` of queries."""
    measures = np.stack([query.progress, query.closed, query.opening], axis=-1).astype(float)
    common = np.concatenate([measures, np.eye(len(PHASES))[query.phase]], axis=-1)
    if conditioning == "equivariant":
        relative = se3.inverse(query.T_world_target) @ query.T_world_ee
        return np.concatenate([_relative_features(relative), common], axis=-1)
    relative = se3.inverse(query.T_world_ee) @ query.T_world_target
    poses = [_pose_features(query.T_world_ee), _pose_features(query.T_world_target)]
    return np.concatenate([*poses, _relative_features(relative), common], axis=-1)


def to_model_frame(actions: ArrayLike, T_world_target: ArrayLike, conditioning: Conditioning) -> Array:
    """Express world actions ``(..., 7)`` in the model's frame: the target's, or the world for "paper"."""
    return _rotate(actions, np.swapaxes(np.asarray(T_world_target)[..., :3, :3], -1, -2), conditioning)


def to_world_frame(actions: ArrayLike, T_world_target: ArrayLike, conditioning: Conditioning) -> Array:
    """Inverse of :func:`to_model_frame`."""
    return _rotate(actions, np.asarray(T_world_target)[..., :3, :3], conditioning)


def _rotate(actions: ArrayLike, R: Array, conditioning: Conditioning) -> Array:
    actions = np.asarray(actions, float)
    if conditioning == "paper":
        return actions
    turned = [(R @ part[..., None])[..., 0] for part in (actions[..., :3], actions[..., 3:6])]
    return np.concatenate([*turned, actions[..., 6:]], axis=-1)


def _relative_features(T: Array) -> Array:
    position, rotvec = T[..., :3, 3], se3.log_so3(T[..., :3, :3])
    parts = [position / POSITION_SCALES_M[0], rotvec / ROTATION_SCALES_RAD[0]]
    parts += [np.tanh(position / scale) for scale in POSITION_SCALES_M[1:]]
    parts += [np.tanh(rotvec / scale) for scale in ROTATION_SCALES_RAD[1:]]
    return np.concatenate(parts, axis=-1)


def _pose_features(T: Array) -> Array:
    """Position in decimetres and the first two columns of the rotation, which vary continuously."""
    columns = np.swapaxes(T[..., :3, :2], -1, -2).reshape(*T.shape[:-2], 6)
    return np.concatenate([T[..., :3, 3] / POSITION_SCALES_M[0], columns], axis=-1)
