"""Recording the tabletop's experts."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_openspm.envs.calibration import calibration_document
from lerobot_openspm.envs.recording import OBJECT_POSES, Names, RecordedEpisode, Recorder
from lerobot_openspm.envs.tabletop.env import ACTION_NAMES, OBJECT_POSE_NAMES, STATE_NAMES, TabletopEnv
from lerobot_openspm.envs.tabletop.experts import expert_actions
from lerobot_openspm.envs.tabletop.scene import CAMERA_NAMES
from lerobot_openspm.envs.tabletop.tasks import TASK_NAMES, select_tasks


class TabletopSource:
    """The bundled tabletop, see `Source`."""

    robot_type = "openspm_tabletop"
    cameras = CAMERA_NAMES

    @property
    def names(self) -> Mapping[str, Names]:
        """See `Source`."""
        return {
            "observation.state": list(STATE_NAMES),
            "action": list(ACTION_NAMES),
            OBJECT_POSES: list(OBJECT_POSE_NAMES),
        }

    def tasks(self, selection: str) -> list[str]:
        """See `Source`."""
        return select_tasks(selection)

    def all_tasks(self) -> Sequence[str]:
        """See `Source`."""
        return TASK_NAMES

    def record(self, task: str, seed: int, height: int, width: int) -> RecordedEpisode:
        """See `Source`."""
        env = _environment(task, height, width)
        observation, info = env.reset(seed=seed)
        recorder = Recorder()
        for action in expert_actions(env.simulator, task, np.random.default_rng(seed)):
            columns = {
                "observation.state": observation["agent_pos"],
                "action": action,
                OBJECT_POSES: env.object_pose_vector(),
            }
            recorder.add(observation["pixels"], columns)
            observation, _, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                break
        return recorder.episode(task, env.task_description, seed, info["is_success"], info["status"])

    def calibration(self, height: int, width: int) -> dict[str, Any]:
        """See `Source`."""
        return calibration_document(height, width)


@functools.lru_cache(maxsize=1)
def _environment(task: str, height: int, width: int) -> TabletopEnv:
    return TabletopEnv(task, observation_height=height, observation_width=width)
