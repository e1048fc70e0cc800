"""`make libero`: which tasks are learned together, and what is asked for wrongly."""

import pytest
from benchmarks.libero import run
from benchmarks.libero.run import ALL, RunConfig, scene

from lerobot_openspm.envs.libero.simulator import OBJECTS


@pytest.fixture(autouse=True)
def ten_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten tasks in every suite, whether LIBERO is installed or not."""
    monkeypatch.setattr(run, "tasks", lambda suite: {f"{suite}_{i}": "" for i in range(10)})


def test_all_suites_are_selected_at_once():
    selected = RunConfig(suite=ALL, tasks="0,2-3").selected()
    assert list(selected) == list(OBJECTS)
    assert all(names == [f"{suite}_{i}" for i in (0, 2, 3)] for suite, names in selected.items())


def test_the_tasks_of_a_scene_are_learned_together():
    assert scene("KITCHEN_SCENE4_put_the_black_bowl_in_the_drawer") == "KITCHEN_SCENE4"
    assert scene("LIVING_ROOM_SCENE10_put_the_mug_on_the_plate") == "LIVING_ROOM_SCENE10"
    assert scene("put_the_bowl_on_the_plate") == ""


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"suite": "libero_90"}, "expected one of libero_goal.*all"),
        ({"tasks": "0-10"}, "from 0 to 9"),
        ({"states": 51}, "STATES must be 1 to 50"),
        ({"demos": 0}, "DEMOS at least 1"),
    ],
)
def test_what_is_asked_for_wrongly_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        RunConfig(**options)
