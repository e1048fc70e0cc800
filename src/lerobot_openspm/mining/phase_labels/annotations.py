"""Sub-tasks that `lerobot-annotate` wrote into a dataset, as evidence for phases.

Its rows say from when on a sub-task in free words is being done: "pick up the bowl" from 0 s, "put the bowl
on the plate" from 1.5 s. Such a sub-task covers several phases. It is evidence for a phase's name where it
covers that phase and not the one that it may be mistaken for: picking up ends in no retreat, and putting down
in no lift.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lerobot_openspm.mining.phase_labels.merge import SIBLINGS
from lerobot_openspm.mining.phase_labels.types import Answers, PhaseAnswer, PhaseQuestion

# Stems of a sub-task's verb, what may follow them, and the phases that such a sub-task covers. The verbs are
# those that lerobot-annotate asks its model for, and the usual ones of finer labels.
_ENDING = "(?:|e|s|es|[a-z]?ing)"
VERBS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("let|lets|letting", " go", ("release",)),
    ("open", " (the |its )?(gripper|fingers|hand)", ("release",)),
    ("releas|drop|ungrasp", "", ("release",)),
    ("retreat|retract|withdraw|ris", "", ("retreat",)),
    ("mov|go|goes|back|return", " (away|back|off|home|to home|to the home)", ("retreat",)),
    ("mov|go|goes", " (down )?(to|toward|towards|above|over)", ("approach",)),
    ("approach|reach|hover", "", ("approach",)),
    ("pick|tak|grab|get|fetch", "", ("approach", "grasp", "lift")),
    ("clos", " (the |its )?(gripper|fingers|hand)", ("approach", "grasp")),
    ("grasp|grip|hold", "", ("approach", "grasp")),
    ("lift|rais", "", ("grasp", "lift")),
    ("carry|carries|transport|bring|transfer|mov", "", ("lift", "pre-place")),
    ("put|plac|set|lay|stack|insert|stand|lower", "", ("pre-place", "place", "release", "retreat")),
    ("push|press|nudg|sweep|slid", "", ("approach", "push", "retreat")),
    ("open|clos|pull|shut", "", ("approach", "grasp", "open", "push", "release", "retreat")),
    ("turn|rotat|twist|switch", "", ("approach", "grasp", "turn", "push", "release", "retreat")),
)
_PATTERNS = tuple((re.compile(rf"\b(?:{stems}){_ENDING}{after}\b"), phases) for stems, after, phases in VERBS)
# Of a sub-task that lasts all the way to a candidate. Its beginning is good to about half a second.
CONFIDENCE = 0.9


def phases_of(words: str) -> tuple[str, ...]:
    """The phases that a sub-task covers, by its first verb; none where it is not known.

    Of verbs that begin at the same letter the one with more words counts: to open the fingers is not to open.
    """
    found = [
        (match.start(), -len(match.group()), i)
        for i, (pattern, _) in enumerate(_PATTERNS)
        if (match := pattern.search(words.lower()))
    ]
    return _PATTERNS[min(found)[2]][1] if found else ()


@dataclass(frozen=True)
class AnnotationJudge:
    """Reads what the dataset says of itself.

    Attributes:
        rows: Gives an episode's sub-tasks by its index: the second at which each begins, and its words.
    """

    rows: Callable[[int], Sequence[tuple[float, str]]]
    name: str = "annotations"
    looks: bool = False

    def judge(self, question: PhaseQuestion) -> Answers:
        """See :class:`lerobot_openspm.mining.phase_labels.types.PhaseJudge`."""
        rows = self.rows(question.episode)
        times = [0.0, *(moment.time_s for moment in question.candidates)]
        return tuple(
            _answer(kinematic, *_covering(rows, begin, end))
            for kinematic, begin, end in zip(question.kinematic, times[:-1], times[1:], strict=True)
        )


def _covering(rows: Sequence[tuple[float, str]], begin: float, end: float) -> tuple[tuple[str, ...], float]:
    """The phases of the sub-task that takes most of the way between two times, and how much it takes."""
    ends = [*(later for later, _ in rows[1:]), float("inf")]
    shares = [
        (max(0.0, min(end, last) - max(begin, first)) / max(end - begin, 1e-9), phases_of(words))
        for (first, words), last in zip(rows, ends, strict=False)
    ]
    share, phases = max(shares, key=lambda found: found[0], default=(0.0, ()))
    return phases, min(share, 1.0)


def _answer(kinematic: str, covered: tuple[str, ...], share: float) -> PhaseAnswer | None:
    """What a sub-task says of a candidate; None where it covers both names in question, or neither."""
    names = [name for name in (kinematic, SIBLINGS.get(kinematic, kinematic)) if name in covered]
    names = list(dict.fromkeys(names))
    return PhaseAnswer(names[0], CONFIDENCE * share) if len(names) == 1 and share > 0 else None
