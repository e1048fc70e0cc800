"""Carrying key poses over to the present scene, and checking that the hand can follow them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import CONTACT_PHASES, Axis, MemoryEntry, MemoryKeyPose
from lerobot_openspm.memory.robot import RobotModel

# Phases in which an object follows the hand along a constraint.
CONSTRAINED_PHASES = ("push", "open", "turn")
# How far the hand backs off at the end.
RETREAT_M = 0.06
# A hand that is this little too low need not rise.
LEVEL_M = 0.02
# How much a different way through free space counts beside a different way in contact.
FREE_SPACE_SHARE = 0.2
# An entry whose key poses lie this much differently to one another here counts as 1/e alike.
SHAPE_SCALE_M = 0.1
# An entry that can be executed at all scores at least this.
MIN_USABLE_SCORE = 1e-3


# A way shorter than this has no direction that could be told from where the object is seen.
LEAST_WAY_M = 0.005


@dataclass(frozen=True)
class PushWays:
    """A push in the demonstration and here, each from where its target is to where it should end.

    What is pushed moves the way that the hand moves, and ends before the hand. So the hand's place is kept
    relative to the way: beside the target at its start, and beside the outcome at its end.

    Attributes:
        target: The object that is pushed.
        shown: Start and end ``(2, 3)`` of the target in the demonstration, in the world.
        now: Start and end ``(2, 3)`` of the target here.
    """

    target: str
    shown: Array
    now: Array

    def position(self, pose: MemoryKeyPose, layout_shown: Mapping[str, Array]) -> Array:
        """Where the hand goes ``(3,)`` for a key pose of the push."""
        place = 0 if pose.anchor.place == self.target else 1
        T_world_ee = pose.anchor.frame(layout_shown) @ pose.T_obj_ee
        turn = _heading(self.now) - _heading(self.shown)
        if min(_length(self.shown), _length(self.now)) < LEAST_WAY_M:
            turn = 0.0
        offset = T_world_ee[:3, 3] - self.shown[place]
        position = self.now[place] + se3.apply(se3.from_yaw(np.zeros(3), turn), offset[None])[0]
        # All of the way lies at one height, which is known best from what stands still.
        position[2] = self.now[1, 2] + T_world_ee[2, 3] - self.shown[1, 2]
        return position

    def beyond(self, T_world_ee: Array, T_world_end: Array, target: Array) -> float:
        """How far the hand has gone beyond where it meets its target, along the way, in metres.

        It meets the target where it is as far ahead of it as at the end of the push.

        Args:
            T_world_ee: The hand ``(4, 4)``.
            T_world_end: Where the push ends ``(4, 4)``.
            target: Where the target is ``(3,)``.
        """
        way = (self.now[1] - self.now[0])[:2]
        meeting = T_world_end[:3, 3] + target - self.now[1]
        gone = float((T_world_ee[:3, 3] - meeting)[:2] @ way)
        return gone / max(_length(self.now), LEAST_WAY_M)


@dataclass(frozen=True)
class Target:
    """A key pose in the present scene.

    Attributes:
        T_world_ee: Where the hand is to be, ``(4, 4)``.
        key_pose: The key pose it was carried over from.
        precise: Whether it is met by terminal residual correction, or only passed by.
        axis: The constraint that the way here follows, its direction in the world; None in free space.
        push: The way of what is pushed on the way here; None where it is not known or turns, or nothing is
            pushed.
    """

    T_world_ee: Array
    key_pose: MemoryKeyPose
    precise: bool
    axis: Axis | None = None
    push: PushWays | None = None


def transfer_pose(T_world_obj: Array, T_obj_ee: Array) -> Array:
    """``T_world_ee = T_world_obj @ T_obj_ee``, the paper's transfer rule; batched over leading axes."""
    return T_world_obj @ T_obj_ee


