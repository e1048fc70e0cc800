"""Sub-tasks that `lerobot-annotate` wrote into a dataset, as evidence for phases.

Its rows say when a sub-task begins, in free words: "pick up the bowl" at 0 s, "put the bowl on the plate" at
1.5 s. Such a sub-task covers several phases. It is evidence for a phase's name where it covers that phase and
not the one that it may be mistaken for: picking up ends in no retreat, and putting down in no lift.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from lerobot_openspm.language.descriptions import phases_of
from lerobot_openspm.mining.phase_labels.base import PhaseJudge, PhaseLabel, PhaseLabels, PhaseQuestion
from lerobot_openspm.mining.phase_labels.merge import SIBLINGS

# Of a sub-task that covers the whole way to a candidate. Its beginning is exact to about half a second.
CONFIDENCE = 0.9


def annotation_judge(rows: Callable[[int], Sequence[tuple[float, str]]]) -> PhaseJudge:
    """Phase labels from the dataset's own annotations.

    Args:
        rows: Gives an episode's sub-tasks by its index: the second at which each begins, and its words.
    """

    def judge(question: PhaseQuestion) -> PhaseLabels:
        said = rows(question.episode)
        times = [0.0, *(moment.time_s for moment in question.candidates)]
        return tuple(
            _label(kinematic, *_covering(said, begin, end))
            for kinematic, begin, end in zip(question.kinematic, times[:-1], times[1:], strict=True)
        )

    return PhaseJudge("annotations", judge, looks=False)


def _covering(rows: Sequence[tuple[float, str]], begin: float, end: float) -> tuple[tuple[str, ...], float]:
    """The phases of the sub-task that overlaps most with an interval, and the fraction that it overlaps."""
    ends = [*(later for later, _ in rows[1:]), float("inf")]
    overlaps = [
        (max(0.0, min(end, last) - max(begin, first)) / max(end - begin, 1e-9), phases_of(words))
        for (first, words), last in zip(rows, ends, strict=False)
    ]
    overlap, phases = max(overlaps, key=lambda found: found[0], default=(0.0, ()))
    return phases, min(overlap, 1.0)


def _label(kinematic: str, covered: tuple[str, ...], overlap: float) -> PhaseLabel | None:
    """A sub-task's label of a candidate; None where it covers both names in question, or neither."""
    names = {kinematic, SIBLINGS.get(kinematic, kinematic)}.intersection(covered)
    return PhaseLabel(names.pop(), CONFIDENCE * overlap) if len(names) == 1 and overlap > 0 else None
