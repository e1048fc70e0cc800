"""Whether a reading can be meant, and whether it has every word that tells its task from others."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import pairwise

from lerobot_openspm.language import vocabulary as v
from lerobot_openspm.language.loose_words import FORMS, THINGS
from lerobot_openspm.language.names import canonical_name
from lerobot_openspm.language.prepositions import Preposition, match_preposition
from lerobot_openspm.language.wording import plain_words
from lerobot_openspm.types import SubTask

# What is opened and closed, and what is switched.
OPENED = v.word_set("cabinet microwave")
SWITCHED = v.word_set("stove microwave")
# Operations that say all of what becomes of a thing.
MADE = ("open", "close", "turn on", "turn off")
# Verbs that say all of what is to be done where nothing says where to. Others that mean putting or pushing
# would be one with them: "move the box", "store the box", "pull the lever".
_SAY_ALL = (
    "pick up", "pick", "grab", "grasp", "grab hold of", "take hold of", "get hold of", "take", "lift",
    "lift up", "get", "fetch", "push", "press",
)  # fmt: skip
# Words that tell one task from another, which the grammar passes over or takes for a part of a name: how far,
# how often, which way. Those that add nothing to where a thing goes are no loss beside that.
_HOW = v.WAYS | v.word_set("halfway partway half more less further twice")
_BESIDE_GOALS = v.PARTICLES | v.word_set("along across around together")
_SIDES = v.word_set("left right back forward away over")
_ORDINALS = v.word_set("first second third fourth fifth sixth seventh eighth ninth tenth last")
# What moves along a way that "to the left" tells, where anything else is so told from others of its name.
_MOVED_ALONG = v.word_set("push open close")
Words = tuple[str, ...]
_PARTS = {*v.PART_OF, *v.NAMED_PARTS, *v.PLACES, *v.PART_SYNONYMS}
_POSITIONS = {*v.PLACES, *v.HEIGHTS}


def makes_sense(sub_tasks: Sequence[SubTask], things: Collection[str] = THINGS) -> bool:
    """Whether sub-tasks are about known things, of a kind to which that can be done."""
    known = {canonical_name(name) for name in things}
    names = [name for s in sub_tasks for name in (*s.objects, *_landmarks(s))]
    said_twice = any(
        one != other and is_said_again(one, other)
        for i, one in enumerate(sub_tasks)
        for other in sub_tasks[i + 1 :]
    )
    return not said_twice and all(_is_known(name, known) for name in names) and all(map(_can_be, sub_tasks))


def _landmarks(sub_task: SubTask) -> list[str]:
    wheres = (sub_task.target_where, sub_task.landmark_where)
    return [name for where in wheres if where for name in where.landmarks]


def is_said_again(one: SubTask, other: SubTask) -> bool:
    """Whether a step says no more than one before it: "beside it" after "to the right of it"."""
    if one == other:
        return True
    if one.operation in MADE:
        return replace(one, target_where=None) == other
    names = set(one.target.split()), set(other.target.split())
    vaguer = other.relation in ("at", "next to", one.relation)
    return (
        {one.operation, other.operation} <= {"put", "push"}
        and (one.landmark, one.part) == (other.landmark, other.part)
        and vaguer
        and (names[0] <= names[1] or names[1] <= names[0])
        and (other.target_where is None or one.target_where is None or one.target_where == other.target_where)
        and not (one.landmark_where and other.landmark_where and one.landmark_where != other.landmark_where)
    )


def _is_known(name: str, known: Collection[str]) -> bool:
    words = [word for word in canonical_name(name).split() if word not in v.COLOURS and word != "and"]
    return canonical_name(" ".join(words)) in known or canonical_name(name) in known


def _can_be(sub_task: SubTask) -> bool:
    target, part = canonical_name(sub_task.target), sub_task.part.split()
    if part and (part[-1] not in _PARTS or not set(part[:-1]) <= _POSITIONS):
        return False
    owner = canonical_name(sub_task.landmark or sub_task.target)
    if part and v.PART_OF.get(v.PART_SYNONYMS.get(part[-1], part[-1]), owner) != owner:
        return False
    if sub_task.operation in MADE and sub_task.target_where and sub_task.target_where.landmarks:
        return False  # "the drawer on the cabinet" is a part of it
    if sub_task.operation in ("put", "push"):
        is_other = target != canonical_name(sub_task.landmark) or target.endswith("bowl")  # one on another
        return bool(sub_task.landmark) and is_other
    may_be = SWITCHED if sub_task.operation.startswith("turn") else OPENED
    return target in may_be and (target != "cabinet" or bool(sub_task.part))


def says_all(sub_tasks: Sequence[SubTask], instruction: str) -> bool:
    """Whether a reading has every word of an instruction that tells its task from others.

    "Push the lever up" says more than a push of the lever, and "the second mug" is not any mug. A thing that
    is only taken or pushed is so by a verb that says nothing more.

    Args:
        sub_tasks: What the grammar read.
        instruction: What was said.
    """
    words = tuple(plain_words(instruction).split())
    goes = any(sub_task.landmark for sub_task in sub_tasks)
    if not goes and len(sub_tasks) == 1 and sub_tasks[0].operation in ("put", "push"):
        verb = v.match_verb(words, 0)
        if verb is None or " ".join(words[: verb.length]) not in _SAY_ALL:
            return False
    names = {word for s in sub_tasks for name in (*s.objects, *_landmarks(s)) for word in name.split()}
    moves = {sub_task.operation for sub_task in sub_tasks if not sub_task.landmark}
    is_read = not names & (_HOW | {"with", "using", "it", "them"})
    return is_read and all(_says_all_of(piece, names, moves, goes) for piece in _pieces(words))


def _pieces(words: Words) -> list[Words]:
    """Words between commas, "and" and "then"."""
    ends = [i for i, word in enumerate(words) if word in (",", ";", "and", "then")]
    return [words[i + 1 : j] for i, j in pairwise([-1, *ends, len(words)])]


def _says_all_of(words: Words, names: Collection[str], moves: set[str], goes: bool) -> bool:
    """Whether no telling word of a piece is left over by verbs, names and prepositions of a reading.

    Args:
        words: The piece's.
        names: Those of the names that were read.
        moves: Operations of sub-tasks without a landmark.
        goes: Whether anything has a landmark.
    """
    i, left = 0, set[str]()
    has_goal = False
    while i < len(words):
        verb = next((one for form in FORMS if (one := v.match_verb(words, i, form))), None)
        found = match_preposition(words, i)
        if verb is not None and verb.length > 1:
            i += verb.length
        elif found is not None and not (words[i] in ("off", "out") and moves & set(MADE)):
            if not _has(found, words, i, moves, goes):
                return False
            has_goal |= not (found.place or found.is_source)
            i += found.length
        else:
            left |= {words[i]} if _tells(words, i, moves) and words[i] not in names else set()
            i += 1
    return not (left - _BESIDE_GOALS if has_goal else left)


def _has(found: Preposition, words: Words, i: int, moves: set[str], goes: bool) -> bool:
    """Whether a reading has what a preposition says: where something goes, or which thing is meant."""
    if found.place:
        return words[i] not in v.GOALS or not _MOVED_ALONG & moves
    after = i + found.length
    if found.is_source:
        return "push" not in moves and after < len(words)
    is_infinitive = words[after : after + 1] == ("be",) or v.match_verb(words, after) is not None
    return goes or not found.is_goal or is_infinitive


def _tells(words: Words, i: int, moves: set[str]) -> bool:
    """Whether a word tells which, how far or which way; "left" does not before a noun, "first" not alone."""
    word, before, after = words[i], words[i - 1] if i else "", words[i + 1] if i + 1 < len(words) else ""
    if f"{words[0]} {word}" in _SAY_ALL:
        return False  # "lift the box up"
    has_noun = bool(after) and match_preposition(words, i + 1) is None
    if word in _SIDES:
        return not has_noun and before not in ("'s", "furthest", "farthest")
    if word in _ORDINALS:
        return has_noun and after not in v.DETERMINERS and v.match_verb(words, i + 1) is None
    if word in ("off", "out"):
        return not moves & set(MADE)  # "turn the stove off"
    if word == "a":
        return not has_noun or before in v.DETERMINERS
    if word in ("little", "bit", "slightly", "once"):
        return not after
    return word in _HOW or (len(word) == 1 and word.isalpha() and word != "i")
