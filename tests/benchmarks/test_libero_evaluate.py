"""LIBERO's harness keeps what it has measured, and never mixes it with anything else."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.harness import read
from benchmarks.libero import accuracy, run
from benchmarks.libero import evaluate as harness
from benchmarks.libero.evaluate import EvaluationConfig, evaluate, reason, summary

from benchmarks import stages
from lerobot_openspm.errors import OpenSPMError

TASKS = {name: name.replace("_", " ") for name in ("push_the_plate", "put_the_bowl", "turn_on_the_stove")}


def found_suite(_: str, selection: str = "all") -> SimpleNamespace:
    """Two suites of the same tasks."""
    return SimpleNamespace(
        name="libero_10" if selection == "libero_10" else "libero",
        tasks=lambda some: some.split(",") if some in ",".join(TASKS) else list(TASKS),
    )


@pytest.fixture(autouse=True)
def suite(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (harness, run):
        monkeypatch.setattr(module, "tasks", lambda _: TASKS)
    monkeypatch.setattr(harness, "suite_of", lambda _: harness.SUITE)
    for module in (stages, run):
        monkeypatch.setattr(module, "find_suite", found_suite)
    monkeypatch.setattr("benchmarks.harness.folders", lambda checkpoint: [checkpoint])


EPISODE = {"steps": 100, "status": "done", "phase": "retreat", "attempts": 0, "parts": [], "contacts": {}}


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Which episodes were run, in order."""
    found: list[tuple[str, int]] = []

    def run_one(_: EvaluationConfig, task: str, state: int):
        found.append((task, state))
        success = state != 1
        told = {"steps": 100 + state, "success": success, "status": "done", "phase": "retreat", "attempts": 0}
        told["parts"] = [{"attempts": 0, "seconds": 5.0}]
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
    assert figures["failed"][0]["parts"] == [{"attempts": 0, "seconds": 5.0}]
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


def test_tasks_that_no_expert_does_are_refused(monkeypatch: pytest.MonkeyPatch):
    shown = SimpleNamespace(tasks=lambda _: list(TASKS)[::2])
    monkeypatch.setattr(run, "find_suite", lambda *_: shown)
    message = "no expert demonstrates 1 put_the_bowl of libero_10, expected some of TASKS=0,2"
    with pytest.raises(OpenSPMError, match=message):
        run.main(run.RunConfig("libero_10", tasks="0-2"))


def test_another_suite_is_refused_by_name():
    with pytest.raises(ValueError, match="SUITE is 'tabletop', expected one of libero_goal, "):
        run.RunConfig("tabletop")


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
    assert stages.run_folder("libero", 3, ",".join(names)) == stages.run_folder("libero", 3)
    assert stages.run_folder("libero", 3, names[0]) != stages.run_folder("libero", 3, names[1])


def test_a_suite_has_a_folder_of_its_own():
    assert stages.run_folder("libero", 3) == Path("outputs/libero/demos_3")
    assert stages.run_folder("libero", 3, "libero_10") == Path("outputs/libero/libero_10/demos_3")