def transfer(
    entry: MemoryEntry,
    layout: Mapping[str, Array],
    yaw_periods: Mapping[str, float],
    T_world_ee: Array,
    gone: Mapping[int, float] | None = None,
) -> tuple[Target, ...]:
    """Carry an entry's key poses over to the scene.

    An object that looks the same after, say, half a turn may be met from either side; the side that needs
    less turning of the hand is taken.

    Args:
        entry: The entry to execute.
        layout: Present poses ``T_world_obj`` ``(4, 4)`` of its anchors.
        yaw_periods: Angle by object that turns it into itself, radians; 0 for a body of revolution.
        T_world_ee: Present hand pose ``(4, 4)``.
        gone: How far a drawer or a knob has gone already, by sub-task, metres or radians.
    """
    chosen: dict[str, Array] = {}
    targets: list[Target] = []
    before = T_world_ee
    pushes = push_ways(entry, layout)
    for i, pose in enumerate(entry.key_poses):
        for name in pose.anchor.objects:
            if name not in chosen:
                chosen[name] = _nearest_equivalent(name, pose, {**layout, **chosen}, yaw_periods, before)
        T_world_anchor = pose.anchor.frame(chosen)
        before = transfer_pose(T_world_anchor, pose.T_obj_ee)
        ways = pushes.get(pose.sub_task)
        if ways is not None:
            before = se3.transform(before[:3, :3], ways.position(pose, entry.layout))
        after = entry.key_poses[i + 1] if i + 1 < len(entry.key_poses) else None
        # The arrival before the fingers move, or before a push, is where the contact is decided. Where a push
        # turns, the hand only passes by.
        turns = pose.phase == "push" and after is not None and after.phase == "push"
        precise = not turns and (
            pose.phase in CONTACT_PHASES or (after is not None and (after.dwell or after.phase == "push"))
        )
        axis = pose.axis
        if axis is not None:
            axis = replace(axis, direction=T_world_anchor[:3, :3] @ axis.direction)
        # Where a push turns, the hand meets its target elsewhere than where the way ends.
        is_straight = sum(p.phase == "push" and p.sub_task == pose.sub_task for p in entry.key_poses) == 1
        push = ways if pose.phase == "push" and is_straight else None
        targets.append(Target(before, pose, precise, axis, push))
    for sub_task, amount in (gone or {}).items():
        targets = _gone_on(targets, sub_task, amount)
    if targets and entry.key.sub_tasks[-1].operation == "put":
        targets += _release(targets)
    return tuple(targets) + _retreat(targets)


def _gone_on(targets: Sequence[Target], sub_task: int, amount: float) -> list[Target]:
    """Key poses of a sub-task whose drawer or knob has gone part of its way: take it where it is."""
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


def _heading(way: Array) -> float:
    return float(np.arctan2(way[1, 1] - way[0, 1], way[1, 0] - way[0, 0]))


def _length(way: Array) -> float:
    return float(np.linalg.norm(way[1, :2] - way[0, :2]))


def push_ways(entry: MemoryEntry, layout: Mapping[str, Array]) -> dict[int, PushWays]:
    """The ways of an entry's pushes by sub-task, of those whose outcome is known.

    A sub-task that also grasps its target is no push: the target goes where the hand carries it.
    """
    pushing, grasping = (
        {pose.sub_task for pose in entry.key_poses if pose.phase == phase} for phase in ("push", "grasp")
    )
    pushing -= grasping
    ways: dict[int, PushWays] = {}
    for outcome in entry.outcomes:
        if outcome.sub_task not in pushing or any(
            name not in where for name in outcome.objects for where in (entry.layout, layout)
        ):
            continue
        shown = np.stack([entry.layout[outcome.target][:3, 3], outcome.place_shown(entry.layout)])
        now = np.stack([layout[outcome.target][:3, 3], outcome.place(layout)])
        ways[outcome.sub_task] = PushWays(outcome.target, shown, now)
    return ways


def _release(targets: Sequence[Target]) -> list[Target]:
    """Letting go at the end, for a demonstration that was cut with the object still in the hand.

    A benchmark ends an episode when its goal first holds, which an object that is being lowered may do.
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


def _retreat(targets: Sequence[Target]) -> tuple[Target, ...]:
    """Backing off at the end, for a demonstration that was cut when its goal was reached.

    The hand leaves the way it came: against the direction in which it arrived at its last contact, seen from
    the hand.
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
    if float(se3.distances(last.T_world_ee, contact.T_world_ee)[0]) >= RETREAT_M:
        return ()
    arrival, before = targets[arrivals[-1]], targets[arrivals[-1] - 1]
    back = (se3.inverse(arrival.T_world_ee) @ before.T_world_ee)[:3, 3]
    step = se3.transform(np.eye(3), RETREAT_M * back / max(float(np.linalg.norm(back)), 1e-9))
    key_pose = replace(last.key_pose, phase="retreat", n_steps=1, dwell=False, confidence=0.5)
    return (Target(contact.T_world_ee @ step, key_pose, precise=False),)


def rise(last: Target, height: float) -> tuple[Target, ...]:
    """Straight up from the last key pose to a height in metres, if that is higher.

    The next task begins from there as its demonstrations did: clear of what stands around, and without the
    hand between the cameras and the objects.
    """
    T_world_ee = last.T_world_ee.copy()
    if height - T_world_ee[2, 3] < LEVEL_M:
        return ()
    T_world_ee[2, 3] = height
    key_pose = replace(last.key_pose, phase="retreat", n_steps=1, dwell=False, axis=None, confidence=0.5)
    return (Target(T_world_ee, key_pose, precise=False),)


