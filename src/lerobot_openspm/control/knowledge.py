"""What every environment shares: what is remembered, and how it is carried over to a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lerobot_openspm.control.executor import ControlSettings
from lerobot_openspm.control.transfer import Target, TransferLimits, check_transfer, shape_deviation, transfer
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.compound import Candidate
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.retrieval import Scored, ScoreWeights, retrieve
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.perception.tracker import TrackerSettings

# An entry whose key poses lie this much differently to one another here counts as 1/e alike.
SHAPE_SCALE_M = 0.1
# An entry that can be executed at all scores at least this.
MIN_USABLE_SCORE = 1e-3


@dataclass(frozen=True)
class Knowledge:
    """What every environment shares: the memory, the robot, how to choose and how to follow.

    Attributes:
        entries: The memory bank.
        yaw_periods: Angle by object that turns it into itself, radians.
        robot: The robot.
        weights: Of retrieval.
        limits: Of transferred key poses.
        settings: How key poses are followed.
        tracker: When poses are believed.
        tracking: Whether objects are looked for again once a plan is made.
        step_s: Seconds that a control step takes.
    """

    entries: Sequence[MemoryEntry]
    yaw_periods: Mapping[str, float]
    robot: RobotModel
    weights: ScoreWeights
    limits: TransferLimits
    settings: ControlSettings
    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    tracking: bool = True
    step_s: float = 0.05

    def rank(
        self, candidates: Sequence[Candidate], layout: Mapping[str, Array], T_world_ee: Array
    ) -> list[Scored]:
        """Candidates by the paper's score in a scene, best first.

        Args:
            candidates: What is about the task.
            layout: Poses ``T_world_obj`` ``(4, 4)`` of the objects that were found.
            T_world_ee: The hand's pose ``(4, 4)``.
        """
        scored = [(one.entry, one.semantic) for one in candidates]
        return retrieve(scored, lambda entry: self._geometric_score(entry, layout, T_world_ee), self.weights)

    def transfer(
        self, entry: MemoryEntry, layout: Mapping[str, Array], T_world_ee: Array
    ) -> tuple[Target, ...]:
        """An entry's key poses in a scene, see :func:`transfer`."""
        return transfer(entry, layout, self.yaw_periods, T_world_ee)

    def problems(self, entry: MemoryEntry, layout: Mapping[str, Array], T_world_ee: Array) -> list[str]:
        """What keeps the hand from following an entry in a scene, in words."""
        targets = self.transfer(entry, layout, T_world_ee)
        return check_transfer(targets, T_world_ee, self.robot, self.limits)

    def _geometric_score(self, entry: MemoryEntry, layout: Mapping[str, Array], T_world_ee: Array) -> float:
        """``S_geo``: 0 if an entry cannot be executed here, else how like its demonstration it would be."""
        if any(name not in layout for name in entry.objects) or self.problems(entry, layout, T_world_ee):
            return 0.0
        deviation = shape_deviation(entry, self.transfer(entry, layout, T_world_ee))
        return max(float(np.exp(-deviation / SHAPE_SCALE_M)), MIN_USABLE_SCORE)
