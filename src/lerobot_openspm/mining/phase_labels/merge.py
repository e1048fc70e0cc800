"""Merging a judge's phase labels with those of motion and gripper.

There are two pieces of evidence for the name of a phase: motion and gripper with confidence ``g``, the judge
with confidence ``m``. They are independent, so their odds are pooled, as in naive Bayes. The judge's odds are
``J = max(1, m / (1 - m))``: a judge that is unsure is no evidence for the opposite.

    both agree                               g' = g J / (g J + (1 - g))
    they differ, and the name is kept        g' = g / (g + (1 - g) J)
    they differ, and the judge's is taken    g' = m / (m + (1 - m) G),  G = max(1, g / (1 - g))

The more confident one's name is taken. Where both are equally sure, g' is 1/2 for either name, so nothing
jumps. ``g = 1``, which is what the gripper's transitions have, stays 1: nothing overrules them.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.mining.phase_labels.base import PhaseLabel, PhaseLabels

# Models overstate their confidence more often than not, so it is capped.
MAX_CONFIDENCE = 0.95
# The names that a judge may change, and to which. The gripper decides whether something is held, and at a
# contact the contact gives the name.
SIBLINGS = {"approach": "retreat", "retreat": "approach", "lift": "pre-place", "pre-place": "lift"}
# The phases that may come next. An empty hand approaches and retreats; a hand that holds something lifts it,
# carries it on and puts it down; grasp and release lie between the two.
SUCCESSORS: dict[str, tuple[str, ...]] = {
    "approach": ("approach", "grasp", "push"),
    "grasp": ("lift", "pre-place", "place", "open", "turn"),
    "lift": ("lift", "pre-place", "place"),
    "pre-place": ("pre-place", "place"),
    "place": ("release",),
    "open": ("release",),
    "turn": ("release",),
    "release": ("retreat", "approach"),
    "push": ("push", "retreat"),
    "retreat": ("retreat", "approach"),
}
FIRST = ("approach",)
LAST = ("retreat", "release", "push")


def merge(kinematic: Sequence[PhaseLabel], judged: PhaseLabels, threshold: float) -> tuple[PhaseLabel, ...]:
    """Merge a judge's labels for the phases of an episode with those of motion and gripper.

    Args:
        kinematic: Each candidate's label by motion and gripper.
        judged: The judge's label of each, or None.
        threshold: Labels of less confidence change nothing.

    Returns:
        Name and confidence of each. The sequence of names is as feasible as it was in `kinematic`.

    Raises:
        PhaseLabelError: There is not one label per candidate.
    """
    if len(kinematic) != len(judged):
        raise PhaseLabelError(f"got {len(judged)} labels for {len(kinematic)} candidates, expected as many")
    heard = [_heard(label, threshold) for label in judged]
    names = _names(kinematic, heard)
    return tuple(_pooled(*evidence) for evidence in zip(kinematic, heard, names, strict=True))


def _heard(label: PhaseLabel | None, threshold: float) -> PhaseLabel | None:
    """The label, if its confidence passes the threshold."""
    if label is None or label.confidence < threshold:
        return None
    return PhaseLabel(label.phase, min(label.confidence, MAX_CONFIDENCE))


def _pooled(kinematic: PhaseLabel, judged: PhaseLabel | None, name: str) -> PhaseLabel:
    """The formula above, for the name that was chosen."""
    if judged is None:
        return kinematic
    g, m = kinematic.confidence, judged.confidence
    if name != kinematic.phase:
        return PhaseLabel(name, m / (m + (1 - m) * max(1.0, g / (1 - g))))
    odds = max(1.0, m / (1 - m))
    if odds == 1:  # not even the last digit changes
        return kinematic
    if judged.phase == kinematic.phase:
        # 1 - g first: rounding must not lift the quotient above 1.
        return PhaseLabel(name, g * odds / (g * odds + (1 - g)))
    return PhaseLabel(name, g / (g + (1 - g) * odds))


def _names(kinematic: Sequence[PhaseLabel], judged: Sequence[PhaseLabel | None]) -> list[str]:
    """The likeliest feasible sequence of names, by dynamic programming over the candidates.

    Each candidate keeps its name or takes the judge's, which gains the difference of their log-odds.
    """
    before: dict[str, tuple[float, list[str]]] = {}
    for i, (kept, label) in enumerate(zip(kinematic, judged, strict=True)):
        now: dict[str, tuple[float, list[str]]] = {}
        for name, gain in _options(kept, label).items():
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


def _options(kinematic: PhaseLabel, judged: PhaseLabel | None) -> dict[str, float]:
    """The names a candidate may take, with the gain of each; its own comes first and wins a tie."""
    options = {kinematic.phase: 0.0}
    if judged and judged.confidence > kinematic.confidence and SIBLINGS.get(kinematic.phase) == judged.phase:
        options[judged.phase] = _log_odds(judged.confidence) - _log_odds(kinematic.confidence)
    return options


def _log_odds(confidence: float) -> float:
    bounded = max(confidence, sys.float_info.min)
    return math.log(bounded / (1 - bounded))
