"""Outcomes by consensus: where, relative to what, do the demonstrations of a task leave its targets?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import WORLD, Anchor, Outcome
from lerobot_openspm.mining.anchors import Demonstration, sub_task_of
from lerobot_openspm.types import SubTask, Symmetry

# How exactly perception locates an object that was put down.
FOUND_AGAIN_M = 0.010
# The tolerance is never smaller, however well the demonstrations agree.
LEAST_TOLERANCE_M = 0.020
# The direction of a push shorter than this is not known.
LEAST_PUSH_M = 0.020
# Demonstrations that leave the target further apart than this do not show where it belongs.
MOST_SPREAD_M = 0.050


def carried_to(demonstration: Demonstration, sub_tasks: Sequence[SubTask]) -> dict[str, Array]:
    """Where the hand put what it carried, as if held rigidly: ``T_world_obj`` ``(4, 4)`` by name.

    No image is needed, so this also works for demonstrations that end with the hand around the object. Of an
    object that was carried twice, the last place counts.
    """
    poses = dict(demonstration.object_poses)
    carried: dict[str, Array] = {}
    T_ee_obj: tuple[str, Array] | None = None
    for pose in demonstration.key_poses:
        target = sub_task_of(pose, sub_tasks).target
        if pose.phase == "grasp" and target in poses:
            T_ee_obj = target, se3.inverse(pose.T_world_ee) @ poses[target]
        elif pose.phase == "place" and T_ee_obj is not None and T_ee_obj[0] == target:
            carried[target] = poses[target] = pose.T_world_ee @ T_ee_obj[1]
        elif pose.phase == "release":
            T_ee_obj = None
    return carried


def pushed_to(
    demonstration: Demonstration, sub_tasks: Sequence[SubTask], points: Mapping[str, Array]
) -> dict[str, Array]:
    """Where the hand left what it pushed: just ahead of the hand, in the direction of the last stretch.

    No image is needed, so this also works for demonstrations that end with the hand above the object. How it
    turned on its way is not known: its pose is as it stood, only elsewhere.

    Args:
        demonstration: Its key poses, and its objects' poses at the start.
        sub_tasks: What the instruction asks for.
        points: Points ``(n, 3)`` of the objects' surfaces in their frames, by name.

    Returns:
        ``T_world_obj`` ``(4, 4)`` by name, of what the hand met from behind; what it drags along from above
        is not told.
    """
    poses = {name: T for name, T in demonstration.object_poses.items() if len(points.get(name, ()))}
    pushed: dict[str, Array] = {}
    began, is_behind = np.zeros(2), None
    for before, pose in pairwise(demonstration.key_poses):
        target = sub_task_of(pose, sub_tasks).target
        if before.phase != "push":
            began, is_behind = before.T_world_ee[:2, 3], None
        if pose.phase != "push" or target not in poses:
            continue
        start, end = before.T_world_ee[:2, 3], pose.T_world_ee[:2, 3]
        if np.linalg.norm(end - start) < LEAST_PUSH_M:
            continue
        if is_behind is None:
            is_behind = _is_behind(poses[target], points[target], began, end)
        if is_behind:
            pushed[target] = poses[target] = _pushed(poses[target], points[target], start, end)
        else:
            del poses[target]
            pushed.pop(target, None)
    return pushed


def _is_behind(T_world_obj: Array, points: Array, start: Array, end: Array) -> bool:
    """Whether the hand begins a push behind an object's middle; see :func:`_pushed`."""
    low, high = _outline(T_world_obj, points, start, end)[:, 0]
    return bool(start @ _axes(start, end)[0] < (low + high) / 2)


def _pushed(T_world_obj: Array, points: Array, start: Array, end: Array) -> Array:
    """The pose ``(4, 4)`` of an object with the hand right behind it at the end of a straight push.

    Args:
        T_world_obj: Where it was ``(4, 4)``.
        points: Points ``(n, 3)`` of its surface in its frame.
        start: Where the hand begins, x and y ``(2,)`` in the world.
        end: Where the hand ends ``(2,)``.
    """
    low, high = _outline(T_world_obj, points, start, end)
    back = np.array([low[0], (low[1] + high[1]) / 2])
    moved = T_world_obj.copy()
    moved[:2, 3] += end - back @ _axes(start, end)
    return moved


