"""Where the hand goes so that what it carries ends where the demonstrations left it.

Whoever puts a round object down keeps the hand's direction in the world, while where the object ends belongs
to the landmark: beside its middle, and on the same side of it whichever way it is turned. What was grasped
across its width is put down as it was taken: the hand keeps its direction to the object.
"""

from __future__ import annotations

from collections.abc import Mapping

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import ARRIVING, WORLD, MemoryEntry, MemoryKeyPose, Outcome


def carried_outcomes(entry: MemoryEntry) -> dict[int, Outcome]:
    """By sub-task: where what is grasped ends, if that is known."""
    grasping = {pose.sub_task for pose in entry.key_poses if pose.phase == "grasp"}
    return {
        one.sub_task: one
        for one in entry.outcomes
        if one.sub_task in grasping and all(name in entry.object_poses for name in one.objects)
    }


def placing_position(
    pose: MemoryKeyPose, outcome: Outcome, shown: Mapping[str, Array], now: Mapping[str, Array]
) -> Array | None:
    """Where the hand goes ``(3,)`` for a key pose that keeps its direction, in the world or to its load.

    None for others.

    Args:
        pose: The key pose.
        outcome: Where what it carries ends.
        shown: Poses ``T_world_obj`` ``(4, 4)`` of the objects in the demonstration.
        now: The same here.
    """
    is_placing = pose.phase in ARRIVING and pose.anchor.place == outcome.anchor.place
    is_told = pose.anchor.axes in (WORLD, outcome.target)
    if not is_placing or not is_told or any(name not in now for name in outcome.objects):
        return None
    beside = (pose.anchor.frame(shown) @ pose.T_obj_ee)[:3, 3] - outcome.place_shown(shown)
    if pose.anchor.axes == outcome.target:
        beside = now[outcome.target][:3, :3] @ shown[outcome.target][:3, :3].T @ beside
    return se3.apply(outcome.anchor.frame(now), outcome.shown[None])[0] + beside
