"""Training samples: pairs of condition and action chunk from the segments between key poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.flow.condition import Query, encode, progress, to_model_frame
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.types import Conditioning

if TYPE_CHECKING:  # acting imports no mining
    from lerobot_openspm.mining.key_poses import KeyPose
    from lerobot_openspm.mining.signals import Episode

# The hand pauses where it is further than this from its target and its command is below this fraction of the
# episode's median.
PAUSE_DISTANCE_M = 0.012
PAUSE_FRACTION = 0.15


@dataclass(frozen=True)
class SegmentFrames:
    """The `n` frames of all segments of the demonstrations, from which chunks are learned.

    Attributes:
        index: Dataset index ``(n,)`` of the frame.
        episode: Episode index ``(n,)``.
        query: Condition of the frame, batched over ``(n,)``.
        T_world_start: Where the segment began, ``(n, 4, 4)``.
        actions: The chunks that follow, ``(n, H, 7)`` in the world; zero motion after the segment's end.
    """

    index: NDArray[np.int64]
    episode: NDArray[np.int64]
    query: Query
    T_world_start: Array
    actions: Array

    def __len__(self) -> int:
        return len(self.index)


def segment_frames(
    episodes: Sequence[Episode], key_poses: Sequence[Sequence[KeyPose]], robot: RobotModel, chunk_size: int
) -> SegmentFrames:
    """Cut demonstrations into segments and take their frames; pauses and waits for the fingers are left out.

    Raises:
        DatasetError: There is no motion between the key poses.
    """
    segments = [
        _one_segment(episode, before, pose, robot, chunk_size)
        for episode, poses in zip(episodes, key_poses, strict=True)
        for before, pose in zip([0, *(p.frame for p in poses[:-1])], poses, strict=True)
        if pose.frame > before and not pose.dwell
    ]
    segments = [segment for segment in segments if len(segment)]
    if not segments:
        raise DatasetError("the key poses of the dataset have no motion between them; record longer episodes")
    stack = {
        name: np.concatenate([getattr(s.query, name) for s in segments])
        for name in Query.__dataclass_fields__
    }
    return SegmentFrames(
        index=np.concatenate([s.index for s in segments]),
        episode=np.concatenate([s.episode for s in segments]),
        query=Query(**stack),
        T_world_start=np.concatenate([s.T_world_start for s in segments]),
        actions=np.concatenate([s.actions for s in segments]),
    )


def _one_segment(
    episode: Episode, first: int, pose: KeyPose, robot: RobotModel, chunk_size: int
) -> SegmentFrames:
    frames = np.arange(first, pose.frame)
    ahead = frames[:, None] + np.arange(chunk_size)
    actions = episode.actions[np.minimum(ahead, pose.frame - 1)]
    actions[ahead >= pose.frame, :6] = 0.0
    actions[..., 6] = robot.command(pose.closed)
    T_world_ee = episode.T_world_ee[frames]
    away = se3.distance(T_world_ee, pose.T_world_ee)
    effort = np.linalg.norm(actions[:, 0, :6], axis=-1)
    usual = np.median(np.linalg.norm(episode.actions[:, :6], axis=-1))
    keep = (effort > PAUSE_FRACTION * usual) | (away < PAUSE_DISTANCE_M)
    frames, T_world_ee, actions = frames[keep], T_world_ee[keep], actions[keep]
    n = len(frames)
    start = np.broadcast_to(episode.T_world_ee[first], (n, 4, 4))
    target = np.broadcast_to(pose.T_world_ee, (n, 4, 4))
    query = Query(
        T_world_ee=T_world_ee,
        T_world_target=target,
        progress=progress(start, T_world_ee, target),
        closed=np.full(n, float(pose.closed)),
        opening=episode.opening[frames] / max(robot.open_width, 1e-9),
        phase=np.full(n, PHASES.index(pose.phase)),
    )
    index = episode.from_index + frames
    return SegmentFrames(index, np.full(n, episode.index), query, np.array(start), actions)


def perturbed(
    frames: SegmentFrames, robot: RobotModel, std_m: float, std_rad: float, rng: np.random.Generator
) -> SegmentFrames:
    """Displace each frame's hand at random and correct its chunk so that it ends at the same pose.

    In closed loop the hand leaves the demonstrated paths by the errors of model and controller; these samples
    show the way back. The displacement grows with the distance from the target.

    Args:
        frames: The demonstrated frames.
        robot: Gives the gain from action to motion.
        std_m: Standard deviation of the displacement at 7.5 cm or more from the target, metres.
        std_rad: Likewise of the rotation, radians.
        rng: Source of the displacements.
    """
    query, n = frames.query, len(frames)
    away = se3.distance(query.T_world_ee, query.T_world_target)
    size = np.minimum(1.0, 0.25 + away / 0.1)[:, None]
    shift = rng.normal(size=(n, 6)) * size * np.array([std_m] * 3 + [std_rad] * 3)
    moved = se3.apply_increment(query.T_world_ee, shift)
    gains = np.array([robot.metres_per_action] * 3 + [robot.radians_per_action] * 3)
    correction = np.where(gains > 0, -shift / np.maximum(gains, 1e-9), 0.0)
    actions = frames.actions.copy()
    actions[..., :6] += correction[:, None] / actions.shape[1]
    query = Query(
        moved, query.T_world_target, progress(frames.T_world_start, moved, query.T_world_target),
        query.closed, query.opening, query.phase,
    )  # fmt: skip
    return SegmentFrames(frames.index, frames.episode, query, frames.T_world_start, actions)


def conditions_and_chunks(frames: SegmentFrames, conditioning: Conditioning) -> tuple[Array, Array]:
    """Conditions ``(n, condition_dim)``, and chunks ``(n, H, 7)`` in the model's frame."""
    target = frames.query.T_world_target[:, None]
    return encode(frames.query, conditioning), to_model_frame(frames.actions, target, conditioning)


def action_scale(chunks: Array) -> Array:
    """Root mean square ``(7,)`` of the actions, common to translations, to rotations, and the gripper's."""
    groups = [chunks[..., :3], chunks[..., 3:6], chunks[..., 6:]]
    return np.concatenate([np.full(g.shape[-1], max(float(np.sqrt((g**2).mean())), 1e-3)) for g in groups])
