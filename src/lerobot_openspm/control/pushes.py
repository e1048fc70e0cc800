"""The paths of what is pushed, in the demonstration and here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose, Outcome

# The direction of a push shorter than this is within the noise of the object's position.
MIN_PUSH_M = 0.005


@dataclass(frozen=True)
class PushPath:
    """A push in the demonstration and here, each from where the target is to where it should end.

    The object moves in the direction of the hand, and ends before the hand. So the hand's position is kept
    relative to the path: beside the target at its start, and beside the outcome at its end.

    Attributes:
        outcome: Where the object that is pushed belongs.
        shown: Start and end ``(2, 3)`` of the target in the demonstration, in the world.
        now: Start and end ``(2, 3)`` of the target here.
        is_by_landmark: Whether none of its key poses belongs to the target.
    """

    outcome: Outcome
    shown: Array
    now: Array
    is_by_landmark: bool = False

    @property
    def target(self) -> str:
        """The object that is pushed."""
        return self.outcome.target

    def position(self, pose: MemoryKeyPose, poses_shown: Mapping[str, Array]) -> Array:
        """Where the hand goes ``(3,)`` for a key pose of the push."""
        is_at_start = pose.anchor.place == self.target or (self.is_by_landmark and pose.phase == "approach")
        place = 0 if is_at_start else 1
        T_world_ee = pose.anchor.frame(poses_shown) @ pose.T_obj_ee
        turn = _heading(self.now) - _heading(self.shown)
        if min(_length(self.shown), _length(self.now)) < MIN_PUSH_M:
            turn = 0.0
        offset = T_world_ee[:3, 3] - self.shown[place]
        position = self.now[place] + se3.apply(se3.from_yaw(np.zeros(3), turn), offset[None])[0]
        # The path lies at one height. That of its end is known best, because the landmark stands still.
        position[2] = self.now[1, 2] + T_world_ee[2, 3] - self.shown[1, 2]
        return position

    def beyond(self, T_world_ee: Array, T_world_end: Array, object_poses: Mapping[str, Array]) -> float:
        """Metres along the path by which the hand has passed the point where it meets its target.

        There the hand is as far ahead of the target as at the end of the push.

        Args:
            T_world_ee: The hand ``(4, 4)``.
            T_world_end: Where the push ends ``(4, 4)``.
            object_poses: Where its target is, ``T_world_obj`` ``(4, 4)`` by name.
        """
        path = (self.now[1] - self.now[0])[:2]
        meeting = T_world_end[:3, 3] + self.outcome.target_at(object_poses) - self.now[1]
        gone = float((T_world_ee[:3, 3] - meeting)[:2] @ path)
        return gone / max(_length(self.now), MIN_PUSH_M)


def push_paths(entry: MemoryEntry, object_poses: Mapping[str, Array]) -> dict[int, PushPath]:
    """The paths of an entry's pushes by sub-task, of those whose outcome is known."""
    by_landmark = pushed_by_landmark(entry)
    paths: dict[int, PushPath] = {}
    for outcome in _push_outcomes(entry):
        if any(name not in poses for name in outcome.objects for poses in (entry.object_poses, object_poses)):
            continue
        shown = np.stack([outcome.target_at(entry.object_poses), outcome.place_shown(entry.object_poses)])
        now = np.stack([outcome.target_at(object_poses), outcome.place(object_poses)])
        is_by_landmark = outcome.sub_task in by_landmark
        paths[outcome.sub_task] = PushPath(outcome, shown, now, is_by_landmark)
    return paths


def pushed_by_landmark(entry: MemoryEntry) -> dict[int, str]:
    """By sub-task, the targets of an entry's pushes that none of the push's key poses belongs to."""
    return {
        outcome.sub_task: outcome.target
        for outcome in _push_outcomes(entry)
        if not any(
            outcome.target in pose.anchor.objects
            for pose in entry.key_poses
            if pose.sub_task == outcome.sub_task
        )
    }


def pushed(entry: MemoryEntry) -> frozenset[str]:
    """What an entry's pushes move, where it is known to where."""
    return frozenset(outcome.target for outcome in _push_outcomes(entry))


def _push_outcomes(entry: MemoryEntry) -> list[Outcome]:
    """The outcomes of an entry's pushes.

    A sub-task that also grasps its target is no push: the target goes where the hand carries it.
    """
    pushing, grasping = (
        {pose.sub_task for pose in entry.key_poses if pose.phase == phase} for phase in ("push", "grasp")
    )
    return [one for one in entry.outcomes if one.sub_task in pushing - grasping]


def _heading(path: Array) -> float:
    return float(np.arctan2(path[1, 1] - path[0, 1], path[1, 0] - path[0, 0]))


def _length(path: Array) -> float:
    return float(np.linalg.norm(path[1, :2] - path[0, :2]))
