"""Whether a reading is about known things of a kind to which that can be done."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from lerobot_openspm.memory import vocabulary as v
from lerobot_openspm.memory.entry import SubTask
from lerobot_openspm.memory.loose_words import THINGS
from lerobot_openspm.memory.names import canonical_name

# What is opened and closed, and what is switched.
OPENED = v.word_set("cabinet microwave")
SWITCHED = v.word_set("stove microwave")
# Operations that say all of what becomes of a thing.
MADE = ("open", "close", "turn on", "turn off")
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
