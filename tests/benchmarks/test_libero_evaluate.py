"""LIBERO's harness keeps what it has measured, and never mixes it with anything else."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from benchmarks.harness import read
from benchmarks.libero import evaluate as harness
from benchmarks.libero import run
from benchmarks.libero.evaluate import EvaluationConfig, evaluate, reason, summary

from benchmarks import stages

TASKS = {name: name.replace("_", " ") for name in ("push_the_plate", "put_the_bowl", "turn_on_the_stove")}


@pytest.fixture(autouse=True)
def suite(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (harness, run):
        monkeypatch.setattr(module, "tasks", lambda: TASKS)
    monkeypatch.setattr(stages, "find_suite", lambda _: SimpleNamespace(tasks=lambda _: list(TASKS)))


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Which episodes were run, in order."""
    found: list[tuple[str, int]] = []

    def run_one(_: EvaluationConfig, task: str, state: int):
        found.append((task, state))
        success = state != 1
        told = {"steps": 100 + state, "success": success, "status": "done", "phase": "retreat", "attempts": 0}
        contacts = {"plate": 12.0 * state} if task == "put_the_bowl" else {}
        return {"task": task, "state": state, "seed": harness.SEED + state, **told, "contacts": contacts}

    monkeypatch.setattr(harness, "evaluate_one", run_one)
    return found


@pytest.fixture
def config(tmp_path: Path) -> EvaluationConfig:
    checkpoint = tmp_path / "checkpoint"
    checkpoint.mkdir()
    for name in ("model.safetensors", "memory.json", "config.json"):
        (checkpoint / name).write_text(name)
    return EvaluationConfig(str(checkpoint), str(tmp_path / "episodes"), episodes=2, workers=1)


def log(config: EvaluationConfig) -> Path:
    return Path(config.output) / "episodes.jsonl"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"suite": "libero_goal_swop"}, "suite is 'libero_goal_swop', expected one of libero_goal, "),
        ({"suite": "libero_goal_object", "tuning": True}, "not for libero_goal_object"),
    ],
)
def test_scenes_that_there_are_none_of_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        EvaluationConfig("checkpoint", "episodes", **options)


def test_every_task_and_state_is_run_once(config, ran):
    episodes = evaluate(config)
    assert ran == [(task, state) for task in TASKS for state in (0, 1)]
    assert evaluate(config) == episodes
    assert len(ran) == 6


def test_an_interrupted_run_goes_on_where_it_stopped(config, ran):
    whole = evaluate(config)
    lines = log(config).read_text().splitlines(keepends=True)
    # The fifth episode was being written when the run was killed.
    log(config).write_text("".join(lines[:4]) + lines[4][:20])
    del ran[:]
    assert evaluate(config) == whole
    assert ran == [("turn_on_the_stove", 0), ("turn_on_the_stove", 1)]
    assert [row["state"] for row in read(log(config)).values()] == [0, 1] * 3


@pytest.mark.parametrize("change", ["policy", "settings"])
def test_episodes_of_something_else_are_run_again(config, ran, change):
    evaluate(config)
    if change == "policy":
        (Path(config.checkpoint) / "memory.json").write_text("other")
    else:
        config.execution = "open_loop"
    evaluate(config)
    assert len(ran) == 12


def test_tasks_may_be_chosen_and_unknown_ones_are_refused(config, ran):
    config.task = "put_the_bowl"
    evaluate(config)
    assert ran == [("put_the_bowl", 0), ("put_the_bowl", 1)]
    config.task = "fly"
    with pytest.raises(ValueError, match="no tasks"):
        evaluate(config)


def test_the_summary_counts_and_says_why(config, ran):
    figures = summary(evaluate(config))
    assert (figures["success"], figures["n"], figures["mean_steps"]) == (0.5, 6, 100.0)
    bowl = figures["per_task"]["put_the_bowl"]
    assert (bowl["success"], bowl["touched"], bowl["moved"]) == (0.5, 1.0, 0.5)
    assert (figures["touched"], figures["moved"]) == (0.3333, 0.1667)
    assert {(one["task"], one["state"], one["seed"]) for one in figures["failed"]} == {
        (task, 1, harness.SEED + 1) for task in TASKS
    }
    assert "goal does not hold" in figures["failed"][0]["reason"]
    assert {one["kind"] for one in figures["failed"]} == {"placing"}
    assert (figures["failures"]["grasp"], figures["failures"]["placing"]) == (0, 3)


@pytest.mark.parametrize(
    ("status", "words"),
    [("no_progress", "gave up at lift"), ("running", "time was up at lift"), ("infeasible", "infeasible")],
)
def test_reasons(status, words):
    assert reason({"status": status, "phase": "lift"}) == words


def test_what_a_refusal_is_about_is_told_with_it():
    refused = {"status": "object_not_found", "phase": None, "refusal": "no bowl is seen"}
    assert reason(refused) == "object not found: no bowl is seen"


@pytest.mark.parametrize(
    ("selection", "expected"), [("0-2", [0, 1, 2]), ("2,0", [2, 0]), ("1,0-1", [1, 0]), (" 1 ", [1])]
)
def test_tasks_are_selected_by_number(selection, expected):
    assert run.select_tasks(selection) == [list(TASKS)[i] for i in expected]


@pytest.mark.parametrize("selection", ["", "3", "2-1", "a", "0-", "-1", "0,,1"])
def test_numbers_that_are_no_tasks_are_refused(selection):
    with pytest.raises(ValueError, match="TASKS must be numbers"):
        run.select_tasks(selection)


def test_fewer_demonstrations_are_the_first_of_every_task(tmp_path):
    episodes = [{"task": task} for task in TASKS for _ in range(3)]
    (tmp_path / "meta").mkdir()
    (tmp_path / stages.SUMMARY_FILE).write_text(json.dumps({"episodes": episodes}))
    assert stages.first_episodes(tmp_path, 2) == [0, 1, 3, 4, 6, 7]
    assert stages.first_episodes(tmp_path, 1, without="put_the_bowl") == [0, 6]


def test_a_part_of_the_suite_has_a_folder_of_its_own():
    names = list(TASKS)
    assert stages.run_folder("libero", 3, names) == stages.run_folder("libero", 3)
    assert stages.run_folder("libero", 3, names[:1]) != stages.run_folder("libero", 3, names[1:2])
