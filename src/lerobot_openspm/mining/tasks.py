"""Comparing the demonstrations of a task: whose frame each key pose belongs to, and who agrees with whom."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.mining.anchors import Demonstration, align_symmetric, consensus, qualities
from lerobot_openspm.mining.axes import constrained_axes
from lerobot_openspm.mining.mined import MinedEpisode, MinedTask
from lerobot_openspm.mining.outcomes import outcomes


def compare(
    episodes: Sequence[MinedEpisode],
    object_poses: Sequence[Mapping[str, Array]],
    ends: Sequence[Mapping[str, Array]],
    yaw_periods: Mapping[str, float],
) -> tuple[MinedTask, ...]:
    """Compare demonstrations, task by task.

    Args:
        episodes: The demonstrations.
        object_poses: For each, ``T_world_obj`` ``(4, 4)`` of the objects found in its first frame.
        ends: For each, where the objects ended that it moved.
        yaw_periods: Angle by object that turns it into itself, radians.
    """
    by_task: dict[str, list[int]] = defaultdict(list)
    for i, item in enumerate(episodes):
        by_task[item.episode.task].append(i)
    tasks = []
    for members in by_task.values():
        found = [Demonstration(episodes[i].key_poses, object_poses[i]) for i in members]
        own = tuple(episodes[i] for i in members)
        tasks.append(_task(own, align_symmetric(found, yaw_periods), [ends[i] for i in members]))
    return tuple(tasks)


def _task(
    episodes: tuple[MinedEpisode, ...],
    aligned: Sequence[Demonstration],
    ends: Sequence[Mapping[str, Array]],
) -> MinedTask:
    sub_tasks = episodes[0].sub_tasks
    anchors = consensus(aligned, sub_tasks)
    return MinedTask(
        episodes=episodes,
        aligned=tuple(aligned),
        anchors=anchors,
        axes=tuple(constrained_axes(aligned, anchors)),
        qualities=tuple(qualities(aligned, anchors)),
        outcomes=tuple(outcomes(aligned, ends, sub_tasks)),
    )
