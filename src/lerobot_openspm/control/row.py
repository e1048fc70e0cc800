"""One environment from instruction to actions: look, retrieve, transfer, follow, look again."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.control.executor import ControlSettings, Executor, Hand, Status
from lerobot_openspm.control.transfer import Target, TransferLimits, check_transfer, shape_deviation, transfer
from lerobot_openspm.flow.condition import Query
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.retrieval import Scored, ScoreWeights, retrieve, semantic_candidates
from lerobot_openspm.memory.robot import RobotModel

logger = logging.getLogger(__name__)

# An object that is not found is looked for again after this many steps.
LOOK_AGAIN_STEPS = 5

# An entry whose key poses lie this much differently to one another here counts as 1/e alike.
SHAPE_SCALE_M = 0.1
# An entry that can be executed at all scores at least this.
MIN_USABLE_SCORE = 1e-3

# Names of objects -> poses T_world_obj of those that are found in the present images.
Look = Callable[[Sequence[str]], Mapping[str, Array]]


@dataclass(frozen=True)
class Knowledge:
    """What every environment shares: the memory, the robot, how to choose and how to follow."""

    entries: Sequence[MemoryEntry]
    yaw_periods: Mapping[str, float]
    robot: RobotModel
    weights: ScoreWeights
    limits: TransferLimits
    settings: ControlSettings


class Row:
    """State of one environment, and nothing that another environment could see.

    Attributes:
        instruction: What is to be done.
        executor: Follows the plan.
        ranked: The entries of the last retrieval with their scores, best first.
        layout: Poses ``T_world_obj`` of the objects found so far.
    """

    def __init__(self, knowledge: Knowledge, instruction: str, fingerprint: int, noise_seed: int):
        self._knowledge = knowledge
        self.instruction = instruction
        self.executor = Executor(knowledge.settings, knowledge.robot)
        self.ranked: list[Scored] = []
        self.layout: dict[str, Array] = {}
        self._idle_steps = 0
        # Told by what the episode shows first, so that it does not matter in which batch or row it runs.
        self._noise_key = (noise_seed, zlib.crc32(instruction.encode()), fingerprint)

    @property
    def status(self) -> Status:
        """What the execution is up to."""
        return self.executor.status

    def observe(self, hand: Hand, look: Look) -> None:
        """Take in a new observation: plan at the start, advance, and plan again when something went wrong."""
        if self.status in (Status.WAITING, Status.OBJECT_NOT_FOUND, Status.INFEASIBLE):
            if self._idle_steps % LOOK_AGAIN_STEPS == 0:
                self._plan(hand, look)
            self._idle_steps += 1
        if self.status is Status.RUNNING and self.executor.advance(hand):
            self._plan_again(hand, look)

    def next_action(self) -> Array | None:
        """The next canonical action ``(7,)``, or None when a chunk is needed."""
        return self.executor.next_action()

    def query(self, hand: Hand) -> Query:
        """The condition of the next chunk."""
        return self.executor.query(hand)

    def noise(self, shape: tuple[int, ...]) -> Array:
        """Standard normal noise of the next chunk, a function of (seed, episode, chunk) alone."""
        return np.random.default_rng([*self._noise_key, self.executor.replans]).standard_normal(shape)

    def _plan(self, hand: Hand, look: Look) -> None:
        candidates = semantic_candidates(self.instruction, self._knowledge.entries)
        names = list(dict.fromkeys(name for entry, _ in candidates for name in entry.objects))
        self.layout |= look(names)
        self.ranked = retrieve(
            candidates, lambda entry: self._geometric_score(entry, hand), self._knowledge.weights
        )
        best = self.ranked[0].entry
        if missing := [name for name in best.objects if name not in self.layout]:
            logger.info("%r: cannot find %s", self.instruction, missing)
            self.executor.status = Status.OBJECT_NOT_FOUND
        elif problems := self._problems(best, hand):
            logger.warning("%r: %s", self.instruction, "; ".join(problems))
            self.executor.status = Status.INFEASIBLE
        else:
            self.executor.begin(self._transfer(best, hand), hand)

    def _plan_again(self, hand: Hand, look: Look) -> None:
        """Find the objects of the remaining key poses again and go back to the approach of this contact."""
        entry, index = self.ranked[0].entry, self.executor.retry_index()
        ahead = list(dict.fromkeys(name for pose in entry.key_poses[index:] for name in pose.anchor.objects))
        found = look(ahead)
        if stale := [name for name in ahead if name not in found]:
            logger.info("%r: %s not found again, taken to be where it was", self.instruction, stale)
        self.layout |= found
        if problems := self._problems(entry, hand):
            logger.warning("%r: %s", self.instruction, "; ".join(problems))
            self.executor.status = Status.INFEASIBLE
        else:
            self.executor.begin(self._transfer(entry, hand), hand, index)

    def _geometric_score(self, entry: MemoryEntry, hand: Hand) -> float:
        """``S_geo``: 0 if an entry cannot be executed here, else how like its demonstration it would be."""
        if any(name not in self.layout for name in entry.objects) or self._problems(entry, hand):
            return 0.0
        deviation = shape_deviation(entry, self._transfer(entry, hand))
        return max(float(np.exp(-deviation / SHAPE_SCALE_M)), MIN_USABLE_SCORE)

    def _transfer(self, entry: MemoryEntry, hand: Hand) -> tuple[Target, ...]:
        return transfer(entry, self.layout, self._knowledge.yaw_periods, hand.T_world_ee)

    def _problems(self, entry: MemoryEntry, hand: Hand) -> list[str]:
        targets = self._transfer(entry, hand)
        return check_transfer(targets, hand.T_world_ee, self._knowledge.robot, self._knowledge.limits)
