"""Tasks that are made of others: their parts, their goals, their length."""

import pytest
from tests.envs.helpers import run_expert

from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.envs.tabletop.configuration import TabletopEnvConfig
from lerobot_openspm.envs.tabletop.tasks import (
    ANY_TASK,
    COMPOUND_TASKS,
    TASK_NAMES,
    TASKS,
    select_tasks,
)
from lerobot_openspm.language.instruction import parse_instruction


def test_compound_selects_five_tasks_and_all_does_not_hold_them():
    assert len(COMPOUND_TASKS) == 5
    assert select_tasks("compound") == list(COMPOUND_TASKS)
    assert select_tasks("all") == list(TASK_NAMES)
    one = list(COMPOUND_TASKS)[2]
    assert select_tasks(f"turn_on_stove, {one}") == ["turn_on_stove", one]
    envs = TabletopEnvConfig(task="compound", observation_height=128, observation_width=128).create_envs(1)
    assert list(envs["openspm_tabletop"]) == list(range(10, 15))


@pytest.mark.parametrize("task", COMPOUND_TASKS.values(), ids=lambda task: task.name)
def test_the_whole_was_never_demonstrated_and_its_parts_were(task):
    said = {parse_instruction(one.instruction) for one in TASKS.values()}
    whole = parse_instruction(task.instruction)
    assert whole not in said
    assert [(one,) for one in whole] == [parse_instruction(TASKS[part].instruction) for part in task.parts]


@pytest.mark.parametrize(("task", "steps"), [("bowl_on_plate", 300), ("bowl_on_plate_then_stove", 600)])
def test_every_part_has_three_hundred_steps(make_env, task, steps):
    assert make_env(task)._max_episode_steps == steps
    assert make_env(task, episode_length=7)._max_episode_steps == 7


@pytest.mark.parametrize("task", COMPOUND_TASKS)
def test_a_compound_task_can_be_done_and_is_done_when_all_its_parts_are(make_env, task):
    env = make_env(task)
    env._observe = dict  # nobody looks
    info, steps = run_expert(env, TUNING_SEED_START)
    assert info["is_success"], f"{task} after {steps} steps: {info}"
    assert steps < ANY_TASK[task].max_steps
    assert all(TASKS[part].is_done(env.simulator) for part in ANY_TASK[task].parts)


def test_one_part_is_not_the_whole(make_env):
    env = make_env("bowl_on_plate")
    env._observe = dict
    run_expert(env, TUNING_SEED_START)
    assert TASKS["bowl_on_plate"].is_done(env.simulator)
    for name in (
        "bowl_on_plate_then_stove",
        "bowl_on_plate_then_box_in_bowl",
        "push_plate_then_bowl_on_plate",
    ):
        assert not COMPOUND_TASKS[name].is_done(env.simulator)
