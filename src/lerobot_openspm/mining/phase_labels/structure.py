"""Which phase can follow which, so that no judge makes a sequence that no hand can follow."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from lerobot_openspm.errors import JudgementError

# The phases that may come next. A hand that holds nothing approaches and retreats; one that holds something
# lifts it, carries it on and puts it down; grasp and release lie between the two.
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
# What a hand does with closed fingers around something.
HOLDING = ("grasp", "lift", "pre-place", "place", "open", "turn")


def check_sequence(phases: Sequence[str]) -> None:
    """Raise JudgementError on phases that no hand can follow, such as a release before a grasp."""
    if not phases:
        raise JudgementError("there are no phases, expected a sequence that begins with approach")
    if phases[0] not in FIRST:
        raise JudgementError(f"the first phase is {phases[0]!r}, expected {' or '.join(FIRST)}")
    for i, (before, after) in enumerate(pairwise(phases), start=2):
        if after not in SUCCESSORS[before]:
            raise JudgementError(
                f"phase {i} is {after!r} after {before!r}, expected {' or '.join(SUCCESSORS[before])}"
            )
    if phases[-1] not in LAST:
        raise JudgementError(f"the last phase is {phases[-1]!r}, expected {' or '.join(LAST)}")
