"""Expert episodes as arrays, and what a suite of tasks has to offer so that they can be recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.envs.motions import Actions

# Not under "observation.": no policy is ever handed the true poses by accident.
OBJECT_POSES = "simulator.object_poses"
# A list, or the grouped form that some LeRobot datasets use.
Names = list[str] | dict[str, list[str]]
POSE_COMPONENTS = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class RecordedEpisode:
    """One attempt of an expert, `n` frames long. Observations are those before the action of their frame.

    Attributes:
        task: Name of the task.
        instruction: What was to be done.
        seed: What the initial state and the expert's imperfections were drawn from.
        status: How it ended: "success", or what went wrong.
        images: Per camera (n, height, width, 3) uint8.
        columns: By feature name (n, numbers) float32: observation.state, action, the true object poses.
    """

    task: str
    instruction: str
    seed: int
    status: str
    images: Mapping[str, np.ndarray]
    columns: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.columns["action"])

    @property
    def success(self) -> bool:
        """Whether the goal was reached."""
        return self.status == "success"

    def about(self) -> dict[str, Any]:
        """What is kept of it beside the dataset."""
        return {
            "task": self.task,
            "seed": self.seed,
            "steps": len(self),
            "success": self.success,
            "status": self.status,
        }


class Scene(Protocol):
    """One task in a simulator, with its expert."""

    @property
    def instruction(self) -> str:
        """What is to be done."""
        ...

    @property
    def status(self) -> str:
        """How the episode stands: "success" once the goal is reached."""
        ...

    def reset(self, seed: int) -> None:
        """Draw an initial state."""
        ...

    def expert(self, rng: np.random.Generator) -> Actions:
        """Actions (7,) that do the task; each is asked for after the one before was stepped."""
        ...

    def images(self) -> Mapping[str, np.ndarray]:
        """The cameras' images now, (height, width, 3) uint8, by the names of the suite's cameras."""
        ...

    def columns(self) -> Mapping[str, np.ndarray]:
        """``observation.state`` and the true object poses now."""
        ...

    def step(self, action: np.ndarray) -> bool:
        """Apply an action; whether the episode is over."""
        ...

    def close(self) -> None:
        """Free the simulator."""
        ...


class Suite(Protocol):
    """Tasks in one simulator, recorded in one layout."""

    @property
    def name(self) -> str:
        """What a dataset of it is called by default; also --env.task, if it is not --env.type."""
        ...

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
        """Names of the tasks that a selection stands for; "all" in an order that decides about their seeds.

        Raises:
            ValueError: A name is unknown, or the suite is not installed.
        """
        ...

    def scene(self, task: str, height: int, width: int) -> Scene:
        """A task whose images have a size in pixels."""
        ...

    def calibration(self, height: int, width: int, selection: str = "all") -> dict[str, Any] | None:
        """The cameras in the calibration file's format; None if they stand elsewhere in some of the tasks."""
        ...


def record(scene: Scene, task: str, seed: int) -> RecordedEpisode:
    """Let the expert act from the initial state of `seed` until the episode ends."""
    scene.reset(seed)
    images: dict[str, list[np.ndarray]] = {}
    columns: dict[str, list[np.ndarray]] = {}
    for action in scene.expert(np.random.default_rng(seed)):
        for kept, new in ((images, scene.images()), (columns, {**scene.columns(), "action": action})):
            for key, value in new.items():
                kept.setdefault(key, []).append(value)
        if scene.step(action):
            break
    return RecordedEpisode(
        task,
        scene.instruction,
        seed,
        scene.status,
        {key: np.stack(frames) for key, frames in images.items()},
        {key: np.stack(rows).astype(np.float32) for key, rows in columns.items()},
    )


def pose_vector(poses: Mapping[str, np.ndarray], objects: Sequence[str] | None = None) -> np.ndarray:
    """Position (m) and quat_wxyz (w >= 0) of objects' ``T_world_obj``, (7 * n,).

    Args:
        poses: Those that are there.
        objects: All there can be, in their order; zeros stand for one that is not there. Those that are there
            if not given.
    """
    parts = []
    for name in poses if objects is None else objects:
        if name not in poses:
            parts.append(np.zeros(len(POSE_COMPONENTS)))
            continue
        T_world_obj = poses[name]
        x, y, z, w = Rotation.from_matrix(T_world_obj[:3, :3]).as_quat(canonical=True)
        parts.append([*T_world_obj[:3, 3], w, x, y, z])
    return np.concatenate(parts)


def pose_names(objects: Sequence[str]) -> list[str]:
    """Names of the numbers of :func:`pose_vector`."""
    return [f"{name}.{component}" for name in objects for component in POSE_COMPONENTS]
