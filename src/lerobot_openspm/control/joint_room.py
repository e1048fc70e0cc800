"""Room for the joints: a hand that rises with its load is led away from the arm's base where it needs that.

A key pose may be within reach and still be hard to pass: an arm that is folded up close to its own base has
no way left to go, and a controller that moves the hand straight on gets stuck there. On its way down the hand
goes as it was shown: the longer it is on its way so close to the base, the further the arm drifts.

An arm that is stretched out has no room either: carried on a little further, its elbow turns over, and from
there a pull inwards only presses the elbow against its limit. Pushed outwards, it turns back.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lerobot_openspm.control.clearance import UPRIGHT
from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import OUT_OF_REACH_M, OUT_OF_REACH_RAD, Arm
from lerobot_openspm.geometry.se3 import Array

# Joints keep this far from their limits, radians.
ROOM_RAD = np.deg2rad(15)
# For that the hand is led away from the base by the least of these, metres.
OUT_M = tuple(np.arange(0.01, 0.125, 0.01).tolist())
# An arm that cannot go on by the first of these is stretched, metres: by half of that the hand overshoots.
FURTHER_M = (0.045, 0.035, 0.025, 0.015, 0.005)
# A hand whose elbow is turned over stays further out than it should: that is at least this share of how far
# it is from there.
TOO_FAR_OUT_SHARE = 0.5


def ways_out(targets: Sequence[Target], arm: Arm, stance: Array) -> dict[int, Array]:
    """How far ``(3,)`` beside key poses the hand passes by, in the world, by their index; metres.

    Key poses that leave the joints room are left out, and so are those that leave none further out either.

    Args:
        targets: The key poses in the scene.
        arm: The arm.
        stance: Its joint angles ``(n,)`` where the hand is now.
    """
    out: dict[int, Array] = {}
    before = stance
    for i, (target, is_rising) in enumerate(zip(targets, _are_rising(targets), strict=True)):
        T = target.T_world_ee
        after = arm.onwards(T, before, stance)
        if is_rising and arm.room(after) < ROOM_RAD:
            for by in _outwards(T[:3, 3] - arm.base):
                beside = se3.transform(T[:3, :3], T[:3, 3] + by)
                angles = arm.onwards(beside, before, stance)
                if arm.room(angles) >= ROOM_RAD and _reaches(arm, beside, angles):
                    out[i], after = by, angles
                    break
        before = after
    return out


def reach_left(targets: Sequence[Target], arm: Arm, stance: Array) -> float:
    """How much further out from its base the arm could go on its way to and from a grasp, metres.

    At most the first of FURTHER_M, which is enough; arguments as of ways_out.
    """
    left = FURTHER_M[0]
    for target in targets:
        if target.key_pose.phase in ("approach", "grasp", "lift"):
            R, p = target.T_world_ee[:3, :3], target.T_world_ee[:3, 3]
            for metres in (metres for metres in (*FURTHER_M, 0.0) if metres <= left):
                left = metres
                further = se3.transform(R, p + _away(p - arm.base) * metres)
                if _reaches(arm, further, arm.onwards(further, stance, stance)):
                    break
    return left


def way_to_turn_back(T_world_ee: Array, T_world_target: Array, arm: Arm) -> Array | None:
    """The level unit vector ``(3,)`` outwards, if an elbow may be turned over that a push there turns back.

    None where the hand ``(4, 4)`` is not stretched out, or is not mainly further out than it is to be
    ``(4, 4)``.
    """
    p = T_world_ee[:3, 3]
    out, off = _away(p - arm.base), p - T_world_target[:3, 3]
    if float(out @ off) <= TOO_FAR_OUT_SHARE * float(np.linalg.norm(off)):
        return None
    further = se3.transform(T_world_ee[:3, :3], p + out * FURTHER_M[0])
    return None if _reaches(arm, further, arm.stance(further)) else out


def _are_rising(targets: Sequence[Target]) -> list[bool]:
    """Of each key pose, whether the hand, pointing down, passes by over the place of what it has grasped."""
    grasped: dict[int, str] = {}
    are_rising: list[bool] = []
    for target in targets:
        pose = target.key_pose
        if pose.phase == "grasp":
            grasped[pose.sub_task] = pose.anchor.place
        is_over = pose.phase in ("lift", "pre-place") and pose.anchor.place == grasped.get(pose.sub_task)
        are_rising.append(is_over and not target.precise and -target.T_world_ee[2, 2] > UPRIGHT)
    return are_rising


def _outwards(from_base: Array) -> list[Array]:
    """Ways ``(3,)`` further out for a hand that is ``(3,)`` from the base, the least first, metres."""
    return [metres * _away(from_base) for metres in OUT_M]


def _away(from_base: Array) -> Array:
    """The level unit vector ``(3,)`` away from the base, of a hand that is ``(3,)`` from it."""
    x, y, _ = from_base
    return np.array([x, y, 0.0]) / max(float(np.hypot(x, y)), 1e-9)


def _reaches(arm: Arm, T_world_ee: Array, angles: Array) -> bool:
    metres, radians = arm.miss(T_world_ee, angles)
    return metres <= OUT_OF_REACH_M and radians <= OUT_OF_REACH_RAD
