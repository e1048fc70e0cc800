"""When the gripper closes and opens, and when its fingers have come to rest."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.signals import Episode

# Gripper commands that last fewer steps are noise.
MIN_COMMAND_STEPS = 4
# The fingers have come to rest when they are slower than this fraction of their fastest.
SWEEP_FRACTION = 0.25
MIN_SETTLING_STEPS, MAX_SETTLING_STEPS = 3, 30
# Opening fingers have parted after this fraction of their way.
PARTING_FRACTION = 0.02
# A hand that has not moved further than this has not left.
STAYING_M = 0.02
# A hand that leaves a contact moves away from it by more than this in every step.
LEAVING_M = 0.0008
# A hand that rises or sinks by this much has changed its height.
LIFTED_M = 0.03


def closed_frames(episode: Episode, robot: RobotModel) -> NDArray[np.bool_]:
    """In which frames ``(n,)`` the gripper is commanded closed.

    Commands that are too short to be meant are dropped. So are closings during which the hand stays where it
    is until the gripper opens again: it took nothing.
    """
    closed = robot.closed(episode.actions[:, 6])
    for first, last in pairwise(_bounds(closed)):
        if first > 0 and last - first < MIN_COMMAND_STEPS:
            closed[first:last] = closed[first - 1]
    poses = episode.T_world_ee
    for first, last in list(pairwise(_bounds(closed)))[1:-1]:
        stayed = se3.distance(poses[first], poses[first : last + 1]).max() < STAYING_M
        if closed[first] and stayed:
            closed[first:last] = False
    return closed


def _bounds(closed: NDArray[np.bool_]) -> list[int]:
    """First frames of the runs of equal commands, and the number of frames."""
    return [0, *(np.flatnonzero(np.diff(closed)) + 1).tolist(), len(closed)]


def settled(episode: Episode, start: int, until: int) -> int:
    """Frame at which the fingers rest after a transition, or the hand leaves, whichever is later.

    A hand that trembles or drifts while its operator waits has not left.
    """
    rest = _fingers_rest(episode.opening[start : min(start + MAX_SETTLING_STEPS, until) + 1])
    away = se3.distance(episode.T_world_ee[start + rest], episode.T_world_ee[start + rest : until + 1])
    left = np.flatnonzero(away > STAYING_M)
    if not len(left):
        return until
    leaving = int(left[0])
    while leaving > 0 and away[leaving] > away[leaving - 1] + LEAVING_M:
        leaving -= 1
    return start + rest + leaving


def _fingers_rest(opening: Array) -> int:
    """Index at which a sweep of the fingers ends; afterwards they may still rattle around what they hold."""
    speed = np.abs(np.diff(opening))
    fastest = int(np.argmax(speed, axis=0)) if len(speed) else 0
    slow = np.flatnonzero(speed[fastest:] <= SWEEP_FRACTION * speed[fastest]) if len(speed) else []
    return max(fastest + int(slow[0]), min(MIN_SETTLING_STEPS, len(speed))) if len(slow) else len(speed)


def parting(opening: Array) -> int:
    """Index of the last frame before fingers that were told to open part: a tight grip eases first."""
    sweep = opening - opening[0]
    return max(int(np.argmax(sweep >= PARTING_FRACTION * sweep.max())) - 1, 0) if sweep.max() > 0 else 0


def is_empty_closure(episode: Episode, start: int, end: int) -> bool:
    """Whether fingers that are closed during a span hold nothing, by where the hand goes.

    What is held was taken where it stood, so the hand first rises with it, or stays level to pull or turn it.
    A hand that first goes down was closed in the air, to push.
    """
    height = episode.T_world_ee[start : end + 1, 2, 3] - episode.T_world_ee[start, 2, 3]
    away = np.flatnonzero(np.abs(height) > LIFTED_M)
    return bool(len(away) and height[away[0]] < 0)
