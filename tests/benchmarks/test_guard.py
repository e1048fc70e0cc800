"""The guard's floors let a healthy build pass and catch one that got worse; its seeds are nobody else's."""

import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from benchmarks.guard import FALSE_ALARM, POWER, STANDARDS, GuardConfig, Standard
from benchmarks.libero import evaluate as harness
from scipy.stats import binom
from tests.memory.memories import a_memory

from benchmarks import guard
from lerobot_openspm.cli import pipeline
from lerobot_openspm.cli.pipeline import Episode, rate
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.memory.io import write_memory

ROOT = Path(__file__).parents[2]
STANDARD = Standard(expected=0.98, demos=1, episodes=8, seed=2_800_000)
TASKS = [f"task_{i}" for i in range(10)]


def runs(failures: dict[str, int]) -> list[Episode]:
    """Episodes of all tasks, the first so many of which fail."""
    return [
        Episode(task, STANDARD.seed + i, 100 + i, i >= failures.get(task, 0), "done")
        for task in TASKS
        for i in range(STANDARD.episodes)
    ]


@pytest.mark.parametrize("n", [1, 8, 20, 80])
@pytest.mark.parametrize("expected", [0.8, 0.95, 0.98])
@pytest.mark.parametrize("false_alarm", [0.01, 0.0005])
def test_the_floor_is_the_highest_that_a_healthy_build_passes(n: int, expected: float, false_alarm: float):
    lowest = guard.floor(n, expected, false_alarm)
    assert binom.cdf(lowest - 1, n, expected) <= false_alarm
    assert binom.cdf(lowest, n, expected) > false_alarm


def test_healthy_builds_pass_and_the_caught_rate_is_caught():
    """By drawing builds instead of summing the distribution."""
    rng, n_builds = np.random.default_rng(0), 20_000
    least = guard.floors(len(TASKS), STANDARD.episodes, STANDARD.expected)

    def below(rate: float) -> np.ndarray:
        successes = rng.binomial(STANDARD.episodes, rate, (n_builds, len(TASKS)))
        return np.stack([successes.sum(1) < least.total, (successes < least.task).any(1)])

    assert below(STANDARD.expected).any(0).mean() <= FALSE_ALARM
    n = len(TASKS) * STANDARD.episodes
    assert below(guard.caught(n, least.total))[0].mean() == pytest.approx(POWER, abs=0.01)
    one = rng.binomial(STANDARD.episodes, guard.caught(STANDARD.episodes, least.task), n_builds) < least.task
    assert one.mean() == pytest.approx(POWER, abs=0.01)


@pytest.mark.parametrize("suite", STANDARDS)
def test_what_is_said_of_the_floors_is_so(suite: str):
    n_task = STANDARDS[suite].episodes
    n = len(TASKS) * n_task
    least = guard.floors(len(TASKS), n_task, STANDARDS[suite].expected)
    assert least.task >= 1
    rate_of_all, rate_of_one = guard.caught(n, least.total), guard.caught(n_task, least.task)
    said = (
        f"{suite}: {least.total} of {n} episodes must succeed, {least.task} of {n_task} of each task. A "
        f"true rate of {rate_of_all:.3f} is caught with probability {POWER}, one of 0.935 with "
        f"{binom.cdf(least.total - 1, n, 0.935):.2f}, a single task's of {rate_of_one:.3f} with {POWER}."
    )
    assert said in " ".join(str(guard.__doc__).split())


def test_what_is_expected_follows_from_what_was_measured():
    assert STANDARDS["tabletop"].expected == pytest.approx(rate(230, 230)["interval"][0], abs=1e-3)
    assert STANDARDS["libero"].expected ** 20 == pytest.approx(0.5, abs=1e-2)


def test_what_lies_below_a_floor_is_named():
    figures, below = guard.verdict(runs({}), STANDARD)
    assert (figures["success"], figures["failed"], below) == (1.0, [], [])
    least = guard.floors(len(TASKS), STANDARD.episodes, STANDARD.expected)
    figures, below = guard.verdict(runs({"task_3": STANDARD.episodes - least.task}), STANDARD)
    assert below == []
    assert figures["failed"][0] == ["task_3", STANDARD.seed, "done"]
    _, below = guard.verdict(runs({"task_3": STANDARD.episodes - least.task + 1}), STANDARD)
    assert below == [
        f"task_3: {least.task - 1} of {STANDARD.episodes} episodes succeeded, at least {least.task} must"
    ]
    _, below = guard.verdict(runs(dict.fromkeys(TASKS, 1)), STANDARD)
    assert below == [f"70 of 80 episodes succeeded, at least {least.total} must"]


