"""LIBERO's suites as suites to record, in the layout of the public LIBERO dataset."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_openspm.envs.calibration import calibration
from lerobot_openspm.envs.libero.experts import EXPERTS, expert_actions
from lerobot_openspm.envs.libero.simulator import (
    CAMERA_MOUNTS,
    CAMERAS,
    OBJECTS,
    SUITE,
    LiberoSimulator,
    scene_kind,
    suite_of,
    tasks,
)
from lerobot_openspm.envs.motions import Actions
from lerobot_openspm.envs.recording import OBJECT_POSES, Names, pose_names, pose_vector
from lerobot_openspm.envs.selection import names_in, select

# LIBERO ends an episode when its goal first holds, often in mid-motion. A demonstration that ended there too
# would teach a policy to stop at the very threshold, so it goes on a little, as people do.
STEPS_AFTER_SUCCESS = 10


class LiberoScene:
    """One task of LIBERO, see `Scene`."""

    def __init__(self, task: str, image_size: int) -> None:
        self._simulator = LiberoSimulator(task, image_size)
        self.instruction = self._simulator.instruction
        # An expert that takes longer than the policy may is no use as a demonstration.
        self.status, self._steps_left = "failed", self._simulator.max_steps

    def reset(self, seed: int) -> None:
        """See `Scene`."""
        self._simulator.reset(seed)
        self.status, self._steps_left = "failed", self._simulator.max_steps

    def expert(self, rng: np.random.Generator) -> Actions:
        """See `Scene`."""
        return expert_actions(self._simulator, self._simulator.task, rng)

    def images(self) -> Mapping[str, np.ndarray]:
        """See `Scene`."""
        return self._simulator.images()

    def columns(self) -> Mapping[str, np.ndarray]:
        """See `Scene`."""
        poses = pose_vector(self._simulator.object_poses(), list(OBJECTS[self._simulator.suite]))
        return {"observation.state": self._simulator.state(), OBJECT_POSES: poses}

    def step(self, action: np.ndarray) -> bool:
        """See `Scene`."""
        self._steps_left -= 1
        if self._simulator.step(action) and self.status != "success":
            self.status, self._steps_left = "success", min(self._steps_left, STEPS_AFTER_SUCCESS)
        return self._steps_left == 0

    def close(self) -> None:
        """See `Scene`."""
        self._simulator.close()


class LiberoSuite:
    """One of LIBERO's suites, see `Suite`.

    Args:
        suite: LIBERO's name of it.
    """

    robot_type = "panda"
    cameras = tuple(CAMERAS)

    def __init__(self, suite: str = SUITE) -> None:
        self._suite = suite
        self.name = "libero" if suite == SUITE else suite

    @property
    def names(self) -> Mapping[str, Names]:
        """See `Suite`."""
        # The public dataset's names. Its "roll, pitch, yaw" are an axis-angle.
        return {
            "observation.state": {"motors": ["x", "y", "z", "roll", "pitch", "yaw", "gripper", "gripper"]},
            "action": {"motors": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]},
            OBJECT_POSES: pose_names(list(OBJECTS[self._suite])),
        }

    def tasks(self, selection: str) -> list[str]:
        """See `Suite`."""
        known = [task for task in tasks(self._suite) if task in EXPERTS]
        return select(selection, tasks(self._suite), {"all": known, self._suite: known}, self._suite)

    def scene(self, task: str, height: int, width: int) -> LiberoScene:
        """See `Suite`."""
        if height != width:
            raise ValueError(f"LIBERO's images are recorded square, got {height} x {width}")
        return LiberoScene(task, height)

    def calibration(self, height: int, width: int, selection: str = "all") -> dict[str, Any] | None:
        """See `Suite`. LeRobot turns robosuite's images by 180 degrees, which leaves them mirrored."""
        names = self.tasks(selection)
        if len({scene_kind(task) for task in names}) > 1:
            return None
        simulator = LiberoSimulator(names[0])
        simulator.reset(0)
        model, data, T_world_ee = simulator.sim.model._model, simulator.sim.data._data, simulator.ee_pose()
        size = height, width
        found = calibration(model, data, CAMERAS, CAMERA_MOUNTS, T_world_ee, size, mirrored=True)
        simulator.close()
        return found


def selected_suite(selection: str) -> str:
    """The suite that tasks are of: libero_goal for "all", else one that is named, or that of the named tasks.

    Raises:
        ValueError: A name is unknown, the tasks are of several suites, or LIBERO is not installed.
    """
    names, by_suite = names_in(selection), dict[str, list[str]]()
    if names == ["all"]:
        return SUITE
    for name in names:
        by_suite.setdefault(name if name in OBJECTS else suite_of(name), []).append(name)
    if len(by_suite) > 1:
        told = "; ".join(f"of {suite}: {', '.join(some)}" for suite, some in by_suite.items())
        raise ValueError(f"env.task names tasks of {len(by_suite)} suites ({told}), expected those of one")
    return next(iter(by_suite), SUITE)
