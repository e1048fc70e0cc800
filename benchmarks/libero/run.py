"""`make libero`: collect, train and evaluate on one of LIBERO's suites; prints one JSON object last.

python -m benchmarks.libero.run --suite=libero_spatial --demos=10 --states=50 --tasks=0-9

Where cameras and robot stand elsewhere in some tasks, as in libero_10, each kind of scene gets a policy of
its own.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.harness import Row
from benchmarks.libero.accuracy import accuracy, found_errors
from benchmarks.libero.evaluate import SEED, STATES, evaluate_states, summary
from benchmarks.results import run, write
from benchmarks.stages import DEMOS, LIBERO, dataset, policy

from lerobot_openspm.cli.pipeline import THREADS
from lerobot_openspm.envs.libero.simulator import OBJECTS, SUITE, scene_kind, tasks
from lerobot_openspm.envs.suites import find_suite
from lerobot_openspm.errors import OpenSPMError

logger = logging.getLogger(__name__)


@dataclass
class RunConfig:
    """What `make libero` does. Finished stages are kept and not done again.

    Args:
        suite: One of LIBERO's.
        demos: Demonstrations a task.
        states: Initial states a task to evaluate, from the first on.
        tasks: Numbers of the tasks, such as 0-9 or 0,3,5.
    """

    suite: str = SUITE
    demos: int = DEMOS
    states: int = STATES
    tasks: str = "0-9"

    def __post_init__(self) -> None:
        if self.suite not in OBJECTS:
            raise ValueError(f"SUITE is {self.suite!r}, expected one of {', '.join(OBJECTS)}")
        select_tasks(self.tasks, self.suite)
        if not 1 <= self.states <= STATES or self.demos < 1:
            raise ValueError(
                f"STATES must be 1 to {STATES} and DEMOS at least 1, got {self.states}, {self.demos}"
            )


@dataclass(frozen=True)
class Part:
    """What was made of the tasks of one kind of scene.

    Attributes:
        root: Their demonstrations.
        checkpoint: The policy.
        seconds: That mining and training took; None if it was interrupted.
    """

    tasks: Sequence[str]
    root: Path
    checkpoint: Path
    seconds: float | None


def learned(suite: str, demos: int, selected: Sequence[str]) -> list[Part]:
    """Record demonstrations of tasks and learn from them, where that was not done.

    Raises:
        OpenSPMError: No expert demonstrates one of them.
    """
    names, shown = list(tasks(suite)), find_suite(LIBERO, suite).tasks("all")
    if unshown := [f"{names.index(task)} {task}" for task in selected if task not in shown]:
        known = ",".join(str(names.index(task)) for task in shown)
        raise OpenSPMError(
            f"no expert demonstrates {', '.join(unshown)} of {suite}, expected some of TASKS={known}"
        )
    by_kind: dict[str, list[str]] = {}
    for task in selected:
        by_kind.setdefault(scene_kind(task), []).append(task)
    parts: list[Part] = []
    for alike in by_kind.values():
        logger.info("recording %d demonstrations of each of %d tasks of %s", demos, len(alike), suite)
        root = dataset(LIBERO, demos, ",".join(alike))
        logger.info("mining and training")
        parts.append(Part(alike, root, *policy(LIBERO, root=root, selection=",".join(alike))))
    return parts


def main(config: RunConfig) -> dict[str, Any]:
    """Do what is missing. The whole suite from 50 states is written down as a published result."""
    selected = select_tasks(config.tasks, config.suite)
    episodes: list[Row] = []
    errors: list[dict[str, Any]] = []
    parts = learned(config.suite, config.demos, selected)
    for part in parts:
        logger.info("evaluating %d tasks from %d initial states", len(part.tasks), config.states)
        folder = part.root.with_name("evaluation")
        rows = evaluate_states(part.checkpoint, folder, config.states, part.tasks, suite=config.suite)
        episodes += rows
        errors += found_errors(part.checkpoint, part.root, rows)
    found = accuracy(episodes, errors)
    figures = summary(episodes, found.pop("found_off_mm"))
    worst = {(e["task"], e["state"]): off for e, off in zip(episodes, found.pop("off_mm"), strict=True)}
    for failed in figures["failed"]:
        failed["off_mm"] = worst[failed["task"], failed["state"]]
    seconds = [part.seconds for part in parts if part.seconds is not None]
    timing = {"mine_and_train_s": round(sum(seconds), 1) if len(seconds) == len(parts) else None}
    if config.demos == DEMOS and config.states == STATES and selected == list(tasks(config.suite)):
        about = {"seed": SEED, "demonstrations": DEMOS}
        write(config.suite, {**about, **timing, **figures}, THREADS)
        # Which way round the other suites' things look alike is not known, so their yaw is not judged.
        if config.suite == SUITE:
            write("libero_accuracy", {**about, "n": figures["n"], **found}, THREADS)
    told = {key: figures[key] for key in ("success", "n", "mean_steps")}
    per_task = {task: row["success"] for task, row in figures["per_task"].items()}
    places = {key: found[key] for key in ("position_mm_mean", "position_mm_p95")}
    checkpoints = ", ".join(str(part.checkpoint) for part in parts)
    return {**told, "per_task": per_task, **timing, **places, "checkpoint": checkpoints}


def select_tasks(selection: str, suite: str = SUITE) -> list[str]:
    """Tasks of a suite by their numbers: "0-9", or "0,3,5-6".

    Raises:
        ValueError: There is no such task.
    """
    names = list(tasks(suite))
    chosen: list[int] = []
    for part in selection.split(","):
        first, dash, last = part.strip().partition("-")
        last = last if dash else first
        numbers = first.isdecimal() and last.isdecimal()
        if not numbers or not int(first) <= int(last) < len(names):
            raise ValueError(
                f"TASKS must be numbers and ascending ranges from 0 to {len(names) - 1}, like 0-9 or 0,3,5, "
                f"got {selection}; they stand for {', '.join(f'{i} {name}' for i, name in enumerate(names))}"
            )
        chosen += range(int(first), int(last) + 1)
    return [names[i] for i in dict.fromkeys(chosen)]


if __name__ == "__main__":
    run(RunConfig, main)
