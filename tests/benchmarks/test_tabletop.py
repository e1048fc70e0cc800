"""What the tabletop's comparisons keep as figures; their stages are stood in for."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.anywhere import _without, look, right_places, summarise
from benchmarks.results import PROVENANCE
from benchmarks.tabletop import TabletopConfig, main
from benchmarks.worlds import tabletop as tabletop_world

from benchmarks import results, stages, tabletop
from lerobot_openspm.cli.pipeline import THREADS, Episode
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.tasks import SELECTIONS

EPISODES = [Episode("a", 1000, 100, True, "done"), Episode("b", 1000, 300, False, "no_progress")]


@pytest.fixture(autouse=True)
def _stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    monkeypatch.setattr(results, "is_published", lambda *_: True)
    monkeypatch.setattr(results, "_threads", lambda: 7)

    def collect(root: Path, *_: Any) -> dict[str, Any]:
        root.mkdir(parents=True, exist_ok=True)
        return {"frames": 200, "episodes": 2}

    for module in (tabletop, stages):
        monkeypatch.setattr(module, "collect_dataset", collect)
    monkeypatch.setattr(stages, "train", lambda *_: (Path("checkpoint"), None))
    monkeypatch.setattr(tabletop, "evaluate", lambda *_, **__: EPISODES)
    monkeypatch.setattr(tabletop, "looks", lambda *_: {"looks": 70})


def test_the_policy_as_it_is_keeps_its_figures():
    kept = main(TabletopConfig())
    assert set(PROVENANCE) <= set(kept)
    assert (kept["success"], kept["n"], kept["seed"], kept["demonstrations"]) == (0.5, 2, 1000, 10)
    assert kept["per_task"] == {"a": 1.0, "b": 0.0}
    assert kept["machine"]["threads"] == THREADS
    # How long a training took that was resumed is not known; the whole took as long as it took.
    assert kept["train_s"] is None
    assert kept["total_s"] >= 0
    # Now all stages are kept.
    assert main(TabletopConfig())["total_s"] is None


@pytest.mark.parametrize(
    ("name", "runs", "seed"),
    [
        ("execution", ["closed_loop_trc", "closed_loop", "open_loop"], 1000),
        ("oracle", ["oracle"], 1000),
        ("conditioning", ["equivariant", "paper"], 1000),
        ("combinations", ["combinations"], 17_000),
        ("preconditions", ["preconditions"], 24_000),
        ("two_bowls", ["two_bowls"], 11_000),
        ("anywhere", ["anywhere"], 14_000),
    ],
)
def test_a_comparison_keeps_all_its_runs(name: str, runs: list[str], seed: int, tmp_path: Path):
    main(TabletopConfig(name))
    kept = json.loads((tmp_path / f"{name}.json").read_text())
    assert set(PROVENANCE) <= set(kept)
    assert list(kept["runs"]) == runs
    assert (kept["n"], kept["seed"]) == (2, seed)
    assert kept["machine"]["threads"] == THREADS
    assert kept["runs"][runs[0]]["failed"] == [["b", 1000, "no_progress"]]


def test_of_new_combinations_there_are_ten_scenes_each(monkeypatch: pytest.MonkeyPatch):
    asked = []
    monkeypatch.setattr(tabletop, "evaluate", lambda *a, **b: asked.append((*a[2:], b["tasks"])) or EPISODES)
    told = main(TabletopConfig("combinations"))["instructions"]
    assert asked == [(10, 17_000, SELECTIONS["combinations"])]
    assert list(told) == list(SELECTIONS["combinations"])
    assert len(set(told.values())) == 20


def test_of_each_task_with_a_drawer_that_is_shut_unsaid_there_are_fifteen_scenes(monkeypatch):
    asked = []
    monkeypatch.setattr(tabletop, "evaluate", lambda *a, **b: asked.append((*a[2:], b["tasks"])) or EPISODES)
    told = main(TabletopConfig("preconditions"))["instructions"]
    ((scenes, seed, tasks),) = asked
    assert (scenes, seed, tasks) == (15, 24_000, tuple(told))
    assert scenes * len(tasks) >= 50
    assert all("drawer" in one and "open" not in one for one in told.values())
    silent = [
        name
        for name, text in main(TabletopConfig("combinations"))["instructions"].items()
        if "drawer" in text and "open" not in text
    ]
    assert list(told) == silent


def test_an_unknown_comparison_is_refused():
    with pytest.raises(ValueError, match="comparison is 'weather', expected one of tabletop, execution"):
        TabletopConfig("weather")


def test_what_was_taken_away_is_put_back_even_where_the_look_fails():
    at, put = np.eye(4), []
    simulator = SimpleNamespace(put=lambda name, T: put.append((name, T[0, 3])))
    world: Any = SimpleNamespace(
        env=SimpleNamespace(simulator=simulator), object_poses=lambda: {"bowl": at.copy()}
    )
    with pytest.raises(ValueError, match="blind"), _without(world, "bowl"):
        raise ValueError("blind")
    assert put == [("bowl", 5.0), ("bowl", 0.0)]


def test_a_first_look_anywhere_tells_of_all_that_stands_there_and_of_what_was_taken_away(
    checkpoint: Path, tiny_dataset: Path
):
    row = look(checkpoint, tiny_dataset, "bowl_on_plate_anywhere", 410020)
    assert row["drawn"] >= row["tried"] >= 1
    found = {name: (needed, metres) for name, needed, _, _, metres, _ in row["found"]}
    assert {name for name, (needed, _) in found.items() if needed} == {"bowl", "plate"}
    assert found["plate"][1] < 0.02
    # There are two bowls; of the others each was taken away once.
    assert [name for name, _, _ in row["gone"]] == ["plate"]


@pytest.mark.parametrize(("task", "bowls"), [("turn_on_stove_anywhere", 2), ("bowl_on_plate_anywhere", 1)])
def test_either_of_two_is_right_only_where_the_task_does_not_name_them(task: str, bowls: int):
    with tabletop_world(task, 410020) as world:
        right = right_places(world, {"bowl": np.eye(4), "plate": np.eye(4)})
        first, second = (world.env.simulator.data.body(name).xpos for name in ("bowl", scene.second("bowl")))
    assert len(right["plate"]) == 1
    assert np.linalg.norm(first - second) > 0.05
    np.testing.assert_allclose([T[:3, 3] for T in right["bowl"]], [first, second][:bowls], atol=1e-9)


def test_first_looks_tell_errors_false_finds_and_whether_confidence_holds():
    row = {
        # Object, needed, its yaw shows, confidence, metres, radians.
        "found": [
            ["bowl", True, False, 0.99, 0.002, 1.0],
            ["stove", True, True, 0.99, 0.004, 0.5],
            ["rack", False, True, 0.90, None, None],
            ["cabinet", False, True, 0.90, 0.003, 3.0],
        ],
        "gone": [["plate", False, 0.0], ["box", True, 0.97], ["cup", True, 0.80]],
        "drawn": 5,
        "tried": 2,
    }
    told = summarise([row])
    # Three do not show which one is meant; of the other two the expert solves the last one.
    assert told["layouts"] == {"drawn": 5, "hidden": 3, "unsolved": 1}
    assert told["poses"]["position_mm_mean"] == 3.0
    assert (told["poses"]["unknown"], told["poses"]["turned_round"]) == (1, 1)
    assert told["poses_needed"]["turned_round"] == 0
    assert told["poses_needed"]["yaw_deg_mean"] == round(float(np.rad2deg(0.5)), 2)
    assert (told["false_finds"]["success"], told["false_finds"]["n"]) == (2 / 3, 3)
    # The bowl is right; the stove is turned, and the box is not there.
    assert (told["confident_and_right"]["success"], told["confident_and_right"]["n"]) == (1 / 3, 3)
