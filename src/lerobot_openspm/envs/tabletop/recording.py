"""The tabletop as a suite to record."""

# mujoco ships no stubs for its compiled part.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from lerobot_openspm.envs.calibration import calibration
from lerobot_openspm.envs.motions import Actions
from lerobot_openspm.envs.recording import OBJECT_POSES, Names
from lerobot_openspm.envs.tabletop.env import ACTION_NAMES, OBJECT_POSE_NAMES, STATE_NAMES, TabletopEnv
from lerobot_openspm.envs.tabletop.experts import expert_actions
from lerobot_openspm.envs.tabletop.scene import CAMERA_MOUNTS, CAMERA_NAMES
from lerobot_openspm.envs.tabletop.simulator import TabletopSimulator
from lerobot_openspm.envs.tabletop.tasks import select_tasks


class TabletopScene:
    """One task of the tabletop, see `Scene`."""

    def __init__(self, task: str, height: int, width: int) -> None:
        self._env = TabletopEnv(task, observation_height=height, observation_width=width)
        self.instruction = self._env.task_description
        self.status = "running"

    def reset(self, seed: int) -> None:
        """See `Scene`."""
        self._observation, info = self._env.reset(seed=seed)
        self.status = info["status"]

    def expert(self, rng: np.random.Generator) -> Actions:
        """See `Scene`."""
        return expert_actions(self._env.simulator, self._env.task, rng)

    def images(self) -> Mapping[str, np.ndarray]:
        """See `Scene`."""
        return self._observation["pixels"]

    def columns(self) -> Mapping[str, np.ndarray]:
        """See `Scene`."""
        state, poses = self._observation["agent_pos"], self._env.object_pose_vector()
        return {"observation.state": state, OBJECT_POSES: poses}

    def step(self, action: np.ndarray) -> bool:
        """See `Scene`."""
        self._observation, _, terminated, truncated, info = self._env.step(action)
        self.status = info["status"]
        return terminated or truncated

    def close(self) -> None:
        """See `Scene`."""
        self._env.close()


class Tabletop:
    """The bundled tabletop, see `Suite`."""

    name = robot_type = "openspm_tabletop"
    cameras = CAMERA_NAMES

    @property
    def names(self) -> Mapping[str, Names]:
        """See `Suite`."""
        return {
            "observation.state": list(STATE_NAMES),
            "action": list(ACTION_NAMES),
            OBJECT_POSES: list(OBJECT_POSE_NAMES),
        }

    def tasks(self, selection: str) -> list[str]:
        """See `Suite`."""
        return select_tasks(selection)

    def scene(self, task: str, height: int, width: int) -> TabletopScene:
        """See `Suite`."""
        return TabletopScene(task, height, width)

    def calibration(self, height: int, width: int, selection: str = "all") -> dict[str, Any]:
        """See `Suite`."""
        simulator = TabletopSimulator()
        # Where the bodies and cameras are is all that is needed: nothing was placed yet, so all overlap.
        mujoco.mj_kinematics(simulator.model, simulator.data)
        mujoco.mj_camlight(simulator.model, simulator.data)
        names = {name: name for name in CAMERA_NAMES}
        model, data, T_world_ee = simulator.model, simulator.data, simulator.ee_pose()
        return calibration(model, data, names, CAMERA_MOUNTS, T_world_ee, (height, width))
