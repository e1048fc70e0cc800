from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, env_to_policy_features, preprocess_observation

from lerobot_openspm.envs.tabletop.configuration import TabletopEnvConfig
from lerobot_openspm.envs.tabletop.scene import CAMERA_NAMES
from lerobot_openspm.envs.tabletop.tasks import TASK_NAMES

NEW_ROLLOUT = {NEW_ROLLOUT_OPTION: True}
SMALL = {"observation_height": 128, "observation_width": 128}
RICH = TabletopEnvConfig(
    "turn_on_stove", episode_length=3, object_poses=True, masks=True, depth=True, **SMALL
)


def test_policy_features_are_liberos():
    features = env_to_policy_features(TabletopEnvConfig(object_poses=True))
    assert features["observation.state"].shape == (8,)
    assert features["action"].shape == (7,)
    assert features["observation.object_poses"].shape == (49,)
    assert features["observation.images.front"].shape == (3, 256, 256)
    assert "observation.object_poses" not in env_to_policy_features(TabletopEnvConfig())


def test_all_selects_ten_tasks_and_lists_keep_their_ids():
    assert list(TabletopEnvConfig(**SMALL).create_envs(1)["openspm_tabletop"]) == list(range(10))
    envs = TabletopEnvConfig(task="push_plate, bowl_on_plate", **SMALL).create_envs(1)["openspm_tabletop"]
    assert list(envs) == [TASK_NAMES.index("push_plate"), 0]


@pytest.mark.parametrize("task", ["fly", "", "bowl_on_plate,fly"])
def test_unknown_tasks_are_refused_with_the_valid_ones(task):
    with pytest.raises(ValueError, match="bowl_on_plate, bowl_on_stove"):
        TabletopEnvConfig(task=task)


# Each of its processes imports LeRobot first, so the tests below share them.
@pytest.fixture(
    scope="module",
    params=[
        pytest.param(False, id="in this process"),
        pytest.param(True, id="in processes of their own", marks=pytest.mark.slow),
    ],
)
def vector_env(request: pytest.FixtureRequest) -> Iterator[gym.vector.VectorEnv]:
    """Two rows of a short episode, with everything that can be observed."""
    env = RICH.create_envs(2, use_async_envs=request.param)["openspm_tabletop"][9]
    yield env
    env.close()


def test_masks_and_depth_travel_to_the_policys_batch(vector_env: gym.vector.VectorEnv):
    raw, _ = vector_env.reset(seed=[0, 1], options=NEW_ROLLOUT)
    batch = preprocess_observation(raw)
    features = env_to_policy_features(RICH)
    for name in CAMERA_NAMES:
        for key in (f"observation.masks.{name}", f"observation.depth.{name}"):
            assert batch[key].shape == (2, 1, 128, 128)
            assert features[key].shape == (1, 128, 128)
        np.testing.assert_array_equal(batch[f"observation.masks.{name}"], raw[f"masks.{name}"])
        np.testing.assert_array_equal(batch[f"observation.depth.{name}"], raw[f"depth.{name}"])


def test_vector_envs_freeze_finished_rows(vector_env: gym.vector.VectorEnv):
    observation, info = vector_env.reset(seed=[0, 1], options=NEW_ROLLOUT)
    assert not np.any(info["is_success"])
    assert preprocess_observation(observation)["observation.object_poses"].shape == (2, 49)
    assert list(vector_env.call("task_description")) == ["turn on the stove"] * 2
    assert vector_env.call("_max_episode_steps")[0] == 3
    assert vector_env.unwrapped.metadata["render_fps"] == 20
    for _ in range(5):
        previous = observation
        observation, _, _, _, _ = vector_env.step(np.ones((2, 7), np.float32))
    np.testing.assert_array_equal(observation["agent_pos"], previous["agent_pos"])
    again, _ = vector_env.reset(seed=[1, 0], options=NEW_ROLLOUT)
    assert not np.array_equal(again["object_poses"][0], observation["object_poses"][0])
    assert vector_env.call("render")[0].shape == (256, 256, 3)


def test_missing_egl_is_one_clear_error(monkeypatch):
    from lerobot_openspm.envs.gl_backend import RenderingUnavailableError
    from lerobot_openspm.envs.tabletop import simulator

    def broken(*_):
        raise ImportError("Cannot initialize a EGL device display.")

    monkeypatch.setattr(simulator.mujoco, "Renderer", broken)
    with pytest.raises(RenderingUnavailableError, match="libegl1 libegl-mesa0 libgl1-mesa-dri libgles2"):
        simulator.TabletopSimulator().render("front", 128, 128)
