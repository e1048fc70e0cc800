"""A grasp that was shown of one round thing, used for another one: by the rim.

Round things with a rim are taken by it alike: where the hand was at one rim tells where it is at another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import (
    Anchor,
    MemoryEntry,
    RetrievalKey,
)
from lerobot_openspm.memory.looks import Looks, Rim
from lerobot_openspm.types import SubTask

# A hand takes a rim where it is this near to it, below its top, with the fingers this close together, metres,
# on both sides of it: by the cosine between their line and the direction to the middle.
NEAR_RIM_M, THIN_M, ACROSS = 0.015, 0.02, 0.8

# S_sem of what is asked and what is known.
Score = Callable[[SubTask, SubTask], float]
# An entry of one sub-task, and the entry of the memory that it is a part of.
Part = tuple[MemoryEntry, MemoryEntry]


def by_rim(asked: SubTask, parts: Sequence[Part], score: Score, least: float, looks: Looks) -> list[Part]:
    """Grasps of a round thing that was never grasped, by its rim, as another one was grasped by its own.

    Of several things that fit equally well, those of each.

    Args:
        asked: What to do with the thing.
        parts: Entries of one sub-task.
        score: Tells how well a sub-task that is known fits what is asked.
        least: The score below which it does not.
        looks: What is known of the objects.
    """
    standing = {name: part.object_poses[name] for part, _ in parts for name in part.object_poses}
    fits = {name: score(asked, replace(asked, target=name)) for name in standing}
    best = max(fits.values(), default=0.0)
    found: list[Part] = []
    for name, T in standing.items():
        rim = looks.rim(name)
        if rim is None or fits[name] < max(best, least):
            continue
        for part, source in parts:
            own = _grasped_rim(part, looks)
            if own is not None:
                found.append((_at_other_rim(part, own, name, T, T @ rim.T_obj_rim, rim.radius), source))
    return found


def _grasped_rim(part: MemoryEntry, looks: Looks) -> Rim | None:
    """The rim by which an entry grasps its target; None where it grasps it otherwise."""
    target = part.key.sub_tasks[0].target
    rim = looks.rim(target)
    if rim is None or part.carried.get(0) != target or target not in part.object_poses:
        return None
    pose = next(one for one in part.key_poses if one.phase == "grasp")
    T_rim_ee = se3.inverse(part.object_poses[target] @ rim.T_obj_rim) @ part.demonstrated(pose)
    out, across = T_rim_ee[:2, 3], T_rim_ee[:2, 1]
    distance = float(np.linalg.norm(out))
    is_near = abs(distance - rim.radius) < NEAR_RIM_M and T_rim_ee[2, 3] < 0
    is_across = pose.opening < THIN_M and abs(float(out @ across)) > ACROSS * distance
    return rim if is_near and is_across else None


def _at_other_rim(
    part: MemoryEntry, own: Rim, name: str, T_world_obj: Array, T_world_rim: Array, radius: float
) -> MemoryEntry:
    """The grasp of an entry at the rim of another thing; the hand keeps its direction in the world.

    Args:
        part: The entry.
        own: The rim that it grasps.
        name: The other thing.
        T_world_obj: Where that stands ``(4, 4)``.
        T_world_rim: The middle of its rim ``(4, 4)``.
        radius: Of its rim, metres.
    """
    known, poses = part.key.sub_tasks[0], part.object_poses
    middle = (poses[known.target] @ own.T_obj_rim)[:3, 3]
    grasp = next(one for one in part.key_poses if one.phase == "grasp")
    out = (part.demonstrated(grasp)[:3, 3] - middle) * [1.0, 1.0, 0.0]
    step = T_world_rim[:3, 3] - middle + (radius - own.radius) * out / np.linalg.norm(out)
    T_obj_moved = se3.inverse(T_world_obj) @ se3.from_yaw(step, 0.0)
    moved = tuple(
        replace(one, anchor=Anchor(name, name), T_obj_ee=T_obj_moved @ part.demonstrated(one))
        for one in part.key_poses
        if one.phase in ("approach", "grasp", "lift") and set(one.anchor.objects) == {known.target}
    )
    key = RetrievalKey((replace(known, target=name),), tuple(one.phase for one in moved))
    return replace(part, key=key, key_poses=moved, object_poses={**poses, name: T_world_obj}, outcomes=())
