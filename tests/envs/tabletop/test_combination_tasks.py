"""Tasks that put things where no demonstration puts them: what is said, and when it is done."""

import numpy as np
import pytest
from tests.envs.helpers import run_expert

from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.envs.tabletop import scene, tasks
from lerobot_openspm.envs.tabletop.combinations import COMBINATION_TASKS
from lerobot_openspm.envs.tabletop.configuration import TabletopEnvConfig
from lerobot_openspm.envs.tabletop.placement import plate_goal, sample_layout
from lerobot_openspm.envs.tabletop.simulator import TabletopSimulator
from lerobot_openspm.envs.tabletop.tasks import ANY_TASK, TASKS, select_tasks
from lerobot_openspm.geometry.se3 import from_yaw
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.types import SubTask

STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
SINGLE = [name for name, task in COMBINATION_TASKS.items() if not task.parts]
OPENED = SubTask("open", "cabinet", "top drawer")
# By name: what is moved, the relation, where to.
SAID = {
    "box_on_plate": ("cream cheese box", "on", "plate"),
    "box_on_stove": ("cream cheese box", "on", "stove"),
    "box_on_cabinet": ("cream cheese box", "on", "cabinet"),
    "box_on_rack": ("cream cheese box", "on", "rack"),
    "bottle_on_plate": ("wine bottle", "on", "plate"),
    "bottle_on_stove": ("wine bottle", "on", "stove"),
    "bottle_in_bowl": ("wine bottle", "in", "bowl"),
    "bowl_on_rack": ("bowl", "on", "rack"),
    "push_box": ("box", "front of", "stove"),
    "bowl_before_stove": ("bowl", "front of", "stove"),
    "bottle_before_stove": ("bottle", "front of", "stove"),
    "bowl_in_shut_drawer": ("bowl", "in", "cabinet"),
    "box_in_top_drawer": ("cream cheese box", "in", "cabinet"),
    "box_in_shut_drawer": ("cream cheese box", "in", "cabinet"),
    "bottle_in_shut_drawer": ("wine bottle", "in", "cabinet"),
}
# Where something stands in the frame of the other thing, by the end of a task's name.
STOVE_TOP = (scene.BURNER_X, 0.0, scene.BURNER_TOP)
IN_DRAWER = (scene.CABINET_HALF[0] + 0.06, -0.02, scene.drawer_height(2) + 0.008)
PLACES = {
    "on_plate": ("plate", (0.01, 0.01, scene.PLATE_FLOOR)),
    "on_stove": ("stove", STOVE_TOP),
    "on_cabinet": ("cabinet", (0.0, 0.0, scene.CABINET_HEIGHT)),
    "box_on_rack": ("rack", (0.0, 0.0, scene.RACK_SHELF_HEIGHT)),
    "bowl_on_rack": ("rack", (0.0, 0.0, scene.RACK_SHELF_HEIGHT + scene.RACK_RAIL_HEIGHT)),
    "in_bowl": ("bowl", (0.0, 0.0, scene.BOWL_FLOOR)),
    "push_box": ("stove", (scene.PLATE_GOAL_X, 0.0, 0.0)),
    "before_stove": ("stove", (scene.PLATE_GOAL_X, 0.0, 0.0)),
    "drawer": ("cabinet", IN_DRAWER),
}


def sub_task(name: str) -> SubTask:
    target, relation, landmark = SAID[name]
    operation, part = "push" if name.startswith("push") else "put", "top drawer" if "drawer" in name else ""
    return SubTask(operation, target, part, relation, landmark)


def moved(name: str) -> str:
    """The simulator's name of what a task moves."""
    return SAID[name][0].split()[-1]


def place(name: str) -> tuple[str, tuple[float, float, float]]:
    return next(at for end, at in PLACES.items() if name.endswith(end))


def put(simulator: TabletopSimulator, name: str, T_world_obj: np.ndarray) -> None:
    """Let a thing down from 2 mm above a pose, and wait a second."""
    T_above = T_world_obj.copy()
    T_above[2, 3] += 0.002
    simulator.put(name, T_above)
    for _ in range(20):
        simulator.apply(STILL)


def test_twenty_combinations_are_selected_and_all_does_not_hold_them():
    assert len(COMBINATION_TASKS) == 20
    assert select_tasks("combinations") == list(COMBINATION_TASKS)
    assert not COMBINATION_TASKS.keys() & set(select_tasks("all"))
    groups = (TASKS, tasks.COMPOUND_TASKS, tasks.TWO_BOWL_TASKS, tasks.ANYWHERE_TASKS, COMBINATION_TASKS)
    assert len(ANY_TASK) == sum(map(len, groups))
    config = TabletopEnvConfig(task="combinations", observation_height=128, observation_width=128)
    assert list(config.create_envs(1)["openspm_tabletop"]) == list(range(30, 50))


