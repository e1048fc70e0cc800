"""LIBERO-PRO's variants of libero_goal: its own files are run, and we tune on exchanges of our own."""

import re

import pytest
from benchmarks.libero.variants import PRO_SUITES, exchanged, variant_file, variant_states
from benchmarks.libero_pro import ProConfig

from lerobot_openspm.envs.libero.simulator import SUITE, LiberoSimulator, task_file, tasks

TASK = "put_the_bowl_on_the_plate"
PLACED = re.compile(r"\(On (\w+) main_table_(\w+)\)")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"suite": "libero_goal"}, "suite is 'libero_goal'"),
        ({"states": 51}, "states must be 1 to 50, got 51"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_is_learned(options, message):
    with pytest.raises(ValueError, match=message):
        ProConfig(**options)


def test_another_suite_is_refused_by_name():
    with pytest.raises(ValueError, match="expected libero_goal or one of libero_goal_swap"):
        variant_file("libero_spatial_swap", TASK)


def test_libero_goal_itself_is_no_variant():
    assert variant_file(SUITE, TASK) is None


@pytest.mark.libero
@pytest.mark.parametrize("suite", PRO_SUITES)
def test_a_variant_starts_from_its_own_states_with_its_own_words(suite):
    try:
        file, states = variant_file(suite, TASK), variant_states(suite, TASK)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    simulator = LiberoSimulator(TASK, None, file)
    simulator.reset_to(1000, states[0])
    bowl, plate = (simulator.object_poses()[name][:2, 3] for name in ("bowl", "plate"))
    instruction = simulator.instruction
    simulator.close()
    assert len(states) == 50
    is_swapped = suite == "libero_goal_swap"
    assert (bowl[1] > 0.1) == is_swapped
    assert (plate[0] < -0.1) == is_swapped
    assert instruction == (
        "put the bowl on the plate" if is_swapped else "place the bowl on top of the plate"
    )


@pytest.mark.libero
def test_an_exchange_of_our_own_is_drawn_from_its_seed_and_moves_objects_to_each_others_places():
    usual = dict(PLACED.findall(task_file(TASK).read_text()))
    drawn = [dict(PLACED.findall(exchanged(TASK, seed).read_text())) for seed in range(8)]
    assert all(sorted(places.values()) == sorted(usual.values()) for places in drawn)
    assert all(places != usual for places in drawn[:3])
    assert dict(PLACED.findall(exchanged(TASK, 3).read_text())) == drawn[3]


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
