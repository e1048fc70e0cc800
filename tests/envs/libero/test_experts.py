from pathlib import Path

import numpy as np
import pytest

from lerobot_openspm.envs.libero.experts import EXPERTS, expert_actions
from lerobot_openspm.envs.libero.long_tasks import LONG
from lerobot_openspm.envs.libero.picks import OBJECT, SPATIAL
from lerobot_openspm.envs.libero.simulator import LiberoSimulator, tasks
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.geometry.se3 import yaw_of

pytest.importorskip("libero.libero", reason="needs lerobot[libero]")
pytestmark = pytest.mark.libero

# An expert of a goal task is quicker than LIBERO asks for.
GOAL_STEPS = 280
# Five scenes of each goal task, which take two minutes in all.
SEEDS = range(TUNING_SEED_START, TUNING_SEED_START + 5)


def make_simulator(task: str) -> LiberoSimulator:
    from libero.libero import get_assets_path

    # Without local assets, this fetches them from the Hub.
    if not Path(get_assets_path()).is_dir():
        pytest.skip("needs LIBERO's assets, or a network to fetch them")
    return LiberoSimulator(task)


def steps_to_success(simulator: LiberoSimulator, seed: int) -> int | None:
    simulator.reset(seed)
    actions = expert_actions(simulator, simulator.task, np.random.default_rng(seed))
    return next((n for n, action in enumerate(actions, 1) if simulator.step(action)), None)


GOAL_TASKS = [task for task in EXPERTS if task not in {**SPATIAL, **OBJECT, **LONG}]
# The butter's expert tips it in some scenes, this first one among them, and collecting draws another.
BUTTER = "LIVING_ROOM_SCENE2_put_both_the_cream_cheese_box_and_the_butter_in_the_basket"
# Of each other suite one in one scene; more take minutes.
OTHERS = SPATIAL, OBJECT, LONG
FIRST = [next(iter(suite)) for suite in OTHERS]
OTHER_TASKS = [
    pytest.param(task, marks=() if task in FIRST else pytest.mark.slow) for suite in OTHERS for task in suite
]


def test_every_task_has_an_expert():
    assert set(GOAL_TASKS) == set(tasks())
    assert set(SPATIAL) == set(tasks("libero_spatial"))
    assert set(OBJECT) == set(tasks("libero_object"))
    assert set(LONG) == set(tasks("libero_10"))


@pytest.mark.parametrize("task", OTHER_TASKS)
def test_expert_solves_a_scene_of_another_suite(task):
    simulator = make_simulator(task)
    n_scenes = 3 if task == BUTTER else 1
    seeds = range(TUNING_SEED_START, TUNING_SEED_START + n_scenes)
    tried = (steps_to_success(simulator, seed) for seed in seeds)
    steps = next((steps for steps in tried if steps is not None), None)
    simulator.close()
    assert steps is not None
    assert steps < simulator.max_steps


@pytest.mark.parametrize("task", GOAL_TASKS)
def test_expert_solves_its_task(task):
    simulator = make_simulator(task)
    steps = {seed: steps_to_success(simulator, seed) for seed in SEEDS}
    simulator.close()
    slow = {seed: n for seed, n in steps.items() if n is None or n >= GOAL_STEPS}
    assert not slow, f"{task}: steps {slow}"


def test_same_generator_same_first_action_and_others_differ():
    simulator = make_simulator("turn_on_the_stove")
    simulator.reset(TUNING_SEED_START)
    first, again, other = (
        next(expert_actions(simulator, simulator.task, np.random.default_rng(seed))) for seed in (1, 1, 2)
    )
    simulator.close()
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_can_is_taken_from_one_side_or_another():
    simulator = make_simulator("pick_up_the_alphabet_soup_and_place_it_in_the_basket")
    turned = set[int]()
    for seed in range(TUNING_SEED_START + 3, TUNING_SEED_START + 5):
        simulator.reset(seed)
        for action in expert_actions(simulator, simulator.task, np.random.default_rng(seed)):
            simulator.step(action)
            if action[6] > 0:
                break
        turned.add(round(float(np.degrees(yaw_of(simulator.ee_pose()))) / 90) % 2)
    assert turned == {0, 1}
    simulator.close()