def _nearest_equivalent(
    name: str,
    pose: MemoryKeyPose,
    layout: Mapping[str, Array],
    yaw_periods: Mapping[str, float],
    before: Array,
) -> Array:
    """The pose of a symmetric object, among those that look alike, from which the hand has to turn least."""
    choices = se3.yaw_equivalents(layout[name], yaw_periods.get(name, 2 * np.pi))
    after = [transfer_pose(pose.anchor.frame({**layout, name: T}), pose.T_obj_ee) for T in choices]
    turns = [float(se3.distances(before, T)[1]) for T in after]
    return choices[int(np.argmin(turns))]


def shape_deviation(entry: MemoryEntry, targets: Sequence[Target]) -> float:
    """How differently the hand has to move here from how the demonstration moved, in metres.

    Compared are the ways between consecutive key poses, seen from the later one. Between key poses of one
    anchor nothing differs. Where the hand pushes, pulls or turns something, a different way does different
    things to the object, so those count in full; in free space it hardly matters.
    """
    shown = [pose.anchor.frame(entry.layout) @ pose.T_obj_ee for pose in entry.key_poses]
    now = [target.T_world_ee for target in targets]
    constrained, free = [0.0], [0.0]
    for i, pose in enumerate(entry.key_poses[1:], start=1):  # a retreat of ours has nothing to compare with
        ways = [se3.inverse(poses[i]) @ poses[i - 1] for poses in (shown, now)]
        (constrained if pose.phase in CONSTRAINED_PHASES else free).append(float(se3.distance(*ways)))
    return max(constrained) + FREE_SPACE_SHARE * float(np.mean(free))


@dataclass(frozen=True)
class TransferLimits:
    """Bounds of the checks on transferred key poses.

    Attributes:
        reach_margin_m: How far outside the box that the demonstrations covered the hand may go.
        max_jump_m: Longest way between consecutive key poses.
        max_jump_rad: Largest turn between consecutive key poses.
        min_clearance_m: How far below the lowest demonstrated hand position the hand may go.
    """

    reach_margin_m: float = 0.10
    max_jump_m: float = 0.8
    max_jump_rad: float = 2.8
    min_clearance_m: float = 0.01


def check_transfer(
    targets: Sequence[Target], T_world_ee: Array, robot: RobotModel, limits: TransferLimits
) -> list[str]:
    """The paper's checks: reachability, pose jump, minimum distance. Returns what is wrong, in words.

    Minimum distance is kept from the support surface: the lowest point that the hand reached in the
    demonstrations bounds how low it may be sent.
    """
    problems: list[str] = []
    low, high = robot.workspace
    before = T_world_ee
    for i, target in enumerate(targets):
        where = f"key pose {i} ({target.key_pose.phase} at {target.key_pose.anchor.place})"
        p = target.T_world_ee[:3, 3]
        outside = np.maximum(np.maximum(low - p, p - high), 0.0)
        if (beyond := float(np.linalg.norm(outside[:2]))) > limits.reach_margin_m or (
            p[2] - high[2] > limits.reach_margin_m
        ):
            problems.append(
                f"{where} is {max(beyond, p[2] - high[2]):.3f} m outside the demonstrated workspace"
            )
        if low[2] - p[2] > limits.min_clearance_m:
            problems.append(f"{where} is {low[2] - p[2]:.3f} m below the lowest demonstrated hand position")
        metres, radians = se3.distances(before, target.T_world_ee)
        if metres > limits.max_jump_m or radians > limits.max_jump_rad:
            problems.append(f"{where} is {metres:.2f} m and {radians:.2f} rad from the one before")
        before = target.T_world_ee
    return problems


def geometric_score(
    entry: MemoryEntry,
    layout: Mapping[str, Array],
    yaw_periods: Mapping[str, float],
    T_world_ee: Array,
    robot: RobotModel,
    limits: TransferLimits,
) -> float:
    """``S_geo`` in 0..1: whether an entry can be executed here, and how like its demonstration it would be.

    0 where an object of its key poses was not found or the transferred key poses fail the checks. Else what
    :func:`shape_deviation` makes of the arrangement: where the objects lie to one another as in the entry's
    own layout, wherever that is, it is 1. Objects that no key pose is relative to make no difference.

    Args:
        entry: The entry.
        layout: Present poses ``T_world_obj`` ``(4, 4)`` of the objects that were found.
        yaw_periods: Angle by object that turns it into itself, radians; 0 for a body of revolution.
        T_world_ee: Present hand pose ``(4, 4)``.
        robot: The robot.
        limits: Bounds of the checks.
    """
    if any(name not in layout for name in entry.objects):
        return 0.0
    targets = transfer(entry, layout, yaw_periods, T_world_ee)
    if check_transfer(targets, T_world_ee, robot, limits):
        return 0.0
    return max(float(np.exp(-shape_deviation(entry, targets) / SHAPE_SCALE_M)), MIN_USABLE_SCORE)
