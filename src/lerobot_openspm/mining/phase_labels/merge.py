"""Merging what a judge says with what motion and gripper say.

Two pieces of evidence for the name of a phase: from motion and gripper with confidence ``g``, from the judge
with confidence ``m``. They are independent of each other, so their odds are pooled, as in naive Bayes. The
judge's odds are ``J = max(1, m / (1 - m))``: a judge that is not sure of what it says does not speak for the
opposite.

    the two agree                            g' = g J / (g J + (1 - g))
    they differ, and the name is kept        g' = g / (g + (1 - g) J)
    they differ, and the judge's is taken    g' = m / (m + (1 - m) G),  G = max(1, g / (1 - g))

The more confident one's name is taken. Where both are equally sure, g' is 1/2 whichever is taken, so nothing
jumps. ``g = 1``, which is what the gripper's transitions have, stays 1: nothing overrules them.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

from lerobot_openspm.errors import JudgementError
from lerobot_openspm.mining.phase_labels.structure import FIRST, LAST, SUCCESSORS
from lerobot_openspm.mining.phase_labels.types import Answers, PhaseAnswer

# What a model says of its own confidence is too high more often than too low: it counts for no more.
MAX_JUDGED = 0.95
# The names that a judge may change, and to which: whether something is in the hand is the gripper's to say,
# and at a contact it is the contact that gives the name.
SIBLINGS = {"approach": "retreat", "retreat": "approach", "lift": "pre-place", "pre-place": "lift"}


def merge(kinematic: Sequence[PhaseAnswer], judged: Answers, threshold: float) -> tuple[PhaseAnswer, ...]:
    """Merge a judge's evidence for the phases of an episode with that of motion and gripper.

    Args:
        kinematic: What motion and gripper say of each candidate.
        judged: What the judge says of each, or None.
        threshold: Answers of less confidence change nothing.

    Returns:
        Name and confidence of each. Which name comes after which is as followable as it was in `kinematic`.

    Raises:
        JudgementError: There is not one answer for each candidate.
    """
    if len(kinematic) != len(judged):
        raise JudgementError(f"got {len(judged)} answers for {len(kinematic)} candidates, expected as many")
    heard = [_heard(answer, threshold) for answer in judged]
    names = _names(kinematic, heard)
    return tuple(_pooled(*evidence) for evidence in zip(kinematic, heard, names, strict=True))


def _heard(answer: PhaseAnswer | None, threshold: float) -> PhaseAnswer | None:
    """The label, if its confidence passes the threshold."""
    if answer is None or answer.confidence < threshold:
        return None
    return PhaseAnswer(answer.phase, min(answer.confidence, MAX_JUDGED))


def _pooled(kinematic: PhaseAnswer, judged: PhaseAnswer | None, name: str) -> PhaseAnswer:
    """The formula above, for the name that was chosen."""
    if judged is None:
        return kinematic
    g, m = kinematic.confidence, judged.confidence
    if name != kinematic.phase:
        return PhaseAnswer(name, m / (m + (1 - m) * max(1.0, g / (1 - g))))
    odds = max(1.0, m / (1 - m))
    if odds == 1:  # not even the last digit changes
        return kinematic
    if judged.phase == kinematic.phase:
        # 1 - g first: rounding must not lift the quotient above 1.
        return PhaseAnswer(name, g * odds / (g * odds + (1 - g)))
    return PhaseAnswer(name, g / (g + (1 - g) * odds))


def _names(kinematic: Sequence[PhaseAnswer], judged: Sequence[PhaseAnswer | None]) -> list[str]:
    """The names that together are likeliest, of those that make a followable sequence.

    Each candidate keeps its name or takes the judge's; what the judge's is worth more in log-odds is what
    taking it gains. The best sequence is found from the front, one candidate at a time.
    """
    before: dict[str, tuple[float, list[str]]] = {}
    for i, (kept, answer) in enumerate(zip(kinematic, judged, strict=True)):
        now: dict[str, tuple[float, list[str]]] = {}
        for name, gain in _options(kept, answer).items():
            ways = [
                (total + gain, [*names, name])
                for last, (total, names) in before.items()
                if name in SUCCESSORS[last] or (last, name) == (kinematic[i - 1].phase, kept.phase)
            ]
            if i == 0 and name in (*FIRST, kept.phase):
                ways = [(gain, [name])]
            if ways:
                now[name] = max(ways, key=lambda way: way[0])
        before = now
    ends = [way for last, way in before.items() if last in (*LAST, kinematic[-1].phase)]
    return max(ends, key=lambda way: way[0], default=(0.0, list[str]()))[1]


def _options(kinematic: PhaseAnswer, judged: PhaseAnswer | None) -> dict[str, float]:
    """The names a candidate may take, with what taking them gains; its own comes first, and wins a tie."""
    options = {kinematic.phase: 0.0}
    if judged and judged.confidence > kinematic.confidence and SIBLINGS.get(kinematic.phase) == judged.phase:
        options[judged.phase] = _log_odds(judged.confidence) - _log_odds(kinematic.confidence)
    return options


def _log_odds(confidence: float) -> float:
    bounded = max(confidence, sys.float_info.min)
    return math.log(bounded / (1 - bounded))