def made_up(calls: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins for recording, training and evaluating; which tasks each was called for is noted."""

    def recorded(_: str, demos: int, selection: str) -> Path:
        calls.append((demos, selection))
        return tmp_path / selection / "dataset"

    def policy(
        _: str, variant: str, root: Path, selection: str, episodes: list[int] | None = None
    ) -> tuple[Path, float]:
        calls.append((variant, episodes))
        return root.with_name(variant), 20.0

    monkeypatch.setattr(run, "scene_kind", lambda task: "kitchen" if "stove" in task else "living room")
    monkeypatch.setattr(run, "dataset", recorded)
    monkeypatch.setattr(run, "scene", lambda task: "SCENE1" if "bowl" in task else "SCENE2")
    monkeypatch.setattr(run, "demonstrations_of", lambda _: {task: [i] for i, task in enumerate(TASKS)})
    monkeypatch.setattr(run, "policy", policy)
    monkeypatch.setattr(run, "peak_mb", lambda path: 900 if path.name == "train_SCENE1" else 700)
    monkeypatch.setattr(
        run, "size", lambda path: {"entries": 7, "objects": 5, "checkpoint_mb": len(path.name)}
    )
    monkeypatch.setattr(run, "discard_unless", lambda *_: None)
    monkeypatch.setattr(run, "join", lambda paths, _: calls.append([path.name for path in paths]))
    monkeypatch.setattr(run, "found_errors", lambda _, __, rows: [{"plate": (0.03, None)} for _ in rows])
    monkeypatch.setattr(
        run,
        "evaluate_states",
        lambda checkpoint, _, states, names, suite: [
            {**EPISODE, "task": task, "state": i, "seed": harness.SEED + i, "success": i > 0}
            for task in names
            for i in range(states)
        ],
    )
    monkeypatch.setattr(accuracy, "suite_of", lambda _: "libero_10")
    monkeypatch.setattr(accuracy, "tasks", lambda _: TASKS)


def test_each_scene_is_learned_by_itself_and_one_policy_is_joined_and_evaluated(tmp_path, monkeypatch):
    calls, written = list[Any](), dict[str, Any]()
    made_up(calls, tmp_path, monkeypatch)
    monkeypatch.setattr(run, "write", lambda name, content, _: written.update({name: content}))
    told = run.main(run.RunConfig("libero_10", tasks="0-2"))
    assert calls == [
        (10, "push_the_plate,put_the_bowl"), ("train_SCENE2", [0]), ("train_SCENE1", [1]),
        (10, "turn_on_the_stove"), ("train", None), ["train_SCENE2", "train_SCENE1", "train"],
    ]  # fmt: skip
    assert told["checkpoint"].endswith("joined")
    assert (told["n"], told["mine_and_train_s"], told["position_mm_mean"]) == (150, 60.0, 30.0)
    # The largest of three trainings, and what was joined.
    assert (told["peak_mb"], told["checkpoint_mb"]) == (900, len("joined"))
    assert {key: written["libero_10"][key] for key in ("peak_mb", "entries", "objects")} == {
        "peak_mb": 900,
        "entries": 7,
        "objects": 5,
    }
    assert list(written) == ["libero_10"]
    assert [(one["task"], one["state"], one["off_mm"]) for one in written["libero_10"]["failed"]] == [
        (task, 0, 30.0) for task in TASKS
    ]
    run.main(run.RunConfig("libero_10", states=2, tasks="0-2"))
    run.main(run.RunConfig("libero_10", tasks="0,1"))
    assert len(written) == 1


def test_of_some_demonstrations_those_of_each_task_that_come_first_are_learned(tmp_path, monkeypatch):
    calls = list[Any]()
    made_up(calls, tmp_path, monkeypatch)
    monkeypatch.setattr(
        run, "demonstrations_of", lambda _: {task: [i, i + 3] for i, task in enumerate(TASKS)}
    )
    checkpoint, _ = run.learned({"libero_10": list(TASKS)}, first=1)
    trained = [call for call in calls if isinstance(call, tuple) and isinstance(call[0], str)]
    # Recorded are all, so the last one is told which to learn from as well.
    assert trained == [("few_1_SCENE2", [0]), ("few_1_SCENE1", [1]), ("few_1", [2])]
    assert checkpoint.name == "few_1_joined"


def test_of_all_suites_one_policy_is_published_with_the_rate_of_each(tmp_path, monkeypatch):
    calls, written = list[Any](), dict[str, Any]()
    made_up(calls, tmp_path, monkeypatch)
    monkeypatch.setattr(run, "OBJECTS", ("libero", "libero_10"))
    monkeypatch.setattr(run, "write", lambda name, content, _: written.update({name: content}))
    told = run.main(run.RunConfig("all", states=10, tasks="0-2"))
    assert Path(told["checkpoint"]).parts[-3:] == ("all", "demos_10", "joined")
    assert list(written) == ["libero_all"]
    assert (written["libero_all"]["n"], written["libero_all"]["seed"]) == (60, harness.SEED)
    assert (written["libero_all"]["peak_mb"], written["libero_all"]["entries"]) == (900, 7)
    assert {name: one["n"] for name, one in written["libero_all"]["per_suite"].items()} == {
        "libero": 30,
        "libero_10": 30,
    }
    per_suite, failed = written["libero_all"]["per_suite"], written["libero_all"]["failed"]
    assert len(failed) == sum(sum(one["failures"].values()) for one in per_suite.values()) > 0
    run.main(run.RunConfig("all", states=10, tasks="0"))
    assert len(written) == 1


def test_poses_of_two_that_a_task_is_about_are_not_compared():
    poses = dict.fromkeys(("bowl", "bowl_2", "moka_pot", "moka_pot_2"), np.eye(4))
    assert list(harness.without_several(poses, {"moka_pot", "moka_pot_2", "bowl"})) == ["bowl", "bowl_2"]
