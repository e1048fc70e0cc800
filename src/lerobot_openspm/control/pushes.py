"""Pushes: the hand's place is kept relative to the way of what is pushed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose

# A way shorter than this has no direction that could be told from where the object is seen.
LEAST_WAY_M = 0.005


@dataclass(frozen=True)
class PushWays:
    """A push in the demonstration and here, each from where its target is to where it should end.

    What is pushed moves the way that the hand moves, and ends before the hand. So the hand's place is kept
    relative to the way: beside the target at its start, and beside the outcome at its end.

    Attributes:
        target: The object that is pushed.
        shown: Start and end ``(2, 3)`` of the target in the demonstration, in the world.
        now: Start and end ``(2, 3)`` of the target here.
    """

    target: str
    shown: Array
    now: Array

    def position(self, pose: MemoryKeyPose, layout_shown: Mapping[str, Array]) -> Array:
        """Where the hand goes ``(3,)`` for a key pose of the push."""
        place = 0 if pose.anchor.place == self.target else 1
        T_world_ee = pose.anchor.frame(layout_shown) @ pose.T_obj_ee
        turn = _heading(self.now) - _heading(self.shown)
        if min(_length(self.shown), _length(self.now)) < LEAST_WAY_M:
            turn = 0.0
        offset = T_world_ee[:3, 3] - self.shown[place]
        position = self.now[place] + se3.apply(se3.from_yaw(np.zeros(3), turn), offset[None])[0]
        # All of the way lies at one height, which is known best from what stands still.
        position[2] = self.now[1, 2] + T_world_ee[2, 3] - self.shown[1, 2]
        return position

    def beyond(self, T_world_ee: Array, T_world_end: Array, target: Array) -> float:
        """How far the hand has gone beyond where it meets its target, along the way, in metres.

        It meets the target where it is as far ahead of it as at the end of the push.

        Args:
            T_world_ee: The hand ``(4, 4)``.
            T_world_end: Where the push ends ``(4, 4)``.
            target: Where the target is ``(3,)``.
        """
        way = (self.now[1] - self.now[0])[:2]
        meeting = T_world_end[:3, 3] + target - self.now[1]
        gone = float((T_world_ee[:3, 3] - meeting)[:2] @ way)
        return gone / max(_length(self.now), LEAST_WAY_M)


def push_ways(entry: MemoryEntry, layout: Mapping[str, Array]) -> dict[int, PushWays]:
    """The ways of an entry's pushes by sub-task, of those whose outcome is known.

    A sub-task that also grasps its target is no push: the target goes where the hand carries it.
    """
    pushing, grasping = (
        {pose.sub_task for pose in entry.key_poses if pose.phase == phase} for phase in ("push", "grasp")
    )
    pushing -= grasping
    ways: dict[int, PushWays] = {}
    for outcome in entry.outcomes:
        if outcome.sub_task not in pushing or any(
            name not in where for name in outcome.objects for where in (entry.layout, layout)
        ):
            continue
        shown = np.stack([entry.layout[outcome.target][:3, 3], outcome.place_shown(entry.layout)])
        now = np.stack([layout[outcome.target][:3, 3], outcome.place(layout)])
        ways[outcome.sub_task] = PushWays(outcome.target, shown, now)
    return ways


def _heading(way: Array) -> float:
    return float(np.arctan2(way[1, 1] - way[0, 1], way[1, 0] - way[0, 0]))


def _length(way: Array) -> float:
    return float(np.linalg.norm(way[1, :2] - way[0, :2]))