def test_the_verdict_is_the_exit_code(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    asked = []

    def suite(found: list[Episode]):
        return lambda standard, output: asked.append((standard, output)) or found

    monkeypatch.setitem(guard.STANDARDS, "tabletop", STANDARD)
    monkeypatch.setitem(guard.SUITES, "tabletop", suite(runs({})))
    guard.main(GuardConfig(output=str(tmp_path)))
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["success"] == 1
    assert asked == [(STANDARD, tmp_path / "tabletop")]
    monkeypatch.setitem(guard.SUITES, "tabletop", suite(runs({"task_1": 5})))
    with pytest.raises(SystemExit) as stop:
        guard.main(GuardConfig(output=str(tmp_path)))
    assert stop.value.code == 1
    out = capsys.readouterr().out
    assert "BELOW THE FLOOR: task_1: 3 of 8" in out
    assert f"    seed {STANDARD.seed}: failed after 100 steps, status 'done'" in out
    with pytest.raises(ValueError, match="--suite is 'robosuite', expected one of tabletop, libero"):
        GuardConfig(suite="robosuite")


def test_the_tabletops_episodes_are_those_of_the_demos_steps(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    done = []
    monkeypatch.setattr(pipeline, "collect_dataset", lambda *given: done.append(given))
    monkeypatch.setattr(pipeline, "train", lambda *given: done.append(given) or (tmp_path / "trained", 1.0))
    episode = pipeline.Episode("push_plate", STANDARD.seed, 212, False, "time_limit")
    monkeypatch.setattr(pipeline, "evaluate", lambda *given: done.append(given) or [episode])
    assert guard.tabletop(STANDARD, tmp_path) == [episode]
    assert done == [
        (tmp_path / "dataset", STANDARD.demos),
        (tmp_path / "dataset", tmp_path / "train"),
        (tmp_path / "trained", tmp_path / "evaluation", STANDARD.episodes, STANDARD.seed),
    ]


@pytest.mark.libero
def test_liberos_scenes_are_drawn_from_the_guards_own_seeds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    collected, jobs = [], []
    checkpoint = tmp_path / "trained"
    checkpoint.mkdir()
    write_memory(a_memory(), checkpoint)
    for name in ("model.safetensors", "config.json"):
        (checkpoint / name).write_text(name)

    def run_one(config: harness.EvaluationConfig, task: str, state: int):
        jobs.append((config.tuning, config.tuning_seed + state))
        told = {"steps": 90, "success": state == 0, "status": "done", "phase": "retreat"}
        return {"task": task, "state": state, "seed": config.tuning_seed + state, **told}

    monkeypatch.setattr(pipeline, "collect_dataset", lambda *given: collected.append(given))
    monkeypatch.setattr(guard.stages, "policy", lambda simulator, root: (checkpoint, 1.0))
    monkeypatch.setattr(harness, "tasks", lambda _: {"push_the_plate": "push the plate"})
    monkeypatch.setattr(harness, "evaluate_one", run_one)
    monkeypatch.setattr(harness, "EvaluationConfig", partial(harness.EvaluationConfig, workers=1))
    standard = Standard(expected=0.95, demos=1, episodes=2, seed=STANDARDS["libero"].seed)
    reason = "every key pose was met, but the goal does not hold"
    assert guard.libero(standard, tmp_path) == [
        Episode("push_the_plate", standard.seed, 90, True, reason),
        Episode("push_the_plate", standard.seed + 1, 90, False, reason),
    ]
    assert jobs == [(True, standard.seed), (True, standard.seed + 1)]
    assert collected == [(tmp_path / "dataset", 1, "libero")]


def test_its_seeds_are_tuning_seeds_that_nobody_else_uses():
    own = [range(s.seed, s.seed + s.episodes) for s in STANDARDS.values()]
    assert all(TUNING_SEED_START <= seed < 3_000_000 for seeds in own for seed in seeds)
    assert set(own[0]).isdisjoint(own[1])
    folders = ("src", "tests", "benchmarks", "examples", "scripts", "docs")
    files = [
        path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".md")
    ]
    others = {Path(__file__), ROOT / "benchmarks/guard.py"}
    numbers = {
        int(found.replace("_", "").replace(",", ""))
        for path in files
        if path not in others
        for found in re.findall(r"\b2[_,]?[0-9]{3}[_,]?[0-9]{3}\b", path.read_text(encoding="utf-8"))
    }
    assert not [seed for seed in numbers if any(seed in seeds for seeds in own)]
