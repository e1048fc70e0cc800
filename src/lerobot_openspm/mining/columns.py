"""Mined key poses as columns of a LeRobotDataset, one value per frame, and back.

The frames after one key pose, up to and with the next, are on the way to that next one. Frames after the last
key pose, and those of episodes without any, have index -1 and no phase.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.mining.key_poses import KeyPose
from lerobot_openspm.mining.signals import Episode

# Of the key pose that a frame is on the way to ...
PHASE = "openspm.phase"  # the phase that ends there
KEY_POSE = "openspm.key_pose"  # its number in the episode
TARGET = "openspm.target"  # what the state is there
# ... and whether the frame is that key pose.
IS_KEY_POSE = "openspm.is_key_pose"
# What else a key pose holds. Its pose and opening are the state's at its frame.
CONFIDENCE, CLOSED = "openspm.confidence", "openspm.closed"
N_STEPS, DWELL, CONTACT = "openspm.n_steps", "openspm.dwell", "openspm.contact"

TYPES: dict[str, str] = {
    PHASE: "string", KEY_POSE: "int64", IS_KEY_POSE: "bool", CONFIDENCE: "float64", CLOSED: "bool",
    N_STEPS: "int64", DWELL: "bool", CONTACT: "int64",
}  # fmt: skip


def features(state: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The columns as LeRobot describes features, given the state's description."""
    scalars = {name: {"dtype": dtype, "shape": (1,), "names": None} for name, dtype in TYPES.items()}
    return {**scalars, TARGET: {"dtype": "float32", "shape": state["shape"], "names": state["names"]}}


def encode_key_poses(state: Array, key_poses: Sequence[KeyPose]) -> dict[str, np.ndarray]:
    """Columns of one episode's frames.

    Args:
        state: The frames' ``observation.state`` ``(n, d)``.
        key_poses: The episode's, in order; none for an episode that shows none.

    Returns:
        By name, ``(n,)``, and the target ``(n, d)``. After the last key pose the target stays; in an episode
        without key poses it is the state itself.
    """
    n = len(state)
    target = np.array(state) if not key_poses else np.repeat(state[key_poses[-1].frame][None], n, axis=0)
    columns: dict[str, np.ndarray] = {
        PHASE: np.full(n, "", dtype=object), KEY_POSE: np.full(n, -1, np.int64),
        IS_KEY_POSE: np.zeros(n, bool), CONFIDENCE: np.zeros(n), CLOSED: np.zeros(n, bool),
        N_STEPS: np.zeros(n, np.int64), DWELL: np.zeros(n, bool), CONTACT: np.full(n, -1, np.int64),
    }  # fmt: skip
    ends = [-1, *(pose.frame for pose in key_poses)]
    for number, (before, pose) in enumerate(zip(ends[:-1], key_poses, strict=True)):
        way = slice(before + 1, pose.frame + 1)
        values = {
            PHASE: pose.phase, KEY_POSE: number, CONFIDENCE: pose.confidence, CLOSED: pose.closed,
            N_STEPS: pose.n_steps, DWELL: pose.dwell, CONTACT: pose.contact,
        }  # fmt: skip
        for name, value in values.items():
            columns[name][way] = value
        columns[IS_KEY_POSE][pose.frame] = True
        target[way] = state[pose.frame]
    return {**columns, TARGET: target.astype(np.float32)}


def decode_key_poses(columns: Mapping[str, Sequence[Any]], episode: Episode, where: str) -> list[KeyPose]:
    """Read an episode's key poses from its columns.

    Args:
        columns: By name, the values of its frames; those in :data:`TYPES`.
        episode: Its signals.
        where: Names the dataset in errors.

    Raises:
        DatasetError: The columns contradict each other, or name an unknown phase.
    """
    frames = [frame for frame, is_key_pose in enumerate(columns[IS_KEY_POSE]) if is_key_pose]
    where = f"{where}, episode {episode.index}"
    numbers = [columns[KEY_POSE][frame] for frame in frames]
    if numbers != list(range(len(frames))):
        raise DatasetError(
            f"{where}: {KEY_POSE} is {numbers} in the frames where {IS_KEY_POSE} is true, expected them "
            "counted from 0; write the columns again with openspm mine --annotated=FOLDER"
        )
    found = []
    for frame in frames:
        phase, confidence = columns[PHASE][frame], columns[CONFIDENCE][frame]
        if phase not in PHASES or not 0 <= confidence <= 1:
            raise DatasetError(
                f"{where}, frame {frame}: {PHASE} is {phase!r} with {CONFIDENCE} {confidence}, expected one "
                f"of {', '.join(PHASES)} with 0 to 1"
            )
        found.append(
            KeyPose(
                frame, episode.T_world_ee[frame], phase, confidence, columns[CLOSED][frame],
                float(episode.opening[frame]), columns[N_STEPS][frame], columns[DWELL][frame],
                columns[CONTACT][frame],
            )
        )  # fmt: skip
    return found
