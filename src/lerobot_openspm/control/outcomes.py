"""Whether what was to be done is done: the demonstrated outcomes, compared with the scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import WORLD, MemoryEntry, Outcome

# After the last key pose the policy looks up to three times at what it moved. Then the outcome stays unknown.
LOOKS_AT_OUTCOME = 3


@dataclass
class PartProgress:
    """How far the present part of an instruction has come.

    Attributes:
        looks_left: How often its end may still be looked at.
        verdict: Whether it is seen to be done; None where that is not known.
        gone: How far drawers and knobs are on their way, by sub-task, metres or radians.
        followed: Sub-tasks whose drawer or knob went all the way.
        repeated: The sub-task that is done again, if one is.
    """

    looks_left: int = LOOKS_AT_OUTCOME
    verdict: bool | None = None
    gone: dict[int, float] = field(default_factory=dict[int, float])
    followed: set[int] = field(default_factory=set[int])
    repeated: int | None = None

    def look_again(self, sub_task: int) -> None:
        """Do one sub-task again, and look at it afresh then."""
        self.looks_left, self.verdict, self.repeated = LOOKS_AT_OUTCOME, None, sub_task

    def judge(self, entry: MemoryEntry, met: Sequence[Outcome], missed: Sequence[Outcome]) -> None:
        """Take in which outcomes are met: with handles that went all the way, they tell what is done."""
        done = {one.sub_task for one in met} | self.followed
        is_all_known = done >= set(range(len(entry.key.sub_tasks)))
        self.verdict = False if missed else (is_all_known or None)


def expected_outcomes(entry: MemoryEntry) -> list[Outcome]:
    """The outcomes that an entry's key poses can bring about; others could not be mended."""
    served = {pose.sub_task for pose in entry.key_poses}
    return [one for one in entry.outcomes if one.sub_task in served]


def is_met(outcome: Outcome, poses: Mapping[str, Array], yaw_periods: Mapping[str, float]) -> bool:
    """Whether an outcome is met whichever way round a symmetric landmark was seen."""
    axes = outcome.anchor.axes
    if axes == WORLD:
        return outcome.is_met(poses)
    turned = se3.yaw_equivalents(poses[axes], yaw_periods.get(axes, 2 * np.pi))
    return any(outcome.is_met({**poses, axes: T}) for T in turned)
