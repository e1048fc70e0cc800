import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.env import OBJECT_POSE_NAMES, axis_angle
from lerobot_openspm.envs.tabletop.tasks import TASK_NAMES, TASKS


def _actions(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 7)).astype(np.float32)


def _assert_equal(a: dict, b: dict) -> None:
    for name in scene.CAMERA_NAMES:
        np.testing.assert_array_equal(a["pixels"][name], b["pixels"][name])
    np.testing.assert_array_equal(a["agent_pos"], b["agent_pos"])


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_accepts_it(make_env):
    check_env(make_env())
    check_env(make_env(object_poses=True, masks=True, depth=True))


def test_same_seed_and_actions_give_the_same_bits(make_env):
    first, second = make_env(), make_env()
    second.reset(seed=9)
    second.step(np.ones(7, np.float32))
    _assert_equal(first.reset(seed=3)[0], second.reset(seed=3)[0])
    for action in _actions(15):
        _assert_equal(first.step(action)[0], second.step(action)[0])


def test_instances_share_no_state(make_env):
    first, second = make_env(), make_env()
    first.reset(seed=0)
    second.reset(seed=1)
    before = first.simulator.object_poses()
    second.reset(seed=2)
    for action in _actions(5):
        second.step(action)
    for name, pose in first.simulator.object_poses().items():
        np.testing.assert_array_equal(pose, before[name])
    assert not np.array_equal(first.simulator.model.body_pos, second.simulator.model.body_pos)


def test_starts_at_rest_at_home_with_no_task_done(make_env):
    env = make_env()
    for seed in range(10):
        _, info = env.reset(seed=seed)
        assert info == {"is_success": False, "status": "running", "unstable": False}
        np.testing.assert_allclose(env.simulator.ee_pose()[:3, 3], scene.HOME_POSITION, atol=1e-3)
        assert all(env.simulator.is_at_rest(name) for name in scene.MOVABLE_NAMES)
        assert not any(task.is_done(env.simulator) for task in TASKS.values())


def test_state_is_laid_out_as_in_libero(make_env):
    observation, _ = make_env().reset(seed=0)
    state = observation["agent_pos"]
    np.testing.assert_allclose(state[3:6], (np.pi, 0, 0), atol=1e-3)
    np.testing.assert_allclose(state[6:], (0.04, -0.04), atol=1e-3)


def test_axis_angle_grows_past_pi_without_a_jump():
    from scipy.spatial.transform import Rotation

    for angle in (np.pi - 0.2, np.pi, np.pi + 0.2):
        rotation = Rotation.from_rotvec([angle, 0, 0]).as_matrix()
        np.testing.assert_allclose(axis_angle(rotation), (angle, 0, 0), atol=1e-9)


def test_actions_move_the_hand_in_the_world_frame(make_env):
    env = make_env()
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.array([0.5, 0, 0, 0, 0, 0, -1], np.float32))
    for _ in range(4):
        env.step(np.array([0, 0, 0, 0, 0, 0.5, 1], np.float32))
    for _ in range(10):
        observation, *_ = env.step(np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
    np.testing.assert_allclose(
        env.simulator.ee_pose()[:3, 3], np.add(scene.HOME_POSITION, (0.2, 0, 0)), atol=2e-3
    )
    yaw = np.arctan2(env.simulator.ee_pose()[1, 0], env.simulator.ee_pose()[0, 0])
    assert yaw == pytest.approx(0.3, abs=0.01)
    assert abs(observation["agent_pos"][6]) < 0.002


def test_a_blocked_hand_does_not_wind_up(make_env):
    env = make_env()
    env.reset(seed=0)
    down = np.array([0, 0, -1, 0, 0, 0, 1], np.float32)
    for _ in range(60):
        env.step(down)
    low = env.simulator.ee_pose()[2, 3]
    for _ in range(6):
        env.step(-down)
    assert env.simulator.ee_pose()[2, 3] > low + 0.06


def test_object_poses_are_observed_only_on_demand(make_env):
    env = make_env(object_poses=True)
    observation, _ = env.reset(seed=0)
    vector = observation["object_poses"].reshape(len(scene.OBJECT_NAMES), 7)
    assert observation["object_poses"].shape == (len(OBJECT_POSE_NAMES),)
    for row, pose in zip(vector, env.simulator.object_poses().values(), strict=True):
        np.testing.assert_allclose(row[:3], pose[:3, 3], atol=1e-6)
    assert "object_poses" not in make_env().reset(seed=0)[0]


def test_time_limit_truncates(make_env):
    env = make_env(episode_length=3)
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[2:] for _ in range(3)]
    assert [truncated for _, truncated, _ in ends] == [False, False, True]
    assert ends[-1][2]["status"] == "time_limit"


def test_a_broken_simulation_ends_the_episode(make_env):
    env = make_env()
    env.reset(seed=0)
    env.simulator.data.qvel[:] = np.nan
    _, reward, terminated, _, info = env.step(np.zeros(7, np.float32))
    assert terminated
    assert reward == 0.0
    assert info == {"is_success": False, "status": "unstable", "unstable": True}
    assert env.reset(seed=0)[1]["status"] == "running"


@pytest.mark.parametrize("action", [np.zeros(6), np.full(7, np.nan)])
def test_bad_actions_are_refused(make_env, action):
    env = make_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="7 finite numbers"):
        env.step(action)


def test_unknown_task_lists_the_valid_ones(make_env):
    with pytest.raises(ValueError, match="turn_on_stove"):
        make_env("fly")


def test_render_is_the_front_view(make_env):
    env = make_env()
    env.reset(seed=TUNING_SEED_START)
    assert env.render().shape == (256, 256, 3)
    assert len(TASK_NAMES) == 10
