"""Putting down what is carried otherwise than it was shown: beside its place, or turned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lerobot_openspm.control.transfer import Target, turn_about
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import Symmetry


def put_aside(targets: Sequence[Target], aside: Array) -> tuple[Target, ...]:
    """The same key poses, those that put something down shifted by x and y ``(2,)`` in the world, metres."""
    shifted: list[Target] = []
    for target, is_put in zip(targets, _are_put(targets), strict=True):
        T = target.T_world_ee
        if is_put:
            target = replace(target, T_world_ee=se3.transform(T[:3, :3], T[:3, 3] + [*aside, 0.0]))
        shifted.append(target)
    return tuple(shifted)


def put_turned(
    targets: Sequence[Target],
    radians: float,
    loads: Mapping[int, str],
    object_poses: Mapping[str, Array],
    symmetries: Mapping[str, Symmetry],
) -> tuple[Target, ...]:
    """The same key poses, those that put something on or in something round turned with it.

    Hand and load turn about the load's axis, where that is put.

    Args:
        targets: The key poses.
        radians: How far they are turned.
        loads: What is carried, by sub-task; what does not turn into itself is not turned.
        object_poses: Poses ``T_world_obj`` ``(4, 4)`` of what is carried, where it is grasped.
        symmetries: How objects turn into themselves, of those that do.
    """
    turned: list[Target] = []
    T_ee_load: dict[int, Array] = {}
    axes: dict[int, Array | None] = {}  # where the load is turned, by sub-task; None where it is not
    for target, is_put in zip(targets, _are_put(targets), strict=True):
        pose, T, i = target.key_pose, target.T_world_ee, target.key_pose.sub_task
        name = loads.get(i, "")
        if pose.phase == "grasp" and name in symmetries and name in object_poses:
            T_ee_load.setdefault(i, se3.inverse(T) @ object_poses[name])
        if is_put and i in T_ee_load:
            landmark = symmetries.get(pose.anchor.place)
            is_turned = axes[i] is not None if i in axes else landmark is not None and landmark.turn == 0
            if pose.phase != "retreat" or i not in axes:  # a hand that backs off has let go of it
                middle = np.array([[*symmetries[name].middle, 0.0]])
                axes[i] = se3.apply(T @ T_ee_load[i], middle)[0, :2] if is_turned else None
            if (axis := axes[i]) is not None:
                target = replace(target, T_world_ee=turn_about(axis, radians) @ T)
        turned.append(target)
    return tuple(turned)


def _are_put(targets: Sequence[Target]) -> list[bool]:
    """Of each key pose, whether the hand is at the place of what it carries, or backs off from there.

    A hand that rises over what it grasped is not there yet, and a handle is put nowhere.
    """
    poses = [target.key_pose for target in targets]
    grasped = {pose.sub_task: pose.anchor.place for pose in poses if pose.phase == "grasp"}
    arrived: set[int] = set()
    are_put: list[bool] = []
    for pose in poses:
        if pose.phase in ("pre-place", "place") and pose.anchor.place != grasped.get(pose.sub_task):
            arrived.add(pose.sub_task)
        are_put.append(pose.sub_task in arrived)
    return are_put
