"""Carrying an entry's key poses over to the present scene: the paper's transfer rule."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from lerobot_openspm.control.placing import carried_outcomes, placing_position
from lerobot_openspm.control.pushes import PushPath, push_paths, pushed
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import ARRIVING, CONTACT_PHASES, Axis, MemoryEntry, MemoryKeyPose
from lerobot_openspm.types import Symmetry

# How far the hand backs off at the end.
RETREAT_M = 0.06
# A target that is only passed by is met within this distance and angle, metres and radians.
PASSING_M, PASSING_RAD = 0.015, 0.15
# It is passed within this share of the way on to the next one, where that is less; but not closer than this.
PASSING_SHARE, LEAST_PASSING_M = 0.2, 0.005
# A door or a drawer is pushed so much further than was shown, metres, until it stops the hand.
SHUT_M = 0.02
# Of the hand about its approach axis, the z axis of its frame.
HALF_TURN = se3.from_yaw(np.zeros(3), np.pi)
# How the hand is turned where it puts an object down: as where it grasped it, not at all, or so that it turns
# on the way there as it did in the demonstration, however the landmark is turned.
Put = Literal["turned", "as_shown", "kept"]


@dataclass(frozen=True)
class Turn:
    """An object that turns into itself is grasped from another side than it was shown.

    Attributes:
        name: What it is called.
        T_world_obj: Where it stands ``(4, 4)``.
        middle: Where its axis is, x and y ``(2,)`` in its frame, metres.
        radians: How far the hand is turned about the axis.
        put: How it is turned where it puts the object; of a round one any will do.
    """

    name: str
    T_world_obj: Array
    middle: Array
    radians: float
    put: Put = "turned"


@dataclass(frozen=True)
class Target:
    """A key pose in the present scene.

    Attributes:
        T_world_ee: Where the hand is to be, ``(4, 4)``.
        key_pose: The key pose it was carried over from.
        precise: Whether it is met by terminal residual correction, or only passed by.
        axis: The constraint that the way here follows, its direction in the world; None in free space.
        push: The path of what is pushed on the way here; None where nothing is pushed, or the path is not
            known or turns.
        until_stopped: Whether it is met too near where the hand goes no further, as what it pushes is shut.
        passing_m: Distance within which it is met where it is only passed by, metres.
        passing_rad: Angle within which it is, radians.
    """

    T_world_ee: Array
    key_pose: MemoryKeyPose
    precise: bool
    axis: Axis | None = None
    push: PushPath | None = None
    until_stopped: bool = False
    passing_m: float = PASSING_M
    passing_rad: float = PASSING_RAD


def transfer_pose(T_world_obj: Array, T_obj_ee: Array) -> Array:
    """``T_world_ee = T_world_obj @ T_obj_ee``, the paper's transfer rule; batched over leading axes."""
    return T_world_obj @ T_obj_ee


def as_shown(
    entry: MemoryEntry, object_poses: Mapping[str, Array], symmetries: Mapping[str, Symmetry]
) -> dict[str, Array]:
    """Object poses ``T_world_obj`` ``(4, 4)`` with the round things that an entry moves turned as shown.

    A bottle with a label is found turned by any angle, and is grasped, pushed and put down as if it were not.

    Args:
        entry: The entry.
        object_poses: Poses as they were found.
        symmetries: How objects turn into themselves, of those that do.
    """
    moved = {*entry.carried.values(), *pushed(entry)}
    known = moved & symmetries.keys() & object_poses.keys() & entry.object_poses.keys()
    shown = dict(object_poses)
    for name in (name for name in known if symmetries[name].turn == 0):
        yaw = se3.yaw_of(entry.object_poses[name]) - se3.yaw_of(object_poses[name])
        shown[name] = object_poses[name] @ turn_about(symmetries[name].middle, float(yaw))
    return shown


def turn_about(middle: Array, radians: float) -> Array:
    """A turn ``(4, 4)`` about the vertical through a point ``(2,)``."""
    point = np.array([*middle, 0.0])
    return se3.from_yaw(point, radians) @ se3.from_yaw(-point, 0.0)