def _outline(T_world_obj: Array, points: Array, start: Array, end: Array) -> Array:
    """The least and the most ``(2, 2)`` of an object's points along a push and to its left, metres."""
    along = se3.apply(T_world_obj, points)[:, :2] @ _axes(start, end).T
    return np.stack([along.min(axis=0), along.max(axis=0)])


def _axes(start: Array, end: Array) -> Array:
    """Unit vectors, as rows ``(2, 2)``, along a push and to its left."""
    ahead = (end - start) / np.linalg.norm(end - start)
    return np.stack([ahead, [-ahead[1], ahead[0]]])


def outcomes(
    demonstrations: Sequence[Demonstration],
    ends: Sequence[Mapping[str, Array]],
    sub_tasks: Sequence[SubTask],
    symmetries: Mapping[str, Symmetry] | None = None,
) -> list[tuple[Outcome, ...]]:
    """Where the demonstrations of one task leave its targets, as far as they agree.

    Args:
        demonstrations: The demonstrations, with their objects' poses at the start.
        ends: For each, poses ``T_world_obj`` ``(4, 4)`` at its end of the objects that were moved and found.
        sub_tasks: What the instruction asks for.
        symmetries: How objects turn into themselves, of those that do.

    Returns:
        For each demonstration, one outcome per sub-task that names a landmark and that enough of them show.
    """
    found: list[list[Outcome]] = [[] for _ in demonstrations]
    for i, sub_task in enumerate(sub_tasks):
        # A later sub-task may move the target on, or its landmark away.
        moved_on = any(later.target in sub_task.objects for later in sub_tasks[i + 1 :])
        is_told = sub_task.relation and not sub_task.words  # the instruction says where it ends
        if is_told and sub_task.landmark != sub_task.target and not moved_on:
            for n, outcome in _outcomes(i, sub_task, demonstrations, ends, symmetries or {}).items():
                found[n].append(outcome)
    return [tuple(one) for one in found]


def _outcomes(
    number: int,
    sub_task: SubTask,
    demonstrations: Sequence[Demonstration],
    ends: Sequence[Mapping[str, Array]],
    symmetries: Mapping[str, Symmetry],
) -> dict[int, Outcome]:
    """The outcome of one sub-task by demonstration; empty where too few show it, or they disagree."""
    final_poses = [{**one.object_poses, **end} for one, end in zip(demonstrations, ends, strict=True)]
    known = [
        i
        for i, (end, poses) in enumerate(zip(ends, final_poses, strict=True))
        if sub_task.target in end and sub_task.landmark in poses
    ]
    if not known or 2 * len(known) < len(demonstrations):
        return {}
    symmetry = symmetries.get(sub_task.target)
    x, y = (0.0, 0.0) if symmetry is None else map(float, symmetry.middle)
    places = np.stack([se3.apply(ends[i][sub_task.target], np.array([[x, y, 0.0]]))[0] for i in known])
    choices = []
    for anchor in (Anchor(sub_task.landmark, sub_task.landmark), Anchor(sub_task.landmark, WORLD)):
        T_anchor_world = se3.inverse(np.stack([anchor.frame(final_poses[i]) for i in known]))
        shown = se3.apply(T_anchor_world, places[:, None])[:, 0]
        median = np.median(shown, axis=0)
        choices.append((float(np.linalg.norm(shown - median, axis=-1).max()), anchor, median, shown))
    spread, anchor, median, shown = min(choices, key=lambda choice: choice[0])
    if spread > MOST_SPREAD_M:
        return {}
    tolerance_m = max(LEAST_TOLERANCE_M, spread + FOUND_AGAIN_M)
    return {
        i: Outcome(number, sub_task.target, anchor, median, own, tolerance_m, (x, y))
        for i, own in zip(known, shown, strict=True)
    }
