"""What an episode is carried out by, and the scene that this was decided in."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose
from lerobot_openspm.types import SubTask


@dataclass(frozen=True)
class Plan:
    """An entry, carried over to a scene.

    Attributes:
        entry: What is acted by.
        object_poses: Poses ``T_world_obj`` ``(4, 4)`` that the key poses were carried over by: of what the
            hand has touched, from before.
        T_world_ee: The hand's pose ``(4, 4)`` then.
    """

    entry: MemoryEntry
    object_poses: Mapping[str, Array]
    T_world_ee: Array

    def anchors(self, index: int, altered: Collection[str]) -> list[str]:
        """Objects of the key poses from one on, without those that look different by now."""
        ahead = self.entry.key_poses[index:]
        names = dict.fromkeys(name for pose in ahead for name in pose.anchor.objects)
        return [name for name in names if name not in altered]

    def touched(self, passed: Sequence[Target]) -> set[str]:
        """What the hand took hold of or moved at the key poses passed: it is elsewhere from then on."""
        return {name for name in (self._touched(one.key_pose) for one in passed) if name is not None}

    def _touched(self, pose: MemoryKeyPose) -> str | None:
        if pose.phase == "push":  # its anchor may be where the target goes
            return self.sub_task(pose).target
        return pose.anchor.place if pose.phase in ("grasp", "open", "turn") else None

    def sub_task(self, pose: MemoryKeyPose) -> SubTask:
        """The sub-task that a key pose serves."""
        return self.entry.key.sub_tasks[pose.sub_task]

    def regrasped(self, index: int) -> set[str]:
        """What is grasped from a key pose on, within its sub-task: it is not in the hand any more."""
        ahead = self.entry.key_poses[index:]
        own = [pose for pose in ahead if pose.sub_task == ahead[0].sub_task]
        return {pose.anchor.place for pose in own if pose.phase in ("approach", "grasp")}


def until(entry: MemoryEntry, sub_task: int) -> MemoryEntry:
    """An entry without the sub-tasks after one."""
    key = replace(entry.key, sub_tasks=entry.key.sub_tasks[: sub_task + 1])
    return replace(entry, key=key, key_poses=tuple(p for p in entry.key_poses if p.sub_task <= sub_task))
