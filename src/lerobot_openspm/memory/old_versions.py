"""Entries of format versions 1 to 4: one JSON list, and their transforms in two arrays beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.fields import MALFORMED
from lerobot_openspm.memory.store import entry_from_fields

KEY_POSE_ARRAY, LAYOUT_ARRAY = "entries.T_obj_ee", "entries.T_world_obj"
# With one of these a sub-task is done; what may follow is that the hand lets go and leaves.
ENDINGS = ("release", "push", "open", "turn")
LEAVING = (*ENDINGS, "retreat")


def entries_from_parts(
    rows: Sequence[Mapping[str, Any]], arrays: Mapping[str, NDArray[Any]], where: str
) -> tuple[MemoryEntry, ...]:
    """Put entries together from JSON rows and two arrays of transforms in their order.

    Raises:
        MemoryFormatError: Something is malformed. Names file and field.
    """
    poses = _transforms(arrays, KEY_POSE_ARRAY, where)
    layouts = _transforms(arrays, LAYOUT_ARRAY, where)
    entries: list[MemoryEntry] = []
    n_poses, n_layouts = 0, 0
    for i, row in enumerate(rows):
        try:
            k, n = len(row["key_poses"]), len(row["layout"])
            entry = _entry(row, poses[n_poses : n_poses + k], layouts[n_layouts : n_layouts + n])
        except MALFORMED as error:
            raise MemoryFormatError(
                f"{where}: entries[{i}] is malformed: {error!r}; train or pull it again"
            ) from error
        entries.append(entry)
        n_poses, n_layouts = n_poses + k, n_layouts + n
    if n_poses != len(poses) or n_layouts != len(layouts):
        raise MemoryFormatError(
            f"{where}: got {len(poses)} key poses and {len(layouts)} object poses, expected {n_poses} and "
            f"{n_layouts}; the files do not belong together, train or pull it again"
        )
    return tuple(entries)


def sub_tasks_of_phases(phases: Sequence[str], n_sub_tasks: int) -> list[int]:
    """Which sub-task each key pose serves, by its phase: one ends with the hand letting go and leaving."""
    found: list[int] = []
    sub_task, is_done = 0, False
    for phase in phases:
        if is_done and phase not in LEAVING:
            sub_task, is_done = min(sub_task + 1, n_sub_tasks - 1), False
        is_done = is_done or phase in ENDINGS
        found.append(sub_task)
    return found


def _entry(row: Mapping[str, Any], poses: NDArray[Any], layouts: NDArray[Any]) -> MemoryEntry:
    if len(poses) != len(row["key_poses"]) or len(layouts) != len(row["layout"]):
        raise ValueError("fewer transforms than the entry names")
    phases = [pose["phase"] for pose in row["key_poses"]]
    sub_tasks = sub_tasks_of_phases(phases, len(row["key"]["sub_tasks"]))
    key_poses = [
        {"sub_task": sub_task, **pose, "T_obj_ee": T[:3]}
        for sub_task, pose, T in zip(sub_tasks, row["key_poses"], poses, strict=True)
    ]
    layout = {name: T[:3] for name, T in zip(row["layout"], layouts, strict=True)}
    if len(layout) != len(layouts):
        raise ValueError(f"'layout' names an object twice: {row['layout']}")
    return entry_from_fields({"trials": 0, "successes": 0, **row, "key_poses": key_poses, "layout": layout})


def _transforms(arrays: Mapping[str, NDArray[Any]], name: str, where: str) -> NDArray[Any]:
    if name not in arrays:
        raise MemoryFormatError(
            f"{where}: array {name!r} is missing, got {sorted(arrays)}; train or pull it again"
        )
    T = arrays[name]
    if T.ndim != 3 or T.shape[1:] != (4, 4) or T.dtype != np.float64 or not se3.is_rigid(T):
        raise MemoryFormatError(
            f"{where}: array {name!r} has shape {T.shape} and type {T.dtype}, expected rigid transforms "
            "(n, 4, 4) of float64; train or pull it again"
        )
    return T
