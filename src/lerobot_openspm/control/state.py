"""What an episode is doing: one record, and one table of which status can follow which."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from lerobot_openspm.control.plan import NO_PLAN, Plan
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.compose import Candidate
from lerobot_openspm.memory.entry import MemoryEntry, Outcome
from lerobot_openspm.memory.retrieval import Scored

if TYPE_CHECKING:
    from lerobot_openspm.control.planning import PlanningContext

# After the last key pose the policy looks up to three times at what it moved. Then the outcome stays unknown.
LOOKS_AT_OUTCOME = 3


class Status(StrEnum):
    """Status of one episode. Only the world causes these; bad input raises."""

    WAITING = "waiting"  # no plan yet, for the instruction or for its next part
    RUNNING = "running"
    PAUSED = "paused"  # holds still until an object or a camera's picture is back
    DONE = "done"  # every key pose was reached; the hand holds still
    OBJECT_NOT_FOUND = "object_not_found"
    INFEASIBLE = "infeasible"  # no entry passes the transfer checks here
    NO_PROGRESS = "no_progress"  # attempts are used up
    OBJECT_LOST = "object_lost"  # what is needed now was seen before and is gone; looked for until it is back
    NOT_UNDERSTOOD = "not_understood"  # nothing in the memory is about the instruction
    CAMERA_FAULT = "camera_fault"  # no sound picture of a camera for too long, or views that disagree


_PLANNING = {Status.RUNNING, Status.OBJECT_NOT_FOUND, Status.INFEASIBLE}
_GIVING_UP = {Status.NOT_UNDERSTOOD, Status.CAMERA_FAULT}

# What can follow each status. The last three end the episode.
TRANSITIONS: dict[Status, frozenset[Status]] = {
    Status.WAITING: frozenset(_PLANNING | _GIVING_UP),
    Status.OBJECT_NOT_FOUND: frozenset(_PLANNING | _GIVING_UP),
    Status.INFEASIBLE: frozenset(_PLANNING | _GIVING_UP),
    Status.RUNNING: frozenset(
        {Status.PAUSED, Status.OBJECT_LOST, Status.DONE, Status.NO_PROGRESS} | _GIVING_UP
    ),
    Status.PAUSED: frozenset({Status.RUNNING, Status.OBJECT_LOST, Status.NO_PROGRESS} | _GIVING_UP),
    Status.OBJECT_LOST: frozenset({Status.RUNNING, Status.NO_PROGRESS} | _GIVING_UP),
    # From the end it goes on with the next part, or back to a sub-task whose outcome is not met.
    Status.DONE: frozenset({Status.WAITING, Status.RUNNING, Status.NO_PROGRESS, Status.NOT_UNDERSTOOD}),
    Status.NO_PROGRESS: frozenset(),
    Status.NOT_UNDERSTOOD: frozenset(),
    Status.CAMERA_FAULT: frozenset(),
}


def _without_outcomes(plan: Plan, names: Collection[str]) -> Plan:
    """A plan without the outcomes that are about some objects."""
    kept = tuple(one for one in plan.entry.outcomes if not set(names).intersection(one.objects))
    return replace(plan, entry=replace(plan.entry, outcomes=kept))


@dataclass
class EpisodeState:
    """What is being done in one episode. The controller and its executor change it, and keep no copies.

    Where the objects are is not said here: :class:`SceneState` knows that.

    Attributes:
        status: What the episode is up to; changed by :meth:`go` alone.
        refusal: Why the instruction is not acted on, with the object or the camera that it is about; ""
            unless the status is OBJECT_NOT_FOUND, OBJECT_LOST, INFEASIBLE, NO_PROGRESS, NOT_UNDERSTOOD or
            CAMERA_FAULT.
        parts: For each part of the instruction, in order, what it can be carried out by; none before the
            first look.
        part: The part that is carried out now, counted from 0.
        T_start: Where the hand was when the instruction was read, ``T_world_ee`` ``(4, 4)``.
        ranked: The entries of the last retrieval with their scores, best first.
        plan: What is acted by, and where.
        refused: The plan that was last found to be infeasible.
        used: For each part that was begun, the entries of the memory that it was carried out by: one, or two
            that were put together.
        ended: The plan of each part that was ended.
        verdicts: For each part that was ended, whether it is seen to be done; None where that is not known.
        spent: For each part that was ended, attempts beyond the first, and when it ended, seconds since the
            episode began.
        index: The key pose that is approached.
        replans: Chunks asked for so far; seeds the noise of each.
        attempts: Attempts beyond the first at the present part.
        looks_left: How often the end of the present part may still be looked at.
        verdict: Whether the present part is seen to be done; None where that is not known.
        gone: How far drawers and knobs of the present part have moved, by sub-task, metres or radians.
        followed: Sub-tasks of the present part whose drawer or knob went all the way.
    """

    status: Status = Status.WAITING
    refusal: str = ""
    parts: tuple[tuple[Candidate, ...], ...] = ()
    part: int = 0
    T_start: Array = field(default_factory=lambda: np.eye(4))
    ranked: tuple[Scored, ...] = ()
    plan: Plan = NO_PLAN
    refused: Plan = NO_PLAN
    used: tuple[tuple[MemoryEntry, ...], ...] = ()
    ended: tuple[Plan, ...] = ()
    verdicts: tuple[bool | None, ...] = ()
    spent: tuple[tuple[int, float], ...] = ()
    index: int = 0
    replans: int = 0
    attempts: int = 0
    looks_left: int = LOOKS_AT_OUTCOME
    verdict: bool | None = None
    gone: dict[int, float] = field(default_factory=dict[int, float])
    followed: set[int] = field(default_factory=set[int])

    def __deepcopy__(self, memo: dict[int, object]) -> EpisodeState:
        """A copy that goes on by itself. Entries and plans never change, so both share them."""
        return replace(self, gone=dict(self.gone), followed=set(self.followed))

    def go(self, status: Status) -> None:
        """Change the status.

        Raises:
            RuntimeError: It cannot follow the present one.
        """
        if status is not self.status and status not in TRANSITIONS[self.status]:
            raise RuntimeError(f"an episode cannot go from {self.status} to {status}")
        self.status = status

    @property
    def is_last_part(self) -> bool:
        """Whether nothing is left to do after the present part."""
        return self.part + 1 >= len(self.parts)

    @property
    def looked_at(self) -> list[str]:
        """The objects that are looked at at the end of a part: of what it did, at the last one of all."""
        outcomes = [one for plan in (self.plan, *self._left) for one in plan.entry.served_outcomes]
        return list(dict.fromkeys(name for one in outcomes for name in one.objects))

    @property
    def _left(self) -> list[Plan]:
        """At the last part, the plans of those before, with the outcomes that no later one was to change.

        What is done once more changes nothing but its own: what was put upon it has to be there again.
        """
        left, plans = list[Plan](), (*self.ended, self.plan)
        for i, plan in enumerate(self.ended if self.is_last_part else ()):
            later = [
                plans[j]
                for j in range(i + 1, len(plans))
                if self.parts[j] is self.parts[i] or not self._is_done_once_more(j)
            ]
            moved = {sub_task.target for other in later for sub_task in other.entry.key.sub_tasks}
            left.append(_without_outcomes(plan, moved))
        return left

    def _is_done_once_more(self, part: int) -> bool:
        return any(self.parts[part] is one for one in self.parts[:part])

    @property
    def succeeded(self) -> bool | None:
        """Whether the instruction is seen to be done; None before the end and where it is not seen."""
        if self.status is Status.NO_PROGRESS or (self.status is Status.DONE and False in self.verdicts):
            return False
        is_known = self.status is Status.DONE and all(verdict is True for verdict in self.verdicts)
        return self.verdict if is_known else None

    def entry_successes(self, success: bool) -> list[tuple[MemoryEntry, bool]]:
        """The entries that were acted by, each once with whether it succeeded, given whether the episode did.

        A failure does not count for the parts that were seen to be done, but for all others that were begun.
        Where every part was seen to be done, one of these looks was wrong, and the failure counts for all.
        """
        seen = list(zip(self.used, (*self.verdicts, self.verdict), strict=False))
        is_denied = len(seen) == len(self.parts) and all(verdict is True for _, verdict in seen)
        fared: dict[int, tuple[MemoryEntry, bool]] = {}
        for entry, verdict in ((entry, verdict) for entries, verdict in seen for entry in entries):
            _, before = fared.get(id(entry), (entry, True))
            fared[id(entry)] = entry, before and (success or (verdict is True and not is_denied))
        return list(fared.values())

    def begin_next_part(self, time_s: float) -> None:
        """Turn to the next part, which has attempts and looks of its own, so long after the episode began."""
        self.ended, self.verdicts = (*self.ended, self.plan), (*self.verdicts, self.verdict)
        self.spent = (*self.spent, (self.attempts, time_s))
        self.part += 1
        self.attempts, self.looks_left, self.verdict = 0, LOOKS_AT_OUTCOME, None
        self.gone, self.followed = {}, set()

    def rename(self, others: Collection[str]) -> None:
        """Names mean other objects from now on: of these nobody can tell any more where parts left them."""
        self.ended = tuple(_without_outcomes(plan, others) for plan in self.ended)

    def judge(self, missed: Sequence[Outcome]) -> None:
        """Take in which outcomes are missed. The others, and handles that went all the way, are done."""
        done = {one.sub_task for one in self.plan.entry.served_outcomes} | self.followed
        is_all_known = done >= set(range(len(self.plan.entry.key.sub_tasks)))
        self.verdict = False if missed else (is_all_known or None)

    def is_unsure(
        self, poses: Mapping[str, Array], recognised: Collection[str], context: PlanningContext
    ) -> bool:
        """Whether a look did not tell if all is as it should be; arguments as of :meth:`take_up_again`."""
        return any(plan.missed(poses, recognised, context) is None for plan in (self.plan, *self._left))

    def take_up_again(
        self, poses: Mapping[str, Array], recognised: Collection[str], context: PlanningContext
    ) -> None:
        """At the end of the last part, do one once more of which something is not where it was put any more.

        A part that was done once more already has failed then.

        Args:
            poses: Where the objects are, ``T_world_obj`` ``(4, 4)`` by name.
            recognised: Those that the last look recognised.
            context: What is known of them.
        """
        for i, plan in enumerate(self._left):
            if not plan.missed(poses, recognised, context):
                continue
            if sum(part is self.parts[i] for part in self.parts) == 1:
                self.parts, self.looks_left = (*self.parts, self.parts[i]), LOOKS_AT_OUTCOME
                return
            self.verdicts = (*self.verdicts[:i], False, *self.verdicts[i + 1 :])
