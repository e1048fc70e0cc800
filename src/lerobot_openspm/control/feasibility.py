"""Whether the hand can follow transferred key poses, and how like the demonstration that would be."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from lerobot_openspm.control.transfer import Target, half_turned, transfer
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import OUT_OF_REACH_M, OUT_OF_REACH_RAD, Arm
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import CONSTRAINED_PHASES, MemoryEntry
from lerobot_openspm.memory.robot import RobotModel

logger = logging.getLogger(__name__)

# Longest way and largest turn between consecutive key poses: the reach of a table-top arm, and just short of
# half a turn, whose direction is open.
MAX_JUMP_M, MAX_JUMP_RAD = 0.8, 2.8
# How much a different motion through free space counts beside one in contact.
FREE_SPACE_SHARE = 0.2
# An entry whose motions differ by this much scores 1/e.
SHAPE_SCALE_M = 0.1
# An entry that can be executed at all scores at least this.
MIN_USABLE_SCORE = 1e-3


@dataclass(frozen=True)
class TransferLimits:
    """Bounds of the checks on transferred key poses.

    Attributes:
        reach_margin_m: How far outside the box that the demonstrations covered the hand may go, where the
            arm's joints do not tell its reach.
        min_clearance_m: How far below the lowest demonstrated hand position the hand may go.
    """

    reach_margin_m: float = 0.10
    min_clearance_m: float = 0.01


def check_transfer(
    targets: Sequence[Target],
    T_world_ee: Array,
    robot: RobotModel,
    limits: TransferLimits,
    joints_known: bool = False,
) -> list[str]:
    """The paper's checks: reachability, pose jump, minimum distance. Returns what is wrong, in words.

    Minimum distance is kept from the support surface: the lowest point that the hand reached in the
    demonstrations bounds how low it may be sent.

    Args:
        targets: The key poses.
        T_world_ee: Where the hand is ``(4, 4)``.
        robot: The robot.
        limits: The bounds.
        joints_known: Whether :func:`check_reach` tells the reach; else it is where the demonstrations went.
    """
    problems: list[str] = []
    low, high = robot.workspace
    before = T_world_ee
    for i, target in enumerate(targets):
        where = f"key pose {i} ({target.key_pose.phase} at {target.key_pose.anchor.place})"
        p = target.T_world_ee[:3, 3]
        outside = np.maximum(np.maximum(low - p, p - high), 0.0)
        beyond = max(float(np.linalg.norm(outside[:2])), p[2] - high[2])
        if beyond > limits.reach_margin_m and not joints_known:
            problems.append(f"{where} is {beyond:.3f} m outside the demonstrated workspace")
        if low[2] - p[2] > limits.min_clearance_m:
            problems.append(f"{where} is {low[2] - p[2]:.3f} m below the lowest demonstrated hand position")
        metres, radians = se3.distances(before, target.T_world_ee)
        if metres > MAX_JUMP_M or radians > MAX_JUMP_RAD:
            problems.append(f"{where} is {metres:.2f} m and {radians:.2f} rad from the one before")
        before = target.T_world_ee
    return problems


@dataclass(frozen=True)
class Miss:
    """A key pose that the arm's joints cannot reach.

    Attributes:
        index: Which one.
        target: The key pose in the scene.
        metres: How far from it the hand stays ...
        radians: ... and by how much it is turned away.
    """

    index: int
    target: Target
    metres: float
    radians: float

    def __str__(self) -> str:
        pose = self.target.key_pose
        return (
            f"key pose {self.index} ({pose.phase} at {pose.anchor.place}) is {self.metres:.3f} m and "
            f"{self.radians:.2f} rad beyond what the arm's joints reach"
        )


def find_stance(robot: RobotModel, T_world_ee: Array) -> Array | None:
    """The arm's joint angles ``(n,)`` where the hand is ``(4, 4)``.

    None where its kinematics are not known, or do not fit the scene: then nothing is refused by them.
    """
    if robot.arm is None:
        return None
    stance = robot.arm.stance(T_world_ee)
    metres, radians = robot.arm.miss(T_world_ee, stance)
    if metres <= OUT_OF_REACH_M and radians <= OUT_OF_REACH_RAD:
        return stance
    _warn_once(
        f"the arm does not fit: its joints miss even where the hand is now by {metres:.2f} m and "
        f"{radians:.1f} rad; reach is not checked by them. Pass the URDF of this robot, where it stands in "
        "this scene, as --policy.arm=FILE"
    )
    return None


@cache
def _warn_once(message: str) -> None:
    logger.warning("%s", message)


def check_reach(targets: Sequence[Target], T_world_ee: Array, arm: Arm, stance: Array) -> Miss | None:
    """The first key pose that the arm's joints cannot reach on their way through all of them.

    Args:
        targets: The key poses.
        T_world_ee: Where the hand is ``(4, 4)``.
        arm: The arm.
        stance: Its joint angles ``(n,)`` there.
    """
    misses = arm.misses((target.T_world_ee for target in targets), T_world_ee, stance)
    for i, (target, (metres, radians)) in enumerate(zip(targets, misses, strict=True)):
        if metres > OUT_OF_REACH_M or radians > OUT_OF_REACH_RAD:
            return Miss(i, target, metres, radians)
    return None


def geometric_score(
    entry: MemoryEntry,
    object_poses: Mapping[str, Array],
    yaw_periods: Mapping[str, float],
    T_world_ee: Array,
    robot: RobotModel,
    limits: TransferLimits,
) -> float:
    """``S_geo`` in 0..1: whether an entry can be executed here, and how like its demonstration it would be.

    It is 0 where an object of its key poses was not found or the transferred key poses fail the checks
    whichever way round the hand is. It is 1 where the objects lie to one another as in the demonstration,
    wherever that is. The arguments are those of :func:`transfer` and :func:`check_transfer`.
    """
    if any(name not in object_poses for name in entry.objects):
        return 0.0
    targets = transfer(entry, object_poses, yaw_periods, T_world_ee)
    checked = T_world_ee, robot, limits, robot.arm is not None
    if all(check_transfer(way, *checked) for way in (targets, half_turned(targets))):
        return 0.0
    return max(float(np.exp(-shape_deviation(entry, targets) / SHAPE_SCALE_M)), MIN_USABLE_SCORE)


def shape_deviation(entry: MemoryEntry, targets: Sequence[Target]) -> float:
    """How differently the hand has to move here from how the demonstration moved, in metres.

    The motions between consecutive key poses are compared in the frame of the later one; between key poses of
    one anchor they are equal. Where the hand pushes, pulls or turns something, a different motion does
    something else to the object, so those count in full. In free space a difference hardly matters.
    """
    shown = [pose.anchor.frame(entry.object_poses) @ pose.T_obj_ee for pose in entry.key_poses]
    now = [target.T_world_ee for target in targets]
    constrained, free = [0.0], [0.0]
    for i, pose in enumerate(entry.key_poses[1:], start=1):  # a retreat of ours has nothing to compare with
        ways = [se3.inverse(poses[i]) @ poses[i - 1] for poses in (shown, now)]
        (constrained if pose.phase in CONSTRAINED_PHASES else free).append(float(se3.distance(*ways)))
    return max(constrained) + FREE_SPACE_SHARE * float(np.mean(free))
