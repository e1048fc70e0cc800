"""Why episodes failed: sorted by a rule, from what was noted of them. A look at each may say otherwise.

What the hand ran into is not told by the rule: in most episodes that succeed it touches something too.
"""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.harness import Row

from lerobot_openspm.control.state import Status

# The first one that fits counts; what each means is said in the table, by `tables.SORTED`.
WORDS, PERCEPTION, REACH, GRASP, PLACING = KINDS = ("words", "perception", "reach", "grasp", "placing")
REFUSED = {
    Status.NOT_UNDERSTOOD: WORDS,
    Status.OBJECT_NOT_FOUND: PERCEPTION,
    Status.OBJECT_LOST: PERCEPTION,
    Status.CAMERA_FAULT: PERCEPTION,
    Status.INFEASIBLE: REACH,
}
# A pose that is farther off than this at the first look is taken to be the reason.
FAR_OFF_MM = 20.0


def failure_kind(episode: Row, off_mm: float | None = None) -> str:
    """What a failed episode failed by, of `KINDS`.

    Args:
        episode: As `evaluate` keeps it.
        off_mm: The largest error among the poses that it found at first; None where that is not known.
    """
    if (kind := REFUSED.get(episode["status"])) is not None:
        return kind
    if off_mm is not None and off_mm > FAR_OFF_MM:
        return PERCEPTION
    return GRASP if episode.get("gripped") is False else PLACING


class Grips:
    """Notes whether the hand kept hold of all that the present part of an instruction has it take hold of.

    A grasp held if the plan went on past the key pose after it. Fingers that close further than demonstrated
    send the plan back before that, unless it is followed open-loop.
    """

    def __init__(self) -> None:
        self._part = self._planned = self._held = 0

    def note(self, part: int, phases: Sequence[str], index: int) -> None:
        """Take in the present moment.

        Args:
            part: The part of the instruction that is carried out.
            phases: Of its key poses, in order.
            index: The one that is approached.
        """
        if part != self._part:
            self._part, self._held = part, 0
        self._planned = phases.count("grasp")
        self._held = max(self._held, phases[: max(index - 1, 0)].count("grasp"))

    def told(self) -> bool | None:
        """Whether every grasp held; None where nothing is to be taken hold of."""
        return self._held >= self._planned if self._planned else None


def counts(kinds: Sequence[str]) -> dict[str, int]:
    """How many episodes failed by each, none left out."""
    return {kind: kinds.count(kind) for kind in KINDS}
