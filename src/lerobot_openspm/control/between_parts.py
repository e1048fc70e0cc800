"""The way from the end of one part of an instruction to the beginning of the next."""

from __future__ import annotations

from dataclasses import replace

from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

# A hand that is at most this much too low need not rise.
LEVEL_M = 0.02
# A hand that is turned by more than this at the end of a part is turned back before the next one, radians.
TURNED_RAD = 0.8
# The way back ends within this distance and angle, metres and radians.
BACK_M, BACK_RAD = 0.1, 0.3


def rise(last: Target, T_start: Array) -> tuple[Target, ...]:
    """Straight up from the last key pose to the height of where the episode began, if that is higher.

    A hand that is turned otherwise by now goes back about there: not every turn can be made anywhere. The
    next part of an instruction then begins as its demonstrations did: clear of what stands around, and
    without the hand between the cameras and the objects.

    Args:
        last: The last key pose.
        T_start: Where the hand was when the episode began, ``T_world_ee`` ``(4, 4)``.
    """
    key_pose = replace(last.key_pose, phase="retreat", n_steps=1, dwell=False, axis=None, confidence=0.5)
    if float(se3.distances(last.T_world_ee, T_start)[1]) > TURNED_RAD:
        back = Target(T_start, key_pose, precise=False, passing_m=BACK_M, passing_rad=BACK_RAD)
        return (back,)
    if T_start[2, 3] - last.T_world_ee[2, 3] < LEVEL_M:
        return ()
    T_world_ee = last.T_world_ee.copy()
    T_world_ee[2, 3] = T_start[2, 3]
    return (Target(T_world_ee, key_pose, precise=False),)
