"""What every environment shares: what is remembered, and how it is carried over to a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lerobot_openspm.control.checks import TransferLimits, check_transfer, geometric_score
from lerobot_openspm.control.strategies import ControlSettings
from lerobot_openspm.control.transfer import Target, transfer
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.language.names import TABLE_NAMES, NameSimilarity
from lerobot_openspm.memory.compose import Candidate
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.retrieval import Scored, ScoreWeights, retrieve
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.perception.tracking.tracker import TrackerSettings


@dataclass(frozen=True)
class PlanningContext:
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
        names: Says which names in an instruction mean the same thing.
    """

    entries: Sequence[MemoryEntry]
    yaw_periods: Mapping[str, float]
    robot: RobotModel
    weights: ScoreWeights = field(default_factory=ScoreWeights)
    limits: TransferLimits = field(default_factory=TransferLimits)
    settings: ControlSettings = field(default_factory=ControlSettings)
    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    tracking: bool = True
    step_s: float = 0.05
    names: NameSimilarity = TABLE_NAMES

    def __deepcopy__(self, memo: dict[int, object]) -> PlanningContext:
        """Itself: nothing here ever changes, and the memory may be large."""
        return self

    def object_meant(self, name: str) -> str:
        """The object that is known by what a name in an instruction means; the name itself where none is."""
        alike = {known: self.names.similarity(name, known) for known in self.yaw_periods}
        best = max(alike, key=lambda known: alike[known], default=name)
        return best if alike.get(best, 0.0) > 0 else name

    @property
    def surfaces(self) -> dict[str, Array]:
        """The table under its names, at the middle of where the hand was in the demonstrations."""
        low, high = self.robot.workspace
        middle = se3.transform(np.eye(3), [*(low[:2] + high[:2]) / 2, low[2]])
        return dict.fromkeys(self.names.lexicon.surfaces, middle)

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

        def score(entry: MemoryEntry) -> float:
            return geometric_score(entry, layout, self.yaw_periods, T_world_ee, self.robot, self.limits)

        return retrieve(scored, score, self.weights, self.names)

    def transfer(
        self,
        entry: MemoryEntry,
        layout: Mapping[str, Array],
        T_world_ee: Array,
        gone: Mapping[int, float] | None = None,
    ) -> tuple[Target, ...]:
        """An entry's key poses in a scene, see :func:`transfer`."""
        return transfer(entry, layout, self.yaw_periods, T_world_ee, gone)

    def problems(self, entry: MemoryEntry, layout: Mapping[str, Array], T_world_ee: Array) -> list[str]:
        """What keeps the hand from following an entry in a scene, in words."""
        targets = self.transfer(entry, layout, T_world_ee)
        return check_transfer(targets, T_world_ee, self.robot, self.limits)
