"""LIBERO as it is recorded is LIBERO as LeRobot evaluates on it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.geometry.camera import load_cameras, project

pytest.importorskip("libero.libero", reason="needs lerobot[libero]")
pytestmark = pytest.mark.libero

TASK = "put_the_bowl_on_the_plate"
CALIBRATION = Path(__file__).parents[3] / "configs/cameras/libero.json"


@pytest.fixture(scope="module")
def simulator():
    from lerobot_openspm.envs.libero.simulator import LiberoSimulator

    made = LiberoSimulator(TASK, 256)
    made.reset(TUNING_SEED_START)
    yield made
    made.close()


@pytest.mark.parametrize(
    "task", [TASK, "open_the_top_drawer_and_put_the_bowl_inside", "put_the_wine_bottle_on_the_rack"]
)
def test_observations_are_those_of_lerobots_environment(task):
    """In two scenes, at rest and along a random motion, from both cameras, bit for bit."""
    from lerobot.envs.libero import LiberoEnv, _get_suite

    from lerobot_openspm.envs.libero.simulator import LiberoSimulator

    suite = _get_suite("libero_goal")
    task_id = [one.name for one in suite.tasks].index(task)
    env = LiberoEnv(suite, task_id, "libero_goal", obs_type="pixels_agent_pos", init_states=False)

    def restart(seed):
        return env.reset(seed=seed)[0]

    # One after the other: LIBERO's environment draws into whichever OpenGL context was made last.
    theirs = [_observed(raw) for raw in along_a_motion(restart, lambda action: env.step(action)[0])]
    env.close()
    ours = LiberoSimulator(task, 256)
    for _, (state, images) in zip(along_a_motion(ours.reset, ours.step), theirs, strict=True):
        np.testing.assert_array_equal(ours.state(), state)
        for name, image in ours.images().items():
            np.testing.assert_array_equal(image, images[name])
    ours.close()


def along_a_motion(restart, step):
    """In two scenes, what `restart` and every eighth `step` return."""
    for seed in (TUNING_SEED_START, TUNING_SEED_START + 1):
        yield restart(seed)
        for action in np.random.default_rng(seed).uniform(-1, 1, (4, 7)):
            for _ in range(7):
                step(action)
            yield step(action)


def _observed(raw):
    """State and images of LeRobot's raw observation, made by LeRobot's own steps."""
    from lerobot.envs.utils import preprocess_observation
    from lerobot.processor.env_processor import LiberoProcessorStep

    batch = preprocess_observation({"pixels": raw["pixels"], "robot_state": _batched(raw["robot_state"])})
    observed = LiberoProcessorStep().observation(batch)
    images = {
        name: (observed[f"observation.images.{name}"][0] * 255).round().to(torch.uint8).permute(1, 2, 0)
        for name in ("image", "image2")
    }
    return observed["observation.state"][0], images


def _batched(state):
    return {k: _batched(v) if isinstance(v, dict) else np.asarray(v)[None] for k, v in state.items()}


def test_the_calibration_file_is_the_simulators():
    from lerobot_openspm.envs.libero.recording import LiberoSuite

    written, read = json.loads(CALIBRATION.read_text()), LiberoSuite().calibration(256, 256)
    assert written.keys() == read.keys()
    for key, camera in read["cameras"].items():
        for field, value in camera.items():
            if field == "mount":
                assert written["cameras"][key][field] == value
            else:
                np.testing.assert_allclose(written["cameras"][key][field], value, atol=1e-6)


@pytest.mark.parametrize("size", [256, 360])
def test_objects_are_seen_where_the_calibration_puts_them(simulator, size):
    camera = load_cameras(CALIBRATION)["observation.images.image"].scaled(size, size)
    middle = simulator.body_pose("akita_black_bowl_1_main")[:3, 3] + [0.0, 0.0, 0.03]
    before = simulator.render("image", size)
    state = simulator.sim.get_state()
    # To where no camera looks. The bowl is black and the table is light.
    simulator.sim.data.qpos[simulator.sim.model.get_joint_qpos_addr("akita_black_bowl_1_joint0")[0]] = 100.0
    simulator.sim.forward()
    after = simulator.render("image", size)
    simulator.sim.set_state(state)
    simulator.sim.forward()
    v, u = np.nonzero((after.astype(int) - before).min(axis=-1) > 60)
    uv, _ = project(camera, camera.T_world_cam(np.eye(4)), middle)
    seen = np.array([(u.min() + u.max()) / 2, (v.min() + v.max()) / 2])
    np.testing.assert_allclose(uv, seen, atol=3 * size / 256)


def test_looking_leaves_no_trace_in_the_simulation(simulator):
    from lerobot_openspm.envs.libero.simulator import LiberoSimulator

    simulator.reset(TUNING_SEED_START)
    blind = LiberoSimulator(TASK)
    blind.reset(TUNING_SEED_START)
    rng = np.random.default_rng(0)
    for _ in range(12):
        simulator.images()
        action = rng.uniform(-1, 1, 7)
        simulator.step(action)
        blind.step(action)
    np.testing.assert_array_equal(blind.sim.data.qpos, simulator.sim.data.qpos)
    blind.close()
    simulator.reset(TUNING_SEED_START)


def test_two_simulators_draw_their_own_scenes(simulator):
    from lerobot_openspm.envs.libero.simulator import LiberoSimulator

    before = simulator.render("image", 128)
    other = LiberoSimulator("open_the_middle_drawer_of_the_cabinet", 128)
    other.reset(TUNING_SEED_START + 3)
    theirs = other.image("image")
    np.testing.assert_array_equal(simulator.render("image", 128), before)
    np.testing.assert_array_equal(other.image("image"), theirs)
    assert np.abs(theirs.astype(int) - before).max() > 60
    other.close()
    np.testing.assert_array_equal(simulator.render("image", 128), before)


def test_the_same_seed_gives_the_same_scene(simulator):
    simulator.reset(TUNING_SEED_START + 1)
    first = simulator.sim.data.qpos.copy()
    simulator.reset(TUNING_SEED_START + 2)
    assert np.abs(simulator.sim.data.qpos - first).max() > 1e-3
    simulator.reset(TUNING_SEED_START + 1)
    np.testing.assert_array_equal(simulator.sim.data.qpos, first)
    simulator.reset(TUNING_SEED_START)
