"""Carrying key poses over to the present scene, and checking that the hand can follow them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import Axis, MemoryEntry, MemoryKeyPose
from lerobot_openspm.memory.robot import RobotModel

# Phases in which the hand touches something: their key poses are met precisely, the others in passing.
PRECISE_PHASES = ("grasp", "place", "release", "push", "open", "turn")

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


@dataclass(frozen=True)
class Target:
    """A key pose in the present scene.

    Attributes:
        T_world_ee: Where the hand is to be, ``(4, 4)``.
        memory: The key pose it was carried over from.
        precise: Whether it is met by terminal residual correction, or only passed by.
        axis: The constraint that the way here follows, its direction in the world; None in free space.
    """

    T_world_ee: Array
    memory: MemoryKeyPose
    precise: bool
    axis: Axis | None = None


def transfer_pose(T_world_obj: Array, T_obj_ee: Array) -> Array:
    """``T_world_ee = T_world_obj @ T_obj_ee``, the paper's transfer rule; batched over leading axes."""
    return T_world_obj @ T_obj_ee


def transfer(
    entry: MemoryEntry, layout: Mapping[str, Array], yaw_periods: Mapping[str, float], T_world_ee: Array
) -> tuple[Target, ...]:
    """Carry an entry's key poses over to the scene.

    An object that looks the same after, say, half a turn may be met from either side; the side that needs
    less turning of the hand is taken.

    Args:
        entry: The entry to execute.
        layout: Present poses ``T_world_obj`` ``(4, 4)`` of its anchors.
        yaw_periods: Angle by object that turns it into itself, radians; 0 for a body of revolution.
        T_world_ee: Present hand pose ``(4, 4)``.
    """
    chosen: dict[str, Array] = {}
    targets: list[Target] = []
    before = T_world_ee
    for i, pose in enumerate(entry.key_poses):
        for name in pose.anchor.objects:
            if name not in chosen:
                chosen[name] = _nearest_equivalent(name, pose, {**layout, **chosen}, yaw_periods, before)
        T_world_anchor = pose.anchor.frame(chosen)
        before = transfer_pose(T_world_anchor, pose.T_obj_ee)
        after = entry.key_poses[i + 1] if i + 1 < len(entry.key_poses) else None
        # The arrival before the fingers move is where a grasp or a release is decided.
        precise = pose.phase in PRECISE_PHASES or (
            after is not None and (after.dwell or after.phase == "push")
        )
        axis = pose.axis
        if axis is not None:
            axis = replace(axis, direction=T_world_anchor[:3, :3] @ axis.direction)
        targets.append(Target(before, pose, precise, axis))
    if targets and entry.key.sub_tasks[-1].operation == "put":
        targets += _release(targets)
    return tuple(targets) + _retreat(targets)


def _release(targets: Sequence[Target]) -> list[Target]:
    """Letting go at the end, for a demonstration that was cut with the object still in the hand.

    A benchmark ends an episode when its goal first holds, which an object that is being lowered may do.
    """
    last = targets[-1]
    if last.memory.phase != "place":
        return []
    waits = [target.memory.n_steps for target in targets if target.memory.dwell]
    memory = replace(
        last.memory, phase="release", closed=False, n_steps=max(waits, default=1), dwell=True, confidence=0.5
    )
    return [Target(last.T_world_ee, memory, precise=True)]


def _retreat(targets: Sequence[Target]) -> tuple[Target, ...]:
    """Backing off at the end, for a demonstration that was cut when its goal was reached.

    The hand leaves the way it came: against the direction in which it arrived at its last contact, seen from
    the hand.
    """
    arrivals = [
        i
        for i, target in enumerate(targets)
        if i > 0
        and (target.memory.phase == "place" or (target.memory.phase == "approach" and target.precise))
    ]
    contacts = [target for target in targets if target.memory.phase in PRECISE_PHASES]
    if not arrivals or not contacts:
        return ()
    last, contact = targets[-1], contacts[-1]
    if float(se3.distances(last.T_world_ee, contact.T_world_ee)[0]) >= RETREAT_M:
        return ()
    arrival, before = targets[arrivals[-1]], targets[arrivals[-1] - 1]
    back = (se3.inverse(arrival.T_world_ee) @ before.T_world_ee)[:3, 3]
    step = se3.transform(np.eye(3), RETREAT_M * back / max(float(np.linalg.norm(back)), 1e-9))
    memory = replace(last.memory, phase="retreat", n_steps=1, dwell=False, confidence=0.5)
    return (Target(contact.T_world_ee @ step, memory, precise=False),)


def rise(last: Target, height: float) -> tuple[Target, ...]:
    """Straight up from the last key pose to a height in metres, if that is higher.

    The next task begins from there as its demonstrations did: clear of what stands around, and without the
    hand between the cameras and the objects.
    """
    T_world_ee = last.T_world_ee.copy()
    if height - T_world_ee[2, 3] < LEVEL_M:
        return ()
    T_world_ee[2, 3] = height
    memory = replace(last.memory, phase="retreat", n_steps=1, dwell=False, axis=None, confidence=0.5)
    return (Target(T_world_ee, memory, precise=False),)


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
        where = f"key pose {i} ({target.memory.phase} at {target.memory.anchor.place})"
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
