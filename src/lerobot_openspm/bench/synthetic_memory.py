"""Large memories of made-up entries, to measure loading and retrieval on."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np

from lerobot_openspm.experience_files import write_files
from lerobot_openspm.experience_header import Header, header_to_fields
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.memory.bank import entry_to_json
from lerobot_openspm.memory.entry import Anchor, MemoryEntry, MemoryKeyPose, RetrievalKey, SubTask
from lerobot_openspm.memory.robot import RobotModel

LOOKS = ("red", "blue", "green", "yellow", "white", "black", "grey", "brown", "small", "large")
THINGS = ("bowl", "plate", "mug", "box", "bottle", "can", "pan", "basket", "tray", "rack")
PHASES = ("approach", "approach", "grasp", "lift", "pre-place", "place", "release")
OBJECTS = tuple(f"{look} {thing}" for look, thing in product(LOOKS, THINGS))
SOURCE = "synthetic#"
# As many different entries as there are pairs of different objects; beyond that only their sources differ.
N_TASKS = len(OBJECTS) * (len(OBJECTS) - 1)


def save_synthetic_memory(directory: Path, n_entries: int, rng: np.random.Generator) -> None:
    """Save a memory of so many entries of seven key poses each, of up to 9,900 tasks, in random order.

    A fast way to a large one: each task's entry is made once and written again under another source.
    """
    robot = RobotModel(1.0, -1.0, 0.08, 0.01, 0.1, 0.01, np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.5]]))
    header = Header("oracle", "demonstrations", "demonstrations", (), None, robot, [], n_entries, OBJECTS)
    camera = Camera(256, 256, 300.0, 300.0, 127.5, 127.5, "world", np.eye(4))
    write_files(directory, header_to_fields(header), synthetic_texts(n_entries, rng), {}, {"front": camera})


def synthetic_texts(n_entries: int, rng: np.random.Generator) -> Iterator[bytes]:
    """The JSON of made-up entries, each with a source of its own."""
    mark = f'"source": "{SOURCE}'.encode()
    order = rng.permutation(N_TASKS)[:n_entries]
    templates = [entry_to_json(synthetic_entry(int(task), rng)).split(mark) for task in order]
    for i in range(n_entries):
        before, after = templates[i % len(templates)]
        yield before + mark + str(i).encode() + after


def synthetic_entry(task: int, rng: np.random.Generator) -> MemoryEntry:
    """An entry of the task of one number, its poses and quality at random."""
    target, other = divmod(task, len(OBJECTS) - 1)
    names = OBJECTS[target], OBJECTS[other + (other >= target)]
    poses = se3.from_position_rotvec(rng.uniform(-0.2, 0.2, (9, 3)), rng.uniform(-1, 1, (9, 3)))
    key_poses = tuple(
        MemoryKeyPose(
            Anchor(*[names[i >= 4]] * 2), poses[i], phase, confidence=1.0, closed=phase in PHASES[2:6],
            opening=0.04, n_steps=10, dwell=phase in ("grasp", "release"),
        )
        for i, phase in enumerate(PHASES)
    )  # fmt: skip
    key = RetrievalKey((SubTask("put", names[0], "", "on", names[1]),), PHASES)
    layout = dict(zip(names, poses[7:], strict=True))
    instruction = f"put the {names[0]} on the {names[1]}"
    return MemoryEntry(key, instruction, key_poses, float(rng.uniform(0.5, 1)), 1, SOURCE, layout)
