import numpy as np
import pytest
from tests.envs.helpers import run_expert

from lerobot_openspm.envs.tabletop import placement as layouts
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.tasks import TWO_BOWL_TASKS, select_tasks


@pytest.mark.parametrize("seeds", [range(5), pytest.param(range(5, 20), marks=pytest.mark.slow)], ids=str)
@pytest.mark.parametrize("name", TWO_BOWL_TASKS)
def test_layouts_keep_the_gap_and_are_clear_whichever_bowl_is_taken(name, seeds):
    is_clear = TWO_BOWL_TASKS[name].is_clear
    for seed in seeds:
        layout = layouts.sample_two_bowls(np.random.default_rng(seed), is_clear)
        second = layout.pop(scene.SECOND_BOWL)
        swapped = {**layout, "bowl": second}
        assert layouts.is_admissible(layout)
        assert layouts.is_admissible(swapped)
        assert is_clear({**layout, scene.SECOND_BOWL: second})
        assert not is_clear({**swapped, scene.SECOND_BOWL: layout["bowl"]})


def test_a_condition_that_no_layout_meets_ends_in_an_error(monkeypatch):
    monkeypatch.setattr(layouts, "MAX_TRIES", 20)
    with pytest.raises(layouts.LayoutError, match="no clear layout"):
        layouts.sample_two_bowls(np.random.default_rng(0), lambda layout: False)


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


def test_the_experts_of_the_ten_do_it_with_the_bowl_that_is_meant(make_env):
    info, _ = run_expert(make_env("bowl_next_to_rack_on_plate"), seed=3)
    assert info["is_success"]


def test_they_are_selected_by_name_and_not_among_all():
    assert select_tasks("two_bowls") == list(TWO_BOWL_TASKS)
    assert not set(TWO_BOWL_TASKS) & set(select_tasks("all"))
