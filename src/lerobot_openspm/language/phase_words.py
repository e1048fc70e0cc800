"""The phases of a motion in words: which of them "pick up the bowl" covers."""

from __future__ import annotations

import re

# Stems of a sub-task's verb, what may follow them, and the phases that such a sub-task covers. The verbs are
# those that lerobot-annotate asks its model for, and the usual ones of finer labels.
_ENDING = "(?:|e|s|es|[a-z]?ing)"
_VERBS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
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
_PATTERNS = tuple(
    (re.compile(rf"\b(?:{stems}){_ENDING}{after}\b"), phases) for stems, after, phases in _VERBS
)


def phases_of(words: str) -> tuple[str, ...]:
    """The phases that a sub-task covers, by its first verb; none for an unknown verb.

    Of verbs that begin at the same letter the longer match counts: "open the fingers" is not "open".
    """
    found = [
        (match.start(), -len(match.group()), i)
        for i, (pattern, _) in enumerate(_PATTERNS)
        if (match := pattern.search(words.lower()))
    ]
    return _PATTERNS[min(found)[2]][1] if found else ()
