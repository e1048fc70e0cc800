"""Room for the joints: the hand is led away from the arm's base where a joint would come to its limit.

A key pose may be within reach and still be hard to pass: an arm that is folded up close to its own base has
no way left to go, and a controller that moves the hand straight on gets stuck there. Where the hand only
passes by, it does so a little further out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lerobot_openspm.control.clearance import UPRIGHT, shifted
from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import OUT_OF_REACH_M, OUT_OF_REACH_RAD, Arm
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import CONTACT_PHASES, MemoryEntry, MemoryKeyPose

# Joints keep this far from their limits where the hand passes by, radians.
ROOM_RAD = np.deg2rad(15)
# For that the hand is led away from the base by the least of these, metres.
OUT_M = tuple(np.arange(0.01, 0.125, 0.01).tolist())
# From there it first goes to this far above what it comes down to, metres.
ABOVE_M = 0.035


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
    for i, target in enumerate(targets):
        T = target.T_world_ee
        after = arm.onwards(T, before, stance)
        if _is_passed_by(target) and arm.room(after) < ROOM_RAD:
            for by in _outwards(T[:3, 3] - arm.base):
                beside = se3.transform(T[:3, :3], T[:3, 3] + by)
                angles = arm.onwards(beside, before, stance)
                if arm.room(angles) >= ROOM_RAD and _reaches(arm, beside, angles):
                    out[i], after = by, angles
                    break
        before = after
    return out


def led_out(entry: MemoryEntry, targets: Sequence[Target], out: Mapping[int, Array]) -> MemoryEntry:
    """An entry with some of its key poses shifted, from which the hand comes straight down to the next.

    Args:
        entry: What is to be executed.
        targets: Its key poses in the scene, at least as many as it has.
        out: By how much ``(3,)`` in the world key poses are shifted, by their index, metres.
    """
    poses: list[MemoryKeyPose] = []
    for i, (pose, target) in enumerate(zip(entry.key_poses, targets, strict=False)):
        if i in out:
            pose = shifted(target, out[i])
        elif i - 1 in out and target.precise and pose.phase in ("approach", "place"):
            above = shifted(target, np.array([0.0, 0.0, ABOVE_M]))
            poses.append(replace(above, phase=entry.key_poses[i - 1].phase))
        poses.append(pose)
    return replace(entry, key_poses=tuple(poses))


def _is_passed_by(target: Target) -> bool:
    """Whether the hand, pointing down, passes by a key pose without touching anything."""
    is_free = not target.precise and target.key_pose.phase not in CONTACT_PHASES
    return is_free and -target.T_world_ee[2, 2] > UPRIGHT


def _outwards(from_base: Array) -> list[Array]:
    """Ways ``(3,)`` further out for a hand that is ``(3,)`` from the base, the least first, metres."""
    x, y, _ = from_base
    away = np.array([x, y, 0.0]) / max(float(np.hypot(x, y)), 1e-9)
    return [metres * away for metres in OUT_M]


def _reaches(arm: Arm, T_world_ee: Array, angles: Array) -> bool:
    metres, radians = arm.miss(T_world_ee, angles)
    return metres <= OUT_OF_REACH_M and radians <= OUT_OF_REACH_RAD
