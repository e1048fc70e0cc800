"""Putting down what is carried otherwise than it was shown: beside its place, or turned."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from lerobot_openspm.control.transfer import Target, turn_about
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array


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
    carried: Mapping[int, str],
    object_poses: Mapping[str, Array],
    landmarks: Collection[str],
) -> tuple[Target, ...]:
    """The same key poses, those that put something on or in some landmarks turned with it.

    What is carried ends at the same place: hand and load turn about the vertical through its origin.

    Args:
        targets: The key poses.
        radians: How far they are turned.
        carried: What is carried, by sub-task.
        object_poses: Poses ``T_world_obj`` ``(4, 4)`` of what is carried, where it is grasped.
        landmarks: What it may be put on turned by any angle.
    """
    turned: list[Target] = []
    T_ee_load: dict[int, Array] = {}
    for target, is_put in zip(targets, _are_put(targets), strict=True):
        pose, T = target.key_pose, target.T_world_ee
        name = carried.get(pose.sub_task, "")
        if pose.phase == "grasp" and name in object_poses:
            T_ee_load.setdefault(pose.sub_task, se3.inverse(T) @ object_poses[name])
        if is_put and pose.anchor.place in landmarks and pose.sub_task in T_ee_load:
            load = (T @ T_ee_load[pose.sub_task])[:2, 3]
            target = replace(target, T_world_ee=turn_about(load, radians) @ T)
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
