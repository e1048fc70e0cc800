import itertools

import numpy as np
import pytest
from tests.envs.helpers import run_expert

from lerobot_openspm.envs.tabletop import placement as layouts
from lerobot_openspm.envs.tabletop import scene, settings
from lerobot_openspm.envs.tabletop.anywhere import MIDDLE, RANGE_M, sample_anywhere
from lerobot_openspm.envs.tabletop.settings import Setting
from lerobot_openspm.envs.tabletop.tasks import ANYWHERE_TASKS, TWO_BOWL_TASKS, select_tasks


@pytest.mark.parametrize("seeds", [range(5), pytest.param(range(5, 20), marks=pytest.mark.slow)], ids=str)
@pytest.mark.parametrize("name", TWO_BOWL_TASKS)
def test_layouts_keep_the_gap_and_are_clear_whichever_bowl_is_taken(name, seeds):
    is_clear = TWO_BOWL_TASKS[name].setting.is_clear
    for seed in seeds:
        layout = layouts.sample_with_second(np.random.default_rng(seed), "bowl", is_clear)
        second = layout.pop(scene.second("bowl"))
        swapped = {**layout, "bowl": second}
        assert layouts.is_admissible(layout)
        assert layouts.is_admissible(swapped)
        assert is_clear({**layout, scene.second("bowl"): second}, "bowl")
        assert not is_clear({**swapped, scene.second("bowl"): layout["bowl"]}, "bowl")


def test_a_condition_that_no_layout_meets_ends_in_an_error(monkeypatch):
    monkeypatch.setattr(layouts, "MAX_TRIES", 20)
    with pytest.raises(layouts.LayoutError, match="no clear layout"):
        layouts.sample_with_second(np.random.default_rng(0), "bowl", lambda layout, name: False)


def test_an_anywhere_condition_that_no_layout_meets_ends_in_an_error(monkeypatch):
    monkeypatch.setattr("lerobot_openspm.envs.tabletop.anywhere.MAX_TRIES", 3)
    setting = Setting("bowl", lambda layout, name: False, is_anywhere=True)
    with pytest.raises(layouts.LayoutError, match="no clear layout for turn_on_stove"):
        sample_anywhere(np.random.default_rng(0), setting, ["turn_on_stove"])


@pytest.mark.parametrize("name", ANYWHERE_TASKS)
def test_everything_stands_anywhere_around_the_middle_and_apart(name):
    task = ANYWHERE_TASKS[name]
    drawn = [sample_anywhere(np.random.default_rng(seed), task.setting, task.parts) for seed in range(6, 10)]
    for layout in drawn:
        assert set(layout) == {*scene.OBJECT_NAMES, scene.second(task.setting.twin), *scene.DISTRACTOR_NAMES}
        assert all(
            abs(at.x - MIDDLE[0]) <= RANGE_M and abs(at.y - MIDDLE[1]) <= RANGE_M for at in layout.values()
        )
        assert task.setting.is_clear(layout, task.setting.twin)
        discs = [
            layouts.footprint_discs(one, at) for one, at in layout.items() if one not in layouts.FIXTURES
        ]
        assert not any(layouts.too_close(a, b, 0.0) for a, b in itertools.combinations(discs, 2))
    assert np.ptp([layout["cabinet"].yaw for layout in drawn]) > np.deg2rad(60)


def test_left_and_right_are_told_for_any_object_that_stands_there_twice():
    layout = {"box": layouts.Placement(0, -0.2, 0), scene.second("box"): layouts.Placement(0, 0.2, 0)}
    assert settings.left(layout, "box")
    assert not settings.right(layout, "box")


def test_two_bowls_are_there_and_the_true_poses_are_those_of_the_objects_as_ever(make_env):
    env = make_env("left_bowl_on_plate", masks=True)
    observation, _ = env.reset(seed=3)
    assert tuple(env.simulator.object_poses()) == scene.OBJECT_NAMES
    one = make_env("bowl_on_plate", masks=True)
    alone, _ = one.reset(seed=3)
    area = [
        np.count_nonzero(seen["masks.front"] == scene.OBJECT_LABELS["bowl"]) for seen in (observation, alone)
    ]
    assert area[0] > 1.5 * area[1]


@pytest.mark.parametrize("name", ["bowl_next_to_rack_on_plate", "bottle_on_rack_anywhere"])
def test_the_experts_of_the_ten_do_it_with_the_one_that_is_meant(make_env, name):
    info, _ = run_expert(make_env(name), seed=3)
    assert info["is_success"]


def test_an_episode_anywhere_begins_as_it_was_drawn_and_the_same_from_the_same_seed(make_env):
    env = make_env("box_in_bowl_anywhere")
    poses = []
    for _ in range(2):
        env.reset(seed=5)
        assert np.allclose(env.simulator.ee_pose()[:3, 3], scene.HOME_POSITION, atol=0.01)
        assert min(env.simulator.shown_share(name) for name in ("box", "second_box")) >= 0.5
        poses.append(env.object_pose_vector())
    assert np.array_equal(*poses)


def test_what_stands_behind_the_cabinet_is_not_shown(make_env):
    env = make_env()
    env.reset(seed=0)
    simulator = env.simulator
    at = layouts.Placement(0.0, 0.0, 0.0)
    spread = {name: layouts.Placement(0.3, 0.3 - 0.1 * i, 0) for i, name in enumerate(scene.OBJECT_NAMES)}
    simulator.reset({**spread, "cabinet": at})
    assert simulator.shown_share("cabinet") > 0.1
    inside = np.eye(4)
    inside[:3, 3] = (0.0, 0.0, 0.08)
    simulator.put("box", inside)
    assert simulator.shown_share("box") == 0.0


def test_they_are_selected_by_name_and_not_among_all():
    assert select_tasks("two_bowls") == list(TWO_BOWL_TASKS)
    assert select_tasks("anywhere") == list(ANYWHERE_TASKS)
    assert not {*TWO_BOWL_TASKS, *ANYWHERE_TASKS} & set(select_tasks("all"))