@pytest.mark.parametrize("task", COMBINATION_TASKS.values(), ids=lambda task: task.name)
def test_what_is_said_was_never_demonstrated(task):
    read = parse_instruction(task.instruction)
    expected = tuple(sub_task(part) for part in task.parts or (task.name,))
    if task.name == "box_in_top_drawer":
        expected = (OPENED, *expected)
    named = [(one.target.split()[-1], one.operation, one.part, one.relation, one.landmark) for one in read]
    assert named == [
        (one.target.split()[-1], one.operation, one.part, one.relation, one.landmark) for one in expected
    ]
    if not task.parts:
        assert read == expected
    known = {one for shown in TASKS.values() for one in parse_instruction(shown.instruction)}
    whole = {parse_instruction(shown.instruction) for shown in TASKS.values()}
    assert read not in whole
    # The drawer was only ever used after it had been opened in the same demonstration.
    assert not known & set(read) - {OPENED, sub_task("bowl_in_shut_drawer")}


@pytest.mark.parametrize(
    ("name", "steps"),
    [
        ("box_on_plate", 300),
        ("bowl_in_shut_drawer", 600),
        ("bottle_on_plate_then_box_on_stove", 600),
        ("box_in_shut_drawer_then_bottle_on_stove", 900),
    ],
)
def test_every_part_has_three_hundred_steps_and_so_has_opening_the_drawer(make_env, name, steps):
    assert make_env(name)._max_episode_steps == steps


def test_nothing_is_done_at_first(make_env):
    env = make_env("box_on_plate")
    env._observe = dict  # nobody looks
    for seed in range(TUNING_SEED_START, TUNING_SEED_START + 5):
        env.reset(seed=seed)
        assert not [name for name, task in COMBINATION_TASKS.items() if task.is_done(env.simulator)]


def test_a_box_that_goes_into_a_drawer_stands_beside_it_and_the_plate_not_where_another_thing_goes():
    both = COMBINATION_TASKS["box_in_shut_drawer_then_bottle_on_stove"]
    assert COMBINATION_TASKS["box_on_plate"].has_room is None
    for seed in range(TUNING_SEED_START, TUNING_SEED_START + 5):
        layout = sample_layout(np.random.default_rng(seed), both.has_room)
        box = layout["cabinet"].to_local(layout["box"].x, layout["box"].y)
        assert box[0] > scene.HANDLE_X + scene.DRAWER_TRAVEL or abs(box[1]) > scene.CABINET_HALF[1]
        layout = sample_layout(np.random.default_rng(seed), COMBINATION_TASKS["bowl_before_stove"].has_room)
        x, y = plate_goal(layout["stove"])
        apart = np.hypot(layout["plate"].x - x, layout["plate"].y - y)
        assert apart > scene.PLATE_RADIUS + scene.BOWL_RADIUS


@pytest.mark.parametrize("name", SINGLE)
def test_a_thing_that_stands_in_its_place_is_in_it_and_one_in_the_air_is_not(make_env, name):
    env = make_env(name)
    env._observe = dict
    env.reset(seed=TUNING_SEED_START)
    simulator, is_done = env.simulator, COMBINATION_TASKS[name].is_done
    if "drawer" in name:
        simulator.data.qpos[simulator.model.joint("drawer_top").qposadr[0]] = 0.15
    support, at = place(name)
    T_world_support = simulator.object_poses()[support]
    T_world_obj = T_world_support @ from_yaw(np.array(at), 0.0)
    put(simulator, moved(name), T_world_obj)
    assert is_done(simulator), simulator.touching(moved(name))
    # What was done alone is a part of two that were asked for.
    assert not any(COMBINATION_TASKS[name].is_done(simulator) for name in COMBINATION_TASKS.keys() - SINGLE)
    T_world_obj[2, 3] += 0.10
    simulator.put(moved(name), T_world_obj)
    assert not is_done(simulator)


def test_two_are_done_when_both_are(make_env):
    env = make_env("bottle_on_plate_then_box_on_stove")
    env._observe = dict
    env.reset(seed=TUNING_SEED_START)
    simulator, is_done = env.simulator, ANY_TASK[env.task].is_done
    for name in ("bottle_on_plate", "box_on_stove"):
        assert not is_done(simulator)
        support, at = place(name)
        put(simulator, moved(name), simulator.object_poses()[support] @ from_yaw(np.array(at), 0.0))
    assert is_done(simulator)


def test_no_expert_demonstrates_them(make_env):
    env = make_env("push_box_then_bottle_in_bowl")
    env._observe = dict
    with pytest.raises(
        ValueError, match="no expert for push_box, bottle_in_bowl, which is never demonstrated"
    ):
        run_expert(env, TUNING_SEED_START)
