"""One expert episode as arrays: what `openspm collect` runs in its worker processes."""

import functools
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.envs.experts import expert_actions
from lerobot_openspm.envs.scene import CAMERA_NAMES
from lerobot_openspm.envs.tabletop_env import TabletopEnv


@dataclass(frozen=True)
class RecordedEpisode:
    """Observations are those before the action of the same frame.

    Attributes:
        images: Per camera (n, height, width, 3) uint8.
        state: (n, 8) float32, as in `STATE_NAMES`.
        action: (n, 7) float32, as in `ACTION_NAMES`.
        object_poses: (n, 49) float32, as in `OBJECT_POSE_NAMES`.
    """

    task: str
    instruction: str
    seed: int
    success: bool
    status: str
    images: dict[str, np.ndarray]
    state: np.ndarray
    action: np.ndarray
    object_poses: np.ndarray


@functools.lru_cache(maxsize=1)
def _environment(task: str, height: int, width: int) -> TabletopEnv:
    return TabletopEnv(task, observation_height=height, observation_width=width)


def record_episode(task: str, seed: int, height: int, width: int) -> RecordedEpisode:
    """Let the expert act from the initial state of `seed` until the episode ends."""
    env = _environment(task, height, width)
    observation, info = env.reset(seed=seed)
    images: dict[str, list] = {name: [] for name in CAMERA_NAMES}
    states, actions, poses = [], [], []
    for action in expert_actions(env.simulator, task, np.random.default_rng(seed)):
        for name in CAMERA_NAMES:
            images[name].append(observation["pixels"][name])
        states.append(observation["agent_pos"])
        poses.append(env.object_pose_vector())
        actions.append(action)
        observation, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    return RecordedEpisode(
        task=task,
        instruction=env.task_description,
        seed=seed,
        success=info["is_success"],
        status=info["status"],
        images={name: np.stack(frames) for name, frames in images.items()},
        state=np.stack(states),
        action=np.stack(actions),
        object_poses=np.stack(poses),
    )
