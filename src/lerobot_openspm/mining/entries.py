"""Makes memory entries of a mined dataset: every key pose in the frame of its anchor."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.memory.compose import sub_task_index
from lerobot_openspm.memory.entry import (
    Anchor,
    Axis,
    MemoryEntry,
    MemoryKeyPose,
    RetrievalKey,
)
from lerobot_openspm.mining.anchors import Demonstration, Role, roles
from lerobot_openspm.mining.mined import MinedDataset, MinedTask
from lerobot_openspm.mining.not_learned import list_not_learned, missing_objects

logger = logging.getLogger(__name__)


def build_entries(mined: MinedDataset) -> tuple[MemoryEntry, ...]:
    """Make a memory entry of every demonstration in which the anchors of its contacts were found.

    Raises:
        DatasetError: There is no such demonstration.
    """
    entries = tuple(entry for task in mined.tasks for entry in task_entries(task, mined.name))
    if not entries:
        why = "; ".join(f"{one.name!r}: {one.reason}" for one in list_not_learned(mined))
        raise DatasetError(
            f"dataset {mined.name} has key poses in {len(mined.episodes)} episodes, but the objects "
            "they belong to were found in none; check --policy.cameras, or record with the hand out of view "
            f"at the start. What could not be learned: {why}"
        )
    return entries


def task_entries(task: MinedTask, source: str) -> tuple[MemoryEntry, ...]:
    """The memory entries of one task's demonstrations; `source` is the name of their dataset."""
    sub_tasks, entries, times = task.sub_tasks, list[MemoryEntry](), Counter[int]()
    named = {name for sub_task in sub_tasks for name in sub_task.objects}
    for item, demonstration, axes, quality, outcomes in zip(
        task.episodes, task.aligned, task.axes, task.qualities, task.outcomes, strict=True
    ):
        if missing := missing_objects(demonstration, task):
            logger.warning(
                "skipping episode %d of %s: it handles %s, which is not found",
                item.episode.index, source, " and ".join(map(repr, sorted(missing))),
            )  # fmt: skip
            continue
        times[item.episode.index] += 1
        key_poses = _remember(demonstration, task.anchors, axes, len(sub_tasks))
        key = RetrievalKey(sub_tasks, tuple(pose.phase for pose in key_poses))
        again = times[item.episode.index]
        where = f"{source}#{item.episode.index}" + (f".{again}" if again > 1 else "")
        poses = {name: T for name, T in demonstration.object_poses.items() if name in named}
        known = tuple(one for one in outcomes if all(name in poses for name in one.objects))
        entries.append(
            MemoryEntry(key, item.episode.task, key_poses, quality, 1, where, poses, outcomes=known)
        )
    return tuple(entries)


def _remember(
    demonstration: Demonstration,
    anchors: Mapping[Role, Anchor],
    axes: Mapping[Role, Axis],
    n_sub_tasks: int,
) -> tuple[MemoryKeyPose, ...]:
    """Express key poses in their anchors' frames, as far as these were found."""
    kept = []
    for role, pose in zip(roles(demonstration.key_poses), demonstration.key_poses, strict=True):
        anchor = anchors.get(role)
        T_obj_ee = None if anchor is None else demonstration.in_frame(anchor, pose)
        if anchor is None or T_obj_ee is None:
            continue
        kept.append(
            MemoryKeyPose(
                anchor, T_obj_ee, pose.phase, pose.confidence, pose.closed, pose.opening, pose.n_steps,
                pose.dwell, axes.get(role), sub_task_index(pose.contact, pose.phase, n_sub_tasks),
            )
        )  # fmt: skip
    return tuple(kept)
