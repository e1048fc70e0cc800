"""Room for the fingers: a hand takes hold a little to one side where something stands close by.

The fingers close on what is between them and move it to their middle, so that it is in the hand as it was
shown, whichever finger meets it first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose

# How far to one side, metres, the least first; both fingers stay this far from what they close on.
SHIFTS_M = (0.0, 0.003, -0.003, 0.006, -0.006, 0.009, -0.009, 0.012, -0.012)
LEAST_ROOM_M = 0.004
# A finger in the hand's frame, which is between the fingertips: half its width along x, how thick it is along
# y beyond the opening, with some room to what stands beside it, and from where to where it reaches along z.
HALF_WIDTH_M, THICKNESS_M, FROM_M, TO_M = 0.016, 0.028, -0.05, 0.01
# Fewer points of other objects in the fingers' way are noise.
NOISE_POINTS = 3
# A shift leaves at most this share of what is in the fingers' way, else it is for nothing.
MOST_LEFT = 0.5
# A hand that was pushed aside by so much, or takes hold of something so far beside its middle, is kept from
# going down by one finger. Next time it goes this much aside, metres.
PUSHED_M, RIM_M, DODGE_M = 0.004, 0.02, 0.02
# Fingers are elsewhere from so far on, metres.
ELSEWHERE_M = 0.05


def finger_room(
    entry: MemoryEntry, targets: Sequence[Target], points: Mapping[str, Array], open_width: float
) -> dict[int, float]:
    """By sub-task, how far the hand goes along its y axis to one side as it takes hold, metres.

    Only what is carried off is grasped so; a handle stays where it is.

    Args:
        entry: What is to be executed.
        targets: Its key poses in the scene.
        points: Points ``(n, 3)`` in the world of the objects that were found, by name.
        open_width: Of the gripper, metres.
    """
    shifts: dict[int, float] = {}
    for target in targets:
        pose = target.key_pose
        if pose.phase != "grasp" or entry.carried.get(pose.sub_task) != pose.anchor.place:
            continue
        others = [own for name, own in points.items() if name not in pose.anchor.objects]
        if not others:
            continue
        near = se3.apply(se3.inverse(target.T_world_ee), np.concatenate(others))
        choices = [metres for metres in SHIFTS_M if abs(metres) <= _most_aside(pose, open_width)]
        in_way = [_in_fingers(near, metres, open_width) for metres in choices]
        best = int(np.argmin(in_way))
        if in_way[0] >= NOISE_POINTS and in_way[best] <= MOST_LEFT * in_way[0]:
            shifts[pose.sub_task] = choices[best]
    return shifts


def dodged(grasp: Target, pushed_m: float, middle_m: float, open_width: float) -> float:
    """How far the hand goes along its y axis from what a finger stands on, metres; 0 where that is not known.

    Args:
        grasp: What it was to go down to.
        pushed_m: How far along its y axis it is kept from there, metres.
        middle_m: How far along its y axis the middle of what it takes hold of is. What stands in the way of
            a grasp at a rim is rather outside of it.
        open_width: Of the gripper, metres.
    """
    side = pushed_m if abs(pushed_m) >= PUSHED_M else middle_m if abs(middle_m) >= RIM_M else 0.0
    metres = min(DODGE_M, _most_aside(grasp.key_pose, open_width))
    return float(np.copysign(metres, side)) if side and metres >= PUSHED_M else 0.0


def _most_aside(grasp: MemoryKeyPose, open_width: float) -> float:
    """How far aside of what they close on the fingers still have it between them, metres."""
    return max((open_width - grasp.opening) / 2 - LEAST_ROOM_M, 0.0)


def fingers_elsewhere(
    kept_from: Target, grasps: Sequence[Target], T_world_ee: Array, open_width: float
) -> list[int]:
    """Which of some grasps put the fingers elsewhere than one that the hand was kept from.

    What stood in a finger's way is mostly not known, only where. Of like ways the hand turns least for the
    first.

    Args:
        kept_from: The grasp that the hand was kept from, in the scene.
        grasps: Other ways to take hold of the same.
        T_world_ee: Where the hand is ``(4, 4)``.
        open_width: Of the gripper, metres.

    Returns:
        Their indices, those furthest off first.
    """
    tips = np.array([[0.0, open_width / 2, 0.0], [0.0, -open_width / 2, 0.0]])
    before = se3.apply(kept_from.T_world_ee, tips)
    order: list[tuple[float, float, int]] = []
    for i, grasp in enumerate(grasps):
        after = se3.apply(grasp.T_world_ee, tips)
        # Either finger may come to where the other one was.
        off = min(float(np.linalg.norm(after - one, axis=1).max()) for one in (before, before[::-1]))
        if off >= ELSEWHERE_M:
            turned = float(se3.distances(T_world_ee, grasp.T_world_ee)[1])
            order.append((-round(off, 3), round(turned, 2), i))
    return [i for *_, i in sorted(order)]


def _in_fingers(points: Array, shift: float, open_width: float) -> int:
    """How many points ``(n, 3)`` in the hand's frame are in the way of the fingers of a shifted hand."""
    x, y, z = np.abs(points[:, 0]), np.abs(points[:, 1] - shift), points[:, 2]
    return int(((x < HALF_WIDTH_M) & (y < open_width / 2 + THICKNESS_M) & (z > FROM_M) & (z < TO_M)).sum())


def shifted(
    targets: Sequence[Target], shifts: Mapping[int, float], deeper: Mapping[int, float]
) -> tuple[Target, ...]:
    """The same key poses, with the hand to one side until it takes hold, and deeper as it does; metres."""
    taken: set[int] = set()
    found: list[Target] = []
    for target in targets:
        number, phase = target.key_pose.sub_task, target.key_pose.phase
        if number not in taken and phase in ("approach", "grasp"):
            depth = deeper.get(number, 0.0) if phase == "grasp" else 0.0
            step = se3.transform(np.eye(3), np.array([0.0, shifts.get(number, 0.0), depth]))
            target = replace(target, T_world_ee=target.T_world_ee @ step)
        if phase == "grasp":
            taken.add(number)
        found.append(target)
    return tuple(found)
