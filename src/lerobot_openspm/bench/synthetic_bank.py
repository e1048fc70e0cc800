"""A large memory of made-up entries, of the size and shape of mined ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.bench.synthetic_keys import Key, distinct_keys
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.memory.entry import Anchor, MemoryEntry, MemoryKeyPose, RetrievalKey
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.robot import RobotModel

# What picking and placing is made of, and whether the hand is closed on the way.
_PHASES = (
    ("approach", False), ("approach", False), ("grasp", True), ("lift", True),
    ("pre-place", True), ("place", True), ("release", False), ("retreat", False),
)  # fmt: skip
# Demonstrations of each task.
_PER_KEY = 100


def synthetic_experience(count: int, rng: np.random.Generator) -> Memory:
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
        RetrievalKey(key, phases), language, key_poses, quality, 1, f"synthetic/bank#{i}", places
    )