def transfer(
    entry: MemoryEntry,
    object_poses: Mapping[str, Array],
    yaw_periods: Mapping[str, float],
    T_world_ee: Array,
    gone: Mapping[int, float] | None = None,
    turns: Mapping[int, Turn] | None = None,
    retreat_m: float = RETREAT_M,
) -> tuple[Target, ...]:
    """Carry an entry's key poses over to the scene.

    An object that looks the same after, say, half a turn may be met from either side; the side that needs
    less turning of the hand is taken.

    Args:
        entry: The entry to execute.
        object_poses: Present poses ``T_world_obj`` ``(4, 4)`` of its anchors.
        yaw_periods: Angle by object that turns it into itself, radians; 0 for a body of revolution.
        T_world_ee: Present hand pose ``(4, 4)``.
        gone: How far a drawer or a knob has moved already, by sub-task, metres or radians.
        turns: By how much the grasp of an object is turned about its axis of symmetry, by sub-task.
        retreat_m: How far the hand backs off at the end of a demonstration that was cut before it did.
    """
    chosen: dict[str, Array] = {}
    targets: list[Target] = []
    before = T_world_ee
    paths, carried = push_paths(entry, object_poses), carried_outcomes(entry)
    for i, pose in enumerate(entry.key_poses):
        chosen |= _equivalents(pose, object_poses, chosen, yaw_periods, before)
        T_world_anchor = pose.anchor.frame(chosen)
        before = transfer_pose(T_world_anchor, pose.T_obj_ee)
        path = paths.get(pose.sub_task)
        if path is not None:
            before = se3.transform(before[:3, :3], path.position(pose, entry.object_poses))
        if (outcome := carried.get(pose.sub_task)) is not None:
            place = placing_position(pose, outcome, entry.object_poses, {**object_poses, **chosen})
            before = before if place is None else se3.transform(before[:3, :3], place)
        axis = pose.axis
        if axis is not None:
            axis = replace(axis, direction=T_world_anchor[:3, :3] @ axis.direction)
        # Where a push turns, the hand meets its target elsewhere than where the path ends.
        is_straight = sum(p.phase == "push" and p.sub_task == pose.sub_task for p in entry.key_poses) == 1
        push = path if pose.phase == "push" and is_straight else None
        targets.append(Target(before, pose, _is_precise(entry, i), axis, push))
    targets = _shut(targets, entry)
    for sub_task, turn in (turns or {}).items():
        targets = _turned(targets, sub_task, turn, entry.object_poses)
    for sub_task, amount in (gone or {}).items():
        targets = _gone_on(targets, sub_task, amount)
    if targets and entry.key.sub_tasks[-1].operation == "put":
        targets += _release(targets)
    return _passed_by(tuple(targets) + _retreat(targets, retreat_m))


def _passed_by(targets: Sequence[Target]) -> tuple[Target, ...]:
    """Key poses that are passed by the closer, the nearer the next one is: the hand must not cut corners."""
    ways = [float(se3.distance(a.T_world_ee, b.T_world_ee)) for a, b in pairwise(targets)]
    within = [float(np.clip(PASSING_SHARE * way, LEAST_PASSING_M, PASSING_M)) for way in ways]
    passed = [replace(target, passing_m=m) for target, m in zip(targets, within, strict=False)]
    return (*passed, *targets[len(passed) :])


def _turned(targets: Sequence[Target], sub_task: int, turn: Turn, shown: Mapping[str, Array]) -> list[Target]:
    """Key poses that grasp an object turned about its axis, and put it where they would have put it.

    The hand turns about the axis where it stands, and from the grasp on where the hand has carried it to.
    What it leaves before the grasp it leaves as it was shown.

    Args:
        targets: The key poses as they are.
        sub_task: Those of this sub-task are turned.
        turn: What is turned, and how far.
        shown: Poses ``T_world_obj`` ``(4, 4)`` of the objects in the demonstration.
    """
    turned = list(targets)
    T_ee_obj: Array | None = None
    axis, radians, is_put = turn.T_world_obj, turn.radians, False
    for i, target in enumerate(targets):
        pose = target.key_pose
        if pose.sub_task != sub_task or (T_ee_obj is None and turn.name not in pose.anchor.objects):
            continue
        if pose.phase in ARRIVING and pose.anchor.place != turn.name and not is_put:
            radians, is_put = _put_radians(turn, target, shown), True
        if T_ee_obj is not None and pose.phase != "retreat":
            axis = target.T_world_ee @ T_ee_obj
        if pose.phase == "grasp" and T_ee_obj is None:
            T_ee_obj = se3.inverse(target.T_world_ee) @ turn.T_world_obj
        point = se3.apply(axis, np.array([[*turn.middle, 0.0]]))[0]
        turned[i] = replace(target, T_world_ee=turn_about(point[:2], radians) @ target.T_world_ee)
    return turned


def _put_radians(turn: Turn, target: Target, shown: Mapping[str, Array]) -> float:
    """How far the hand is turned where it first arrives at the place that it puts an object in."""
    if turn.put == "turned":
        return turn.radians
    anchor = target.key_pose.anchor
    if turn.put == "as_shown" or any(name not in shown for name in anchor.objects):
        return 0.0
    T_shown = transfer_pose(anchor.frame(shown), target.key_pose.T_obj_ee)
    return turn.radians - float(se3.yaw_of(target.T_world_ee @ se3.inverse(T_shown)))


def half_turned(targets: Sequence[Target]) -> tuple[Target, ...]:
    """The same key poses with the hand turned by half a turn about its approach axis.

    Two fingers that close on one another take hold either way round.
    """
    return tuple(replace(one, T_world_ee=one.T_world_ee @ HALF_TURN) for one in targets)


