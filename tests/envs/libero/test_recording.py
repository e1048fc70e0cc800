"""Demonstrations of LIBERO: in the public dataset's layout, and never from a state it is evaluated on."""

import numpy as np
import pytest
from benchmarks.worlds import initial_states

from lerobot_openspm.envs.collection import CollectConfig, SimulatorConfig
from lerobot_openspm.envs.libero import recording
from lerobot_openspm.envs.libero.recording import LiberoSuite
from lerobot_openspm.envs.libero.simulator import DO_NOTHING, LiberoSimulator, tasks
from lerobot_openspm.envs.recording import RecordedEpisode, record
from lerobot_openspm.envs.seeds import DEMO_SEED_START

pytest.importorskip("libero.libero", reason="needs lerobot[libero]")
pytestmark = pytest.mark.libero

TASKS = (
    "put_the_bowl_on_the_plate",
    "push_the_plate_to_the_front_of_the_stove",
    "open_the_top_drawer_and_put_the_bowl_inside",
)
OTHERS = (
    "pick_up_the_black_bowl_next_to_the_ramekin_and_place_it_on_the_plate",
    "pick_up_the_milk_and_place_it_in_the_basket",
    "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove",
)
NEAR_M = 1e-3


def away(simulator: LiberoSimulator, states: np.ndarray) -> float:
    """How far the furthest movable object is from its place in the most similar evaluation state, metres."""
    model, poses, apart = simulator.sim.model._model, simulator.object_poses(), []
    bodies = {name: model.body(simulator.root_body(name)) for name in poses}
    # The benchmark's states place anew what is free to move; fixtures are drawn by the seed.
    free = {name: body for name, body in bodies.items() if list(body.dofnum) == [6]}
    assert free
    for name, body in free.items():
        address = model.jnt_qposadr[body.jntadr[0]]
        # A flattened state is the time, the positions, the velocities.
        apart.append(np.linalg.norm(states[:, 1 + address : 3 + address] - poses[name][:2, 3], axis=1))
    return float(np.max(apart, axis=0).min())


@pytest.mark.parametrize("task", [*TASKS, *OTHERS])
def test_no_demonstration_starts_from_an_evaluation_state(task):
    simulator, states = LiberoSimulator(task), initial_states(task)
    for seed in range(DEMO_SEED_START, DEMO_SEED_START + 5):
        simulator.reset(seed)
        assert away(simulator, states) > 3 * NEAR_M
    # What the check would say if one did.
    simulator.reset_to(DEMO_SEED_START, states[7])
    assert away(simulator, states) < NEAR_M
    simulator.close()


@pytest.mark.parametrize(
    ("selection", "name", "count"),
    [
        ("all", "libero", 10),
        ("libero_goal", "libero", 10),
        ("libero_spatial", "libero_spatial", 10),
        ("libero_object", "libero_object", 10),
        ("pick_up_the_milk_and_place_it_in_the_basket", "libero_object", 1),
        (f"{TASKS[0]}, {TASKS[1]}", "libero", 2),
    ],
)
def test_a_selection_of_tasks_is_of_one_suite(selection, name, count):
    config = CollectConfig(SimulatorConfig("libero", selection))
    assert (config.repo_id, len(config.env.suite().tasks(config.env.task))) == (f"local/{name}", count)


def test_however_all_tasks_are_named_the_dataset_is_the_same():
    for suite, name in (("libero_goal", "all"), ("libero_spatial", "libero_spatial")):
        for selection in (suite, ",".join(tasks(suite))):
            assert CollectConfig(SimulatorConfig("libero", selection)).env.task == name


@pytest.mark.parametrize(
    ("selection", "message"),
    [
        (f"{TASKS[0]},libero_object", rf"2 suites \(of libero_goal: {TASKS[0]}; of libero_object: "),
        ("fly", "no task 'fly', expected one of libero_goal: open_the_middle_drawer"),
        ("", "unknown libero_goal task"),
    ],
)
def test_a_selection_that_is_of_no_suite_or_of_two_is_refused(selection, message):
    with pytest.raises(ValueError, match=message):
        CollectConfig(SimulatorConfig("libero", selection))


def test_cameras_that_do_not_stand_alike_have_no_calibration():
    kitchen = "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove"
    living_room = next(iter(tasks("libero_10")))
    suite = LiberoSuite("libero_10")
    assert suite.calibration(256, 256, f"{living_room},{kitchen}") is None
    assert suite.calibration(256, 256, kitchen) != suite.calibration(256, 256, living_room)


def recorded(size: int) -> RecordedEpisode:
    scene = LiberoSuite().scene(TASKS[0], size, size)
    episode = record(scene, TASKS[0], DEMO_SEED_START)
    scene.close()
    return episode


def test_recording_only_ever_draws_scenes_by_their_seed(monkeypatch):
    def refuse(*_):
        raise AssertionError("a demonstration was begun from a given state")

    monkeypatch.setattr(LiberoSimulator, "reset_to", refuse)
    monkeypatch.setattr(recording, "expert_actions", lambda *_: iter([np.array(DO_NOTHING)] * 2))
    episode = recorded(64)
    assert (episode.seed, episode.status, episode.success) == (DEMO_SEED_START, "failed", False)


def test_the_layout_is_the_public_datasets(monkeypatch):
    monkeypatch.setattr(recording, "expert_actions", lambda *_: iter([np.array(DO_NOTHING)]))
    suite, episode = LiberoSuite(), recorded(256)
    assert suite.cameras == ("image", "image2")
    shapes = {name: images.shape for name, images in episode.images.items()}
    assert shapes == dict.fromkeys(suite.cameras, (1, 256, 256, 3))
    assert episode.columns["observation.state"].shape == (1, 8)
    assert episode.columns["action"].shape == (1, 7)
    motors = ["x", "y", "z", "roll", "pitch", "yaw"]
    assert suite.names["observation.state"] == {"motors": [*motors, "gripper", "gripper"]}
    assert suite.names["action"] == {"motors": [*motors, "gripper"]}
    assert episode.instruction == tasks()[TASKS[0]]
