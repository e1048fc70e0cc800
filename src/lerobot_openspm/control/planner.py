"""What an instruction is carried out by, part by part, and where its key poses are in the present scene."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from lerobot_openspm.control.grounding import references
from lerobot_openspm.control.plan import Plan, until
from lerobot_openspm.control.planning_context import PlanningContext
from lerobot_openspm.control.scene import SceneState
from lerobot_openspm.control.transfer import Target, rise
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.compose import Candidate, plan_parts
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.retrieval import Scored
from lerobot_openspm.types import Hand

logger = logging.getLogger(__name__)

# An object that is this far from where the key poses took it to be takes them along; less is noise.
MOVED_M, MOVED_RAD = 0.002, 0.05


class Planner:
    """Chooses an entry for each part of an instruction, and carries its key poses over to the scene.

    Attributes:
        instruction: What is to be done.
        parts: For each part of the instruction, in order, what it can be carried out by; none before a look.
        part: The part that is carried out now, counted from 0.
        ranked: The entries of the last retrieval with their scores, best first; where a part of the
            instruction is carried out, those parts of entries that are about it.
        object_poses: Poses ``T_world_obj`` that the plan was made with: of what the hand has touched, from
            before.
        used: The entries of the memory that were acted by so far, each once, in order.
        T_world_ee: The hand's pose ``(4, 4)`` when the plan was made.
    """

    def __init__(self, context: PlanningContext, scene: SceneState, instruction: str):
        self._context, self._scene, self.instruction = context, scene, instruction
        self.parts: tuple[tuple[Candidate, ...], ...] = ()
        self.part = 0
        self.ranked: list[Scored] = []
        self.object_poses: dict[str, Array] = {}
        self.used: list[MemoryEntry] = []
        self.T_world_ee = np.eye(4)
        self._start_height = np.inf

    # The parts.

    def read(self, hand: Hand) -> None:
        """Find out what the instruction can be carried out by.

        Raises:
            InstructionError: Nothing in the memory is about it.
        """
        self.parts = plan_parts(self.instruction, self._context.entries, self._context.names)
        self._ground()
        self._start_height = float(hand.T_world_ee[2, 3])

    @property
    def is_last_part(self) -> bool:
        """Whether nothing is left to do after the present part."""
        return self.part + 1 >= len(self.parts)

    def begin_next_part(self) -> None:
        """Turn to the next part of the instruction."""
        self.part += 1
        self._ground()
        logger.info("%r: part %d of %d", self.instruction, self.part + 1, len(self.parts))

    def _ground(self) -> None:
        """Take in which of several like objects the present part is about."""
        meant = self._context.object_meant
        said = {k: where for one in self.parts[self.part] for k, where in references(one, meant).items()}
        others = self._scene.grounding.hear(said)
        self._scene.tracker.forget(others)
        self.object_poses = {name: T for name, T in self.object_poses.items() if name not in others}
        self._scene.altered -= set(others)

    def sought(self) -> list[str]:
        """Objects of this part, and of those to come, which it may hide; not what looks different now."""
        entries = [one.entry for part in self.parts[self.part :] for one in part]
        needed = [name for entry in entries for name in entry.objects]
        names = dict.fromkeys([*needed, *self._scene.grounding.landmarks])
        return [name for name in names if name not in self._scene.altered]

    # The entry.

    def choose(self, hand: Hand) -> MemoryEntry:
        """The best entry for the present part, by the objects found so far."""
        self.object_poses |= self._scene.tracker.poses(hand.T_world_ee)
        candidates = self.parts[self.part]
        self.ranked = self._context.rank(candidates, self.object_poses, hand.T_world_ee)
        return self.ranked[0].entry

    def problems(self, hand: Hand) -> list[str]:
        """What keeps the hand from following the chosen entry, in words."""
        return self._context.problems(self.ranked[0].entry, self.object_poses, hand.T_world_ee)

    def note_use(self) -> None:
        """The chosen entry is acted by from now on."""
        best = self.ranked[0].entry
        source = next(one.source for one in self.parts[self.part] if one.entry is best)
        if not any(used is source for used in self.used):
            self.used.append(source)

    # Its key poses.

    @property
    def plan(self) -> Plan:
        """What is acted by, and where."""
        return Plan(self.ranked[0].entry, self.object_poses, self.T_world_ee)

    def targets(self, gone: dict[int, float], repeated: int | None) -> tuple[Target, ...]:
        """The key poses where the objects are now.

        Args:
            gone: How far drawers and knobs are on their way, by sub-task, metres or radians.
            repeated: The sub-task that is done again, and none after it; None if none is.
        """
        entry = self.ranked[0].entry
        if repeated is not None:
            entry = until(entry, repeated)
        targets = self._context.transfer(entry, self.object_poses, self.T_world_ee, gone)
        return targets if self.is_last_part else (*targets, *rise(targets[-1], self._start_height))

    def update(self, names: Sequence[str], hand: Hand) -> set[str]:
        """Take over where objects are now, unless the hand could not follow key poses there.

        Returns:
            Those that are elsewhere than before.
        """
        poses, planned = self._scene.tracker.poses(hand.T_world_ee), self.object_poses
        changed = {name for name in names if name in poses and _is_moved(poses[name], planned[name])}
        if not changed:
            return changed
        poses = {**planned, **{name: poses[name] for name in changed}}
        if problems := self._context.problems(self.ranked[0].entry, poses, self.T_world_ee):
            logger.info("%r: not believed: %s", self.instruction, "; ".join(problems))
            return set()
        self.object_poses = poses
        return changed


def _is_moved(T: Array, other: Array) -> bool:
    metres, radians = se3.distances(T, other)
    return bool(metres > MOVED_M or radians > MOVED_RAD)