def _shut(targets: Sequence[Target], entry: MemoryEntry) -> list[Target]:
    """Key poses of which the last of a push that closes something goes on until that stops the hand."""
    after = [*targets[1:], None]
    shut = list(targets)
    for i, (target, following) in enumerate(zip(targets, after, strict=True)):
        pose = target.key_pose
        is_last = following is None or following.key_pose.phase != "push"
        is_closing = pose.phase == "push" and entry.key.sub_tasks[pose.sub_task].operation == "close"
        if not is_closing or not is_last or i == 0:
            continue
        way = target.T_world_ee[:3, 3] - targets[i - 1].T_world_ee[:3, 3]
        T = target.T_world_ee.copy()
        T[:3, 3] += SHUT_M * way / max(float(np.linalg.norm(way)), 1e-9)
        shut[i] = replace(target, T_world_ee=T, until_stopped=True)
    return shut


def _is_precise(entry: MemoryEntry, i: int) -> bool:
    """Whether a key pose is met precisely: in contact, and before the fingers move or a push begins.

    Where a push turns, the hand only passes by.
    """
    pose = entry.key_poses[i]
    after = entry.key_poses[i + 1] if i + 1 < len(entry.key_poses) else None
    if after is None:
        return pose.phase in CONTACT_PHASES
    if pose.phase == after.phase == "push":
        return False
    return pose.phase in CONTACT_PHASES or after.dwell or after.phase == "push"


def _gone_on(targets: Sequence[Target], sub_task: int, amount: float) -> list[Target]:
    """Key poses of a sub-task whose drawer or knob has moved part of its way: take it where it is."""
    found = ((i, one.axis) for i, one in enumerate(targets) if one.axis and one.key_pose.sub_task == sub_task)
    end, axis = next(found, (0, None))
    if axis is None:
        return list(targets)
    amount = min(max(amount, 0.0), axis.amount)
    so_far, left = replace(axis, amount=amount), replace(axis, amount=axis.amount - amount)
    before = [
        replace(one, T_world_ee=so_far.follow(one.T_world_ee)) if one.key_pose.sub_task == sub_task else one
        for one in targets[:end]
    ]
    return [*before, replace(targets[end], axis=left), *targets[end + 1 :]]


def _release(targets: Sequence[Target]) -> list[Target]:
    """Letting go at the end, for a demonstration that was cut with the object still in the hand.

    A benchmark ends an episode when its goal first holds, which can be while the object is being lowered.
    """
    last = targets[-1]
    if last.key_pose.phase != "place":
        return []
    waits = [target.key_pose.n_steps for target in targets if target.key_pose.dwell]
    key_pose = replace(
        last.key_pose,
        phase="release",
        closed=False,
        n_steps=max(waits, default=1),
        dwell=True,
        confidence=0.5,
    )
    return [Target(last.T_world_ee, key_pose, precise=True)]


def _retreat(targets: Sequence[Target], metres: float) -> tuple[Target, ...]:
    """Backing off at the end, for a demonstration that was cut when its goal was reached.

    The hand leaves the way it came: against the direction in which it arrived at its last contact, in the
    hand's frame.
    """
    arrivals = [
        i
        for i, target in enumerate(targets)
        if i > 0
        and (target.key_pose.phase == "place" or (target.key_pose.phase == "approach" and target.precise))
    ]
    contacts = [target for target in targets if target.key_pose.phase in CONTACT_PHASES]
    if not arrivals or not contacts:
        return ()
    last, contact = targets[-1], contacts[-1]
    if float(se3.distances(last.T_world_ee, contact.T_world_ee)[0]) >= metres:
        return ()
    arrival, before = targets[arrivals[-1]], targets[arrivals[-1] - 1]
    back = (se3.inverse(arrival.T_world_ee) @ before.T_world_ee)[:3, 3]
    step = se3.transform(np.eye(3), metres * back / max(float(np.linalg.norm(back)), 1e-9))
    key_pose = replace(last.key_pose, phase="retreat", n_steps=1, dwell=False, confidence=0.5)
    return (Target(contact.T_world_ee @ step, key_pose, precise=False),)


def _equivalents(
    pose: MemoryKeyPose,
    object_poses: Mapping[str, Array],
    chosen: Mapping[str, Array],
    yaw_periods: Mapping[str, float],
    before: Array,
) -> dict[str, Array]:
    """Which poses of a key pose's symmetric objects are meant, of those for which that is not chosen yet."""
    new: dict[str, Array] = {}
    for name in pose.anchor.objects:
        if name not in chosen:
            known = {**object_poses, **chosen, **new}
            new[name] = _nearest_equivalent(name, pose, known, yaw_periods, before)
    return new


def _nearest_equivalent(
    name: str,
    pose: MemoryKeyPose,
    object_poses: Mapping[str, Array],
    yaw_periods: Mapping[str, float],
    before: Array,
) -> Array:
    """The pose of a symmetric object, among those that look alike, from which the hand has to turn least."""
    choices = se3.yaw_equivalents(object_poses[name], yaw_periods.get(name, 2 * np.pi))
    after = [transfer_pose(pose.anchor.frame({**object_poses, name: T}), pose.T_obj_ee) for T in choices]
    turns = [float(se3.distances(before, T)[1]) for T in after]
    return choices[int(np.argmin(turns))]
