"""Made-up tasks of the structure of real ones, and ways in which somebody else would say them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lerobot_openspm.types import SubTask

_THINGS = (
    "bowl", "plate", "mug", "cup", "bottle", "box", "can", "jar", "pot", "pan", "lid", "tray", "basket",
    "book", "block", "cube", "ball", "spoon", "fork", "knife", "sponge", "brush", "towel", "carton",
    "pudding", "butter", "cheese", "ketchup", "soup", "ramekin", "kettle", "glass", "pitcher", "drill",
    "hammer", "screwdriver", "tape", "stapler", "marker", "phone", "banana", "apple", "lemon", "tomato",
    "onion", "carrot", "cabinet", "stove", "rack", "table", "shelf", "microwave", "sink", "drawer",
    "counter", "caddy", "desk", "oven",
)  # fmt: skip
_ATTRIBUTES = (
    "red", "blue", "green", "yellow", "white", "black", "small", "large", "wooden", "metal", "left",
    "right", "front", "back", "old", "new",
)  # fmt: skip
_PARTS = (
    "top drawer", "middle drawer", "bottom drawer", "left door", "right door", "front burner",
    "back burner", "top shelf",
)  # fmt: skip
_RELATIONS = ("on", "in", "next to", "behind", "under", "left of", "right of", "front of")
_PLACING, _OPERATING = ("put", "push"), ("open", "close", "turn on", "turn off")
# How often somebody else leaves out an attribute or a part, and says another relation.
_LEAVES_OUT, _OTHER_RELATION = 0.3, 0.2

Key = tuple[SubTask, ...]


def distinct_keys(count: int, rng: np.random.Generator) -> list[Key]:
    """So many different keys, of one or two sub-tasks, in about equal shares."""
    keys: dict[Key, None] = {}
    while len(keys) < count:
        missing = count - len(keys)
        first, second = _sub_tasks(missing, rng), _sub_tasks(missing, rng)
        double = rng.random(missing) < 0.5
        keys |= dict.fromkeys(
            (a, b) if both else (a,) for a, b, both in zip(first, second, double, strict=True)
        )
    return list(keys)


def said_otherwise(key: Key, rng: np.random.Generator) -> Key:
    """The key with attributes or parts left out and relations changed, each by chance."""
    return tuple(_said_otherwise(sub_task, rng) for sub_task in key)


def _said_otherwise(sub_task: SubTask, rng: np.random.Generator) -> SubTask:
    names = {
        field: " ".join(name.split()[1:])
        for field, name in (("target", sub_task.target), ("landmark", sub_task.landmark))
        if " " in name and rng.random() < _LEAVES_OUT
    }
    part = "" if rng.random() < _LEAVES_OUT else sub_task.part
    relation = sub_task.relation
    if relation and rng.random() < _OTHER_RELATION:
        relation = _RELATIONS[rng.integers(len(_RELATIONS))]
    return replace(sub_task, **names, part=part, relation=relation)


def _sub_tasks(count: int, rng: np.random.Generator) -> list[SubTask]:
    operations = rng.choice([*_PLACING, *_OPERATING], count)
    targets, landmarks = _names(count, rng), _names(count, rng)
    relations = rng.choice(_RELATIONS, count)
    parts = np.where(rng.random(count) < 0.3, rng.choice(_PARTS, count), "")
    return [
        SubTask(str(operation), target, str(part), str(relation), landmark)
        if operation in _PLACING
        else SubTask(str(operation), target, str(part))
        for operation, target, part, relation, landmark in zip(
            operations, targets, parts, relations, landmarks, strict=True
        )
    ]


def _names(count: int, rng: np.random.Generator) -> Sequence[str]:
    """Things with none, one or two different attributes."""
    things, attributes = rng.choice(_THINGS, count), rng.choice(_ATTRIBUTES, (count, 2))
    n = rng.integers(0, 3, count)
    return [" ".join([*dict.fromkeys(attributes[i, : n[i]].tolist()), str(things[i])]) for i in range(count)]
