"""From an instruction to its task elements, by a small grammar and an alias table. No download."""

from __future__ import annotations

import re

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.memory.entry import SubTask

# Verb phrases, longest first within an operation, and the operation they mean.
_VERBS = {
    "put": ("pick up", "pick", "put", "place", "set down", "set", "lay", "move", "bring", "stack"),
    "open": ("open", "pull open", "pull out"),
    "close": ("close", "shut", "push in"),
    "push": ("push", "slide", "shove"),
    "turn on": ("turn on", "switch on", "light", "ignite"),
    "turn off": ("turn off", "switch off", "extinguish"),
}
# Prepositions and the relation they mean, longest first so that "on top of" is not read as "on".
_RELATIONS = {
    "to the front of": "front of", "in front of": "front of",
    "to the left of": "left of", "to the right of": "right of",
    "on top of": "on", "onto": "on", "on": "on",
    "inside of": "in", "inside": "in", "into": "in", "in": "in",
    "next to": "next to", "beside": "next to", "behind": "behind", "under": "under", "to": "at",
}  # fmt: skip
# Parts that are named without the object they belong to.
_PART_OF = {"drawer": "cabinet", "burner": "stove", "knob": "stove"}
_ARTICLES = r"^(?:the|a|an|some|it|this|that)\b\s*"
# A mug may be "yellow and white": an "and" begins a clause only where a verb follows.
_ANY_VERB = "|".join(sorted((v for verbs in _VERBS.values() for v in verbs), key=len, reverse=True))
_AND = rf"\band\b(?=\s+(?:{_ANY_VERB}|turn|switch)\b)"
_SPLIT = re.compile(rf"\s*(?:,\s*(?:and\s+)?(?:then\s+)?|\band then\b|\bthen\b|{_AND})\s*")
# Where something is picked up, beside the prepositions above.
_SOURCES = ("between", "from")


def parse_instruction(instruction: str) -> tuple[SubTask, ...]:
    """Read what is to be done, in order.

    "open the top drawer and put the bowl inside" gives two sub-tasks, the second with the cabinet of the
    first as its landmark. "pick up the bowl on the stove and put it on the plate" gives one: where a thing is
    picked up is not where it goes.

    Raises:
        InstructionError: No verb of the grammar begins the instruction, or the verb has no object.
    """
    clauses = [clause for clause in _SPLIT.split(_normalise(instruction)) if clause]
    sub_tasks: list[SubTask] = []
    picked_up = False
    for clause in clauses:
        sub_task = _parse_clause(clause, sub_tasks[-1] if sub_tasks else None, instruction)
        if picked_up and (sub_task.operation, sub_task.target) == ("put", sub_tasks[-1].target):
            sub_tasks.pop()
        sub_tasks.append(sub_task)
        picked_up = clause.startswith("pick")
    if not sub_tasks:
        raise InstructionError(
            f"got the instruction {instruction!r}, expected one like 'put the bowl on the plate'"
        )
    return tuple(sub_tasks)


def _parse_clause(clause: str, before: SubTask | None, instruction: str) -> SubTask:
    operation, rest = _split_verb(clause, instruction)
    rest = re.sub(r"^up\b\s*|\s*\bup$", "", rest)
    relation, landmark_words = "", ""
    if clause.startswith("pick"):
        rest = re.split(rf"\s*\b(?:{'|'.join([*_SOURCES, *_RELATIONS])})\b", rest)[0]
    elif operation in ("put", "push"):
        rest, relation, landmark_words = _split_relation(rest)
    target, part = _object_and_part(rest)
    if (
        not target and before is not None
    ):  # "put it on the plate"; but "close it" is said of what things are in
        inside = operation in ("open", "close") and before.relation == "in"
        target, part = (before.landmark if inside else before.target), before.part
    if not target:
        raise InstructionError(f"the instruction {instruction!r} names no object after {clause!r}")
    landmark, landmark_part = _object_and_part(landmark_words)
    if relation and not landmark and before is not None:
        landmark, landmark_part = before.target, before.part
    return SubTask(operation, target, part or landmark_part, relation, landmark)


def _split_verb(clause: str, instruction: str) -> tuple[str, str]:
    phrases = [(phrase, operation) for operation, verbs in _VERBS.items() for phrase in verbs]
    for phrase, operation in sorted(phrases, key=lambda item: -len(item[0])):
        if match := re.match(rf"{phrase}\b\s*", clause):
            return operation, clause[match.end() :]
    # "turn the stove on" splits the verb around its object.
    if match := re.match(r"(?:turn|switch)\s+(.*)\s+(on|off)$", clause):
        return f"turn {match[2]}", match[1]
    known = ", ".join(sorted(phrase for phrase, _ in phrases))
    raise InstructionError(f"the instruction {instruction!r} begins with no verb I know ({known})")


def _split_relation(words: str) -> tuple[str, str, str]:
    """Split "the bowl on top of the cabinet" into the target's words, the relation, the landmark's words."""
    for preposition in sorted(_RELATIONS, key=lambda item: -len(item)):
        if match := re.search(rf"\b{preposition}\b", words):
            return words[: match.start()], _RELATIONS[preposition], words[match.end() :]
    return words, "", ""


def _object_and_part(words: str) -> tuple[str, str]:
    """Split "the middle drawer of the cabinet" into object and part; a bare part gets its usual object."""
    words = words.strip()
    if " of " in words:
        part, whole = words.split(" of ", 1)
        return _strip_article(whole), _strip_article(part)
    name = _strip_article(words)
    if name and (whole := _PART_OF.get(name.split()[-1])):
        return whole, name
    return name, ""


def _strip_article(words: str) -> str:
    return re.sub(_ARTICLES, "", words.strip()).strip()


def _normalise(instruction: str) -> str:
    return re.sub(r"[^a-z0-9, ]+", " ", instruction.lower().replace("_", " ")).strip(" ,")
