"""Sub-tasks and phases in words: how they are said, and which phases "pick up the bowl" covers."""

from __future__ import annotations

import re
from dataclasses import replace

from lerobot_openspm.types import Reference, SubTask

# Relations that are not the preposition that one says.
_PREPOSITIONS = {
    "front of": "to the front of", "left of": "to the left of", "right of": "to the right of", "at": "to",
    "front": "in front of", "back": "behind", "left": "to the left of", "right": "to the right of",
    "center": "in the center of",
}  # fmt: skip
_VERBS = {"pick": "pick up"}
# What the hand does in a phase; those in `_GOING` say where to as well.
_PHASE_VERBS = {
    "approach": "approach", "grasp": "grasp", "lift": "lift", "pre-place": "carry", "place": "place",
    "release": "release", "retreat": "retreat from", "push": "push", "open": "pull", "turn": "turn",
}  # fmt: skip
_GOING = ("place", "push")
# Stems of a sub-task's verb, what may follow them, and the phases that such a sub-task covers. The verbs are
# those that lerobot-annotate asks its model for, and the usual ones of finer labels.
_ENDING = "(?:|e|s|es|[a-z]?ing)"
_STEMS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
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
    (re.compile(rf"\b(?:{stems}){_ENDING}{after}\b"), phases) for stems, after, phases in _STEMS
)


def phrase(sub_task: SubTask) -> str:
    """A sub-task in words, as an instruction: "put the bowl in the top drawer of the cabinet"."""
    if sub_task.words:
        return sub_task.words
    verb = _VERBS.get(sub_task.operation, sub_task.operation)
    if not sub_task.landmark:
        return f"{verb} {noun_phrase(sub_task.target, sub_task.part, sub_task.target_where)}"
    preposition = _PREPOSITIONS.get(sub_task.relation, sub_task.relation)
    target = noun_phrase(sub_task.target, "", sub_task.target_where)
    landmark = noun_phrase(sub_task.landmark, sub_task.part, sub_task.landmark_where)
    return f"{verb} {target} {preposition} {landmark}"


def noun_phrase(name: str, part: str = "", where: Reference | None = None) -> str:
    """An object, or a part of it, in words: "the bowl next to the ramekin", "the left plate"."""
    told = f"the {name}"
    if where is not None and not where.landmarks:
        told = f"the {where.relation} {name}"
    elif where is not None:
        preposition = _PREPOSITIONS.get(where.relation, where.relation)
        told = f"the {name} {preposition} {' and '.join(f'the {landmark}' for landmark in where.landmarks)}"
    return f"the {part} of {told}" if part else told


def phase_phrase(phase: str, sub_task: SubTask) -> str:
    """What is done in a phase of a sub-task: "grasp the bowl", "place the bowl on the plate"."""
    is_going = phase in _GOING and sub_task.relation
    said = replace(sub_task, operation=_PHASE_VERBS[phase], words="")
    if not is_going:
        part = "" if sub_task.landmark else sub_task.part
        said = replace(said, part=part, relation="", landmark="", landmark_where=None)
    return phrase(said)


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
