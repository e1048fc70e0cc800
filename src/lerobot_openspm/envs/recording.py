"""Expert episodes as arrays, and what a simulator has to offer so that `openspm collect` can record them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

# Not under "observation.": no policy is ever handed the true poses by accident.
OBJECT_POSES = "simulator.object_poses"
# A list, or the grouped form that some LeRobot datasets use.
Names = list[str] | dict[str, list[str]]
POSE_COMPONENTS = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class RecordedEpisode:
    """One attempt of an expert, `n` frames long. Observations are those before the action of their frame.

    Attributes:
        images: Per camera (n, height, width, 3) uint8.
        columns: By feature name (n, numbers) float32: observation.state, action, the true object poses.
        status: What the environment said when it ended.
    """

    task: str
    instruction: str
    seed: int
    success: bool
    status: str
    images: Mapping[str, np.ndarray]
    columns: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.columns["action"])


class Source(Protocol):
    """A simulator with an expert for each of its tasks."""

    @property
    def robot_type(self) -> str:
        """What the dataset calls the robot."""
        ...

    @property
    def cameras(self) -> Sequence[str]:
        """The cameras' names; their images are ``observation.images.<name>``."""
        ...

    @property
    def names(self) -> Mapping[str, Names]:
        """Names of the numbers of ``observation.state``, ``action`` and the true object poses."""
        ...

    def tasks(self, selection: str) -> list[str]:
        """Names of the tasks that a selection ("all", or names with commas) stands for."""
        ...

    def all_tasks(self) -> Sequence[str]:
        """All tasks in their fixed order, which decides who takes which seeds."""
        ...

    def record(self, task: str, seed: int, height: int, width: int) -> RecordedEpisode:
        """Let the expert act from the initial state of `seed` until the episode ends."""
        ...

    def calibration(self, height: int, width: int) -> dict[str, Any]:
        """The cameras in the calibration file's format."""
        ...


class Recorder:
    """Collects the frames of one episode."""

    def __init__(self) -> None:
        self._images: dict[str, list[np.ndarray]] = {}
        self._columns: dict[str, list[np.ndarray]] = {}

    def add(self, images: Mapping[str, np.ndarray], columns: Mapping[str, np.ndarray]) -> None:
        """Add one frame."""
        for kept, new in ((self._images, images), (self._columns, columns)):
            for key, value in new.items():
                kept.setdefault(key, []).append(value)

    def episode(self, task: str, instruction: str, seed: int, success: bool, status: str) -> RecordedEpisode:
        """What was added so far."""
        images = {key: np.stack(frames) for key, frames in self._images.items()}
        columns = {key: np.stack(rows).astype(np.float32) for key, rows in self._columns.items()}
        return RecordedEpisode(task, instruction, seed, success, status, images, columns)


def pose_vector(poses: Mapping[str, np.ndarray]) -> np.ndarray:
    """Position (m) and quat_wxyz (w >= 0) of every object's ``T_world_obj``, in their order, (7 * n,)."""
    parts = []
    for T_world_obj in poses.values():
        x, y, z, w = Rotation.from_matrix(T_world_obj[:3, :3]).as_quat(canonical=True)
        parts.append([*T_world_obj[:3, 3], w, x, y, z])
    return np.concatenate(parts)


def pose_names(objects: Sequence[str]) -> list[str]:
    """Names of the numbers of :func:`pose_vector`."""
    return [f"{name}.{component}" for name in objects for component in POSE_COMPONENTS]


def has_libero() -> bool:
    """Whether LIBERO is installed."""
    return find_spec("libero") is not None


def source(env_type: str) -> Source:
    """The source of an environment type.

    Raises:
        ValueError: There is no such source, or it is not installed.
    """
    if env_type == "openspm_tabletop":
        from lerobot_openspm.envs.tabletop.recording import TabletopSource

        return TabletopSource()
    if env_type == "libero":
        if not has_libero():
            raise ValueError("env.type=libero needs LIBERO; install it with: pip install 'lerobot[libero]'")
        from lerobot_openspm.envs.libero.recording import LiberoSource

        return LiberoSource()
    raise ValueError(f"env.type is {env_type!r}, expected openspm_tabletop or libero")
