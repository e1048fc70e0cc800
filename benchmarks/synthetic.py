"""Made-up tasks of the structure of real ones, as told and as told otherwise, and large memories of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.memory.entry import Anchor, MemoryEntry, MemoryKeyPose, RetrievalKey
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.robot import RobotModel
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


# What picking and placing is made of, and whether the hand is closed on the way.
_PHASES = (
    ("approach", False), ("approach", False), ("grasp", True), ("lift", True),
    ("pre-place", True), ("place", True), ("release", False), ("retreat", False),
)  # fmt: skip
# Demonstrations of each task.
_PER_KEY = 100


def synthetic_memory(count: int, rng: np.random.Generator) -> Memory:
    """So many entries, a hundred of each task, with eight key poses and a layout of two objects each."""
    keys = distinct_keys(-(-count // _PER_KEY), rng)
    poses = _transforms(count * len(_PHASES), rng).reshape(count, len(_PHASES), 4, 4)
    layouts = _transforms(count * 2, rng).reshape(count, 2, 4, 4)
    qualities = rng.random(count)
    entries = tuple(
        _entry(keys[i // _PER_KEY], poses[i], layouts[i], float(qualities[i]), i) for i in range(count)
    )
    workspace = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.5]])
    robot = RobotModel(1.0, -1.0, 0.08, 0.01, 0.1, 0.01, workspace)
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, "world", np.eye(4))
    return Memory(entries, {}, robot, {"observation.images.front": camera}, "demonstrations")


def _transforms(count: int, rng: np.random.Generator) -> se3.Array:
    rotations = Rotation.random(count, rng=rng).as_matrix()
    return se3.transform(rotations, rng.uniform(-0.5, 0.5, (count, 3)))


def _entry(key: Key, poses: Sequence[se3.Array], layout: se3.Array, quality: float, i: int) -> MemoryEntry:
    # Two names, so that every entry has two objects whatever its task names.
    target, landmark = key[0].target, f"{key[0].landmark or 'table'} below"
    key_poses = tuple(
        MemoryKeyPose(
            anchor=Anchor(*[target if j < 4 else landmark] * 2),
            T_obj_ee=poses[j],
            phase=phase,
            confidence=1.0,
            closed=closed,
            opening=0.03 if closed else 0.08,
            n_steps=10,
            dwell=phase in ("grasp", "release"),
        )
        for j, (phase, closed) in enumerate(_PHASES)
    )
    language = " and ".join(
        f"{part.operation} {part.target} {part.relation} {part.landmark}".strip() for part in key
    )
    phases = tuple(phase for phase, _ in _PHASES)
    places = {target: layout[0], landmark: layout[1]}
    return MemoryEntry(
        RetrievalKey(key, phases), language, key_poses, quality, 1, f"synthetic/memory#{i}", places
    )
