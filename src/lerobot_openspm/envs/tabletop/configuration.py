"""`--env.type=openspm_tabletop` for LeRobot's command lines. Importing this module does not import mujoco."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE, OBS_STR

from lerobot_openspm.envs.tabletop.scene import CAMERA_NAMES, OBJECT_NAMES
from lerobot_openspm.envs.tabletop.tasks import ANY_TASK, TASK_NAMES, select_tasks

SUITE_NAME = "openspm_tabletop"
ACTION_SIZE = 7
STATE_SIZE = 8
OBJECT_POSES_SIZE = 7 * len(OBJECT_NAMES)


@EnvConfig.register_subclass(SUITE_NAME)
@dataclass
class TabletopEnvConfig(EnvConfig):
    """The embedded tabletop: `task` is a task name, a comma list of them, or a selection.

    The selections are "all" (the ten), "compound", "two_bowls", "anywhere" and "combinations", see `tasks`.
    """

    task: str | None = "all"
    fps: int = 20
    # Control steps; by default the task's own, 300 for each part of its instruction.
    episode_length: int | None = None
    observation_height: int = 256
    observation_width: int = 256
    # True poses as observation.object_poses: for oracle ablations, never for a policy's reported figure.
    object_poses: bool = False
    # The simulator's own segmentation as observation.masks.<camera>: for ablations of the segmentation.
    masks: bool = False
    # Metres along the optical axis as observation.depth.<camera>, as an aligned depth camera would give.
    depth: bool = False
    # File to append one JSON line per finished episode to: task, seed, steps, success, status.
    episode_log: str | None = None
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_SIZE,))}
    )
    features_map: dict[str, str] = field(default_factory=lambda: {ACTION: ACTION})

    def __post_init__(self) -> None:
        if self.fps != 20:
            raise ValueError(f"openspm_tabletop runs at 20 control steps a second, got fps={self.fps}")
        select_tasks(self.task or "")
        shape = (self.observation_height, self.observation_width, 3)
        for name in CAMERA_NAMES:
            self.features[f"pixels/{name}"] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)
            self.features_map[f"pixels/{name}"] = f"{OBS_IMAGES}.{name}"
        self.features["agent_pos"] = PolicyFeature(type=FeatureType.STATE, shape=(STATE_SIZE,))
        self.features_map["agent_pos"] = OBS_STATE
        if self.object_poses:
            self.features["object_poses"] = PolicyFeature(type=FeatureType.ENV, shape=(OBJECT_POSES_SIZE,))
            self.features_map["object_poses"] = f"{OBS_STR}.object_poses"
        for kind in [kind for kind, wanted in (("masks", self.masks), ("depth", self.depth)) if wanted]:
            for name in CAMERA_NAMES:
                # Not VISUAL: LeRobot expects three channels of those, and compares them with the policy's.
                layer = PolicyFeature(type=FeatureType.ENV, shape=(1, *shape[:2]))
                self.features[f"{kind}.{name}"] = layer
                self.features_map[f"{kind}.{name}"] = f"{OBS_STR}.{kind}.{name}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `TabletopEnv` but the task."""
        return {
            "episode_length": self.episode_length,
            "observation_height": self.observation_height,
            "observation_width": self.observation_width,
            "object_poses": self.object_poses,
            "masks": self.masks,
            "depth": self.depth,
            "episode_log": self.episode_log,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Make one vector environment per selected task; the task id is its place in `ANY_TASK`.

        Finished rows are frozen until the next rollout, with and without worker processes.

        Raises:
            ValueError: `n_envs` is not positive, or the task is unknown.
        """
        if n_envs <= 0:
            raise ValueError(f"n_envs must be positive, got {n_envs}")
        probe = make_env(TASK_NAMES[0], self.gym_kwargs)
        spaces_and_metadata = (probe.observation_space, probe.action_space, probe.metadata)
        numbers = {name: number for number, name in enumerate(ANY_TASK)}
        envs: dict[int, Any] = {}
        for name in select_tasks(self.task or ""):
            functions = [partial(make_env, name, self.gym_kwargs) for _ in range(n_envs)]
            if use_async_envs and n_envs > 1:
                envs[numbers[name]] = _LazyAsyncVectorEnv(functions, *spaces_and_metadata)
            else:
                envs[numbers[name]] = _make_sync(functions)
        return {SUITE_NAME: envs}


def make_env(task: str, gym_kwargs: dict[str, Any]) -> gym.Env:
    """Make one environment, in the process that is going to use it."""
    from lerobot_openspm.envs.tabletop.env import TabletopEnv

    return TabletopEnv(task=task, **gym_kwargs)


def _make_sync(functions: list[Callable[[], gym.Env]]) -> gym.vector.SyncVectorEnv:
    frozen = [freeze_after_episode_end(function) for function in functions]
    return gym.vector.SyncVectorEnv(frozen, autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP)
