"""A demonstration that puts several things is mined as several demonstrations, one for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from lerobot_openspm.language.descriptions import phrase
from lerobot_openspm.memory.compose import TRANSITIONS_PER_SUB_TASK, sub_task_index
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.types import SubTask


def divided(item: MinedEpisode) -> list[MinedEpisode]:
    """The parts of a demonstration that stand by themselves; the demonstration where there is one.

    Every part is about what stood in the first frame, because nothing that it needs was moved before.
    """
    sub_tasks = item.sub_tasks
    starts = [i for i in range(1, len(sub_tasks)) if _stands_by_itself(sub_tasks, i)]
    if not starts:
        return [item]
    return [_part(item, first, end) for first, end in pairwise([0, *starts, len(sub_tasks)])]


def _stands_by_itself(sub_tasks: Sequence[SubTask], i: int) -> bool:
    """Whether what comes from a sub-task on needs nothing of what was done before."""
    before, after = sub_tasks[:i], sub_tasks[i:]
    last = before[-1]
    if last.words or last.operation != "put" or last.part:
        return False
    moved = {one.target for one in before}
    touched = {name for one in after if one != last for name in one.objects}
    # "Both bowls" are two bowls, and what something was put into may be closed next.
    return not moved & touched and all(one.target != last.landmark for one in after)


def _part(item: MinedEpisode, first: int, end: int) -> MinedEpisode:
    own, count = item.sub_tasks[first:end], len(item.sub_tasks)
    numbered = ((sub_task_index(pose.contact, pose.phase, count), pose) for pose in item.key_poses)
    key_poses = tuple(
        replace(pose, contact=pose.contact - TRANSITIONS_PER_SUB_TASK * first)
        for number, pose in numbered
        if first <= number < end
    )
    return MinedEpisode(replace(item.episode, task=" and ".join(map(phrase, own))), key_poses, own)
