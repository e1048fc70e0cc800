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
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.retrieval import Scored, ScoreWeights, retrieve, semantic_candidates
from lerobot_openspm.memory.robot import RobotModel

logger = logging.getLogger(__name__)

# An object that is not found is looked for again after this many steps.
LOOK_AGAIN_STEPS = 5

# Poses found while the hand is about are believed from this confidence on. Measured on LIBERO: nine in ten
# of those above it were within 2 mm of the truth; below it, the hand being in the way, many were centimetres
# off.
SURE = 0.95
# An object that is seen this far from where it was taken to be has moved; less is the noise of finding it.
MOVED_M = 0.002

# An entry whose key poses lie this much differently to one another here counts as 1/e alike.
SHAPE_SCALE_M = 0.1
# An entry that can be executed at all scores at least this.
MIN_USABLE_SCORE = 1e-3

# Names of objects, least confidence -> poses T_world_obj of those that are found in the present images.
Look = Callable[[Sequence[str], float], Mapping[str, Array]]


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
        self._planned_from = np.eye(4)  # the hand's pose when the plan was made
        # Told by what the episode shows first, so that it does not matter in which batch or row it runs.
        self._noise_key = (noise_seed, zlib.crc32(instruction.encode()), fingerprint)

    @property
    def status(self) -> Status:
        """What the execution is up to."""
        return self.executor.status

    def observe(self, hand: Hand, look: Look) -> None:
        """Take in a new observation: plan, advance, look again where a key pose was reached, try again."""
        if self.status in (Status.WAITING, Status.OBJECT_NOT_FOUND, Status.INFEASIBLE):
            if self._idle_steps % LOOK_AGAIN_STEPS == 0:
                self._plan(hand, look)
            self._idle_steps += 1
        index = self.executor.index
        if self.status is Status.RUNNING and self.executor.advance(hand):
            self._try_again(hand, look)
        elif self.executor.index != index and self._knowledge.settings.execution != "open_loop":
            self._look_again(look)

    def next_action(self, hand: Hand) -> Array | None:
        """The next canonical action ``(7,)``, or None when a chunk is needed."""
        return self.executor.next_action(hand)

    def query(self, hand: Hand) -> Query:
        """The condition of the next chunk."""
        return self.executor.query(hand)

    def noise(self, shape: tuple[int, ...]) -> Array:
        """Standard normal noise of the next chunk, a function of (seed, episode, chunk) alone."""
        return np.random.default_rng([*self._noise_key, self.executor.replans]).standard_normal(shape)

    def _plan(self, hand: Hand, look: Look) -> None:
        candidates = semantic_candidates(self.instruction, self._knowledge.entries)
        names = list(dict.fromkeys(name for entry, _ in candidates for name in entry.objects))
        self.layout |= look(names, 0.0)
        self.ranked = retrieve(
            candidates, lambda entry: self._geometric_score(entry, hand.T_world_ee), self._knowledge.weights
        )
        best = self.ranked[0].entry
        if missing := [name for name in best.objects if name not in self.layout]:
            logger.info("%r: cannot find %s", self.instruction, missing)
            self.executor.status = Status.OBJECT_NOT_FOUND
        elif problems := self._problems(best, hand.T_world_ee):
            logger.warning("%r: %s", self.instruction, "; ".join(problems))
            self.executor.status = Status.INFEASIBLE
        else:
            self._planned_from = hand.T_world_ee
            self.executor.begin(self._transfer(best, hand.T_world_ee), hand)

    def _look_again(self, look: Look) -> None:
        """Find what the hand has not touched yet again, and move the key poses along if it has moved."""
        target, index = self.executor.target, self.executor.index
        if target is None or target.memory.dwell:  # done, or the fingers hide what they are around
            return
        touched = {pose.memory.anchor.place for pose in self.executor.plan[:index] if _touches(pose)}
        untouched = [name for name in self._anchors(index) if name not in touched]
        found: Mapping[str, Array] = look(untouched, SURE) if untouched else {}
        moved = {name: T for name, T in found.items() if _distance(T, self.layout[name]) > MOVED_M}
        if moved and self._update(moved):
            logger.info("%r: moved: %s", self.instruction, ", ".join(moved))
            self.executor.change(self._transfer(self.ranked[0].entry, self._planned_from))

    def _try_again(self, hand: Hand, look: Look) -> None:
        """Find the objects of the remaining key poses again and go back to the approach of this contact."""
        index = self.executor.retry_index()
        self._planned_from = hand.T_world_ee
        self._update(look(self._anchors(index), SURE))
        self.executor.begin(self._transfer(self.ranked[0].entry, self._planned_from), hand, index)

    def _anchors(self, index: int) -> list[str]:
        """Objects of the key poses from one on."""
        ahead = self.ranked[0].entry.key_poses[index:]
        return list(dict.fromkeys(name for pose in ahead for name in pose.anchor.objects))

    def _update(self, found: Mapping[str, Array]) -> bool:
        """Believe new poses, unless the hand could not follow key poses there."""
        entry, believed = self.ranked[0].entry, self.layout
        self.layout = {**believed, **found}
        if problems := self._problems(entry, self._planned_from):
            logger.info("%r: not believed: %s", self.instruction, "; ".join(problems))
            self.layout = believed
        return not problems

    def _geometric_score(self, entry: MemoryEntry, T_world_ee: Array) -> float:
        """``S_geo``: 0 if an entry cannot be executed here, else how like its demonstration it would be."""
        if any(name not in self.layout for name in entry.objects) or self._problems(entry, T_world_ee):
            return 0.0
        deviation = shape_deviation(entry, self._transfer(entry, T_world_ee))
        return max(float(np.exp(-deviation / SHAPE_SCALE_M)), MIN_USABLE_SCORE)

    def _transfer(self, entry: MemoryEntry, T_world_ee: Array) -> tuple[Target, ...]:
        return transfer(entry, self.layout, self._knowledge.yaw_periods, T_world_ee)

    def _problems(self, entry: MemoryEntry, T_world_ee: Array) -> list[str]:
        targets = self._transfer(entry, T_world_ee)
        return check_transfer(targets, T_world_ee, self._knowledge.robot, self._knowledge.limits)


def _touches(target: Target) -> bool:
    """Whether the hand takes hold of the anchor or moves it; it is not where it was seen from then on."""
    return target.memory.phase in ("grasp", "push", "open", "turn")


def _distance(T: Array, other: Array) -> float:
    return float(se3.distances(T, other)[0])
