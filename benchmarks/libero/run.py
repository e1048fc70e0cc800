"""`make libero`: collect, train and evaluate on one of LIBERO's suites; prints one JSON object last.

python -m benchmarks.libero.run --suite=libero_spatial --demos=10 --states=50 --tasks=0-9
python -m benchmarks.libero.run --suite=all

What is called the same looks otherwise in other scenes, as libero_10 has several. Each scene is learned by
itself, and what is evaluated is one policy, joined of all.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.harness import Row, checkpoint_files
from benchmarks.libero.accuracy import accuracy, found_errors
from benchmarks.libero.evaluate import SEED, STATES, evaluate_states, summary
from benchmarks.results import run, write
from benchmarks.stages import (
    DEMOS,
    LIBERO,
    RUNS,
    dataset,
    demonstrations_of,
    peak_mb,
    policy,
    run_folder,
)

from lerobot_openspm.cli.pipeline import THREADS, digest, discard_unless
from lerobot_openspm.envs.libero.simulator import OBJECTS, SUITE, scene_kind, tasks
from lerobot_openspm.envs.suites import find_suite
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.workplaces import folders, join

logger = logging.getLogger(__name__)

ALL = "all"


@dataclass
class RunConfig:
    """What `make libero` does. Finished stages are kept and not done again.

    Args:
        suite: One of LIBERO's, or "all" for one policy of all.
        demos: Demonstrations a task.
        states: Initial states a task to evaluate, from the first on.
        tasks: Numbers of the tasks of each suite, such as 0-9 or 0,3,5.
    """

    suite: str = SUITE
    demos: int = DEMOS
    states: int = STATES
    tasks: str = "0-9"

    def __post_init__(self) -> None:
        if self.suite not in (*OBJECTS, ALL):
            raise ValueError(f"SUITE is {self.suite!r}, expected one of {', '.join((*OBJECTS, ALL))}")
        self.selected()
        if not 1 <= self.states <= STATES or self.demos < 1:
            raise ValueError(
                f"STATES must be 1 to {STATES} and DEMOS at least 1, got {self.states}, {self.demos}"
            )

    def selected(self) -> dict[str, list[str]]:
        """The tasks by suite."""
        suites = list(OBJECTS) if self.suite == ALL else [self.suite]
        return {suite: select_tasks(self.tasks, suite) for suite in suites}


@dataclass(frozen=True)
class Part:
    """What was made of the tasks of one scene.

    Attributes:
        suite: The suite that they are of.
        tasks: The tasks.
        root: The dataset that their demonstrations are in.
        checkpoint: The policy of these tasks alone.
        seconds: That mining and training took; None if it was interrupted.
        peak_mb: The most memory that a process had meanwhile; None if that is not known.
    """

    suite: str
    tasks: Sequence[str]
    root: Path
    checkpoint: Path
    seconds: float | None
    peak_mb: int | None


def learned(
    selected: Mapping[str, Sequence[str]], demos: int = DEMOS, first: int | None = None
) -> tuple[Path, list[Part]]:
    """Record demonstrations of tasks and learn from them, where that was not done.

    Args:
        selected: The tasks by suite.
        demos: Demonstrations a task.
        first: Learn from so many of them, the first ones; all if not given.

    Returns:
        The checkpoint of all tasks, and the parts that it was joined of.

    Raises:
        OpenSPMError: No expert demonstrates one of the tasks.
    """
    parts = [part for suite, some in selected.items() for part in _parts(suite, demos, some, first)]
    if len(parts) == 1:
        return parts[0].checkpoint, parts
    if len(selected) == 1:
        folder = run_folder(LIBERO, demos, ",".join(*selected.values()))
    else:
        folder = RUNS[LIBERO] / ALL / f"demos_{demos}"
    output = folder / ("joined" if first is None else f"few_{first}_joined")
    paths = [part.checkpoint for part in parts]
    discard_unless(output, digest([file for path in paths for file in checkpoint_files(path)], []))
    if not output.exists():
        join(paths, output)
    return output, parts


def _parts(suite: str, demos: int, selected: Sequence[str], first: int | None) -> list[Part]:
    """What is learned of each scene. Scenes in which cameras and robot stand alike share a dataset."""
    names, shown = list(tasks(suite)), find_suite(LIBERO, suite).tasks("all")
    if unshown := [f"{names.index(task)} {task}" for task in selected if task not in shown]:
        known = ",".join(str(names.index(task)) for task in shown)
        raise OpenSPMError(
            f"no expert demonstrates {', '.join(unshown)} of {suite}, expected some of TASKS={known}"
        )
    parts: list[Part] = []
    for alike in _grouped(selected, scene_kind):
        logger.info("recording %d demonstrations of each of %d tasks of %s", demos, len(alike), suite)
        selection = ",".join(alike)
        root = dataset(LIBERO, demos, selection)
        recorded = demonstrations_of(root)
        scenes = _grouped(alike, scene)
        for own in scenes:
            logger.info("mining and training: %s", ", ".join(own))
            variant = "train" if first is None else f"few_{first}"
            if len(scenes) > 1:
                variant += f"_{scene(own[0])}"
            is_all = len(scenes) == 1 and first is None
            episodes = None if is_all else [n for task in own for n in recorded[task][:first]]
            made = policy(LIBERO, variant, root=root, selection=selection, episodes=episodes)
            parts.append(Part(suite, own, root, *made, peak_mb(made[0])))
    return parts


def _grouped(names: Sequence[str], key: Callable[[str], str]) -> list[list[str]]:
    """Tasks with the same key together, in the order of the first of each."""
    groups: dict[str, list[str]] = {}
    for task in names:
        groups.setdefault(key(task), []).append(task)
    return list(groups.values())


def scene(task: str) -> str:
    """Which scene a task of libero_10 is of, such as KITCHEN_SCENE4; "" where a suite has one."""
    found = re.match(r"[A-Z_]+SCENE\d+", task)
    return found[0] if found else ""


def main(config: RunConfig) -> dict[str, Any]:
    """Do what is missing. The whole suite from 50 states is written down as a published result."""
    checkpoint, parts = learned(config.selected(), config.demos)
    told = {suite: _evaluated(config, suite, checkpoint, parts) for suite in config.selected()}
    spent = learning(checkpoint, parts)
    if config.suite != ALL:
        return {**told[config.suite], **spent, "checkpoint": str(checkpoint)}
    if config.demos == DEMOS and all(some == list(tasks(suite)) for suite, some in config.selected().items()):
        about = {"seed": SEED, "demonstrations": DEMOS, "n": sum(one["n"] for one in told.values())}
        kept = ("success", "n", "interval", "mean_steps", "failures")
        rates = {suite: {key: one[key] for key in kept} for suite, one in told.items()}
        failed = [episode for one in told.values() for episode in one["failed"]]
        write("libero_all", {**about, **spent, "per_suite": rates, "failed": failed}, THREADS)
    return {**told, **spent, "checkpoint": str(checkpoint)}


def _evaluated(config: RunConfig, suite: str, checkpoint: Path, parts: Sequence[Part]) -> dict[str, Any]:
    """What the policy does in one suite."""
    selected = config.selected()[suite]
    logger.info("evaluating %d tasks of %s from %d initial states", len(selected), suite, config.states)
    single = len(parts) == 1
    folder = parts[0].root.with_name("evaluation") if single else checkpoint.with_name(f"evaluation_{suite}")
    episodes = evaluate_states(checkpoint, folder, config.states, selected, suite=suite)
    errors: list[dict[str, Any]] = []
    rows: list[Row] = []
    for part in (part for part in parts if part.suite == suite):
        own = [row for row in episodes if row["task"] in part.tasks]
        rows += own
        errors += found_errors(part.checkpoint, part.root, own)
    found = accuracy(rows, errors)
    figures = summary(rows, found.pop("found_off_mm"))
    worst = {(e["task"], e["state"]): off for e, off in zip(rows, found.pop("off_mm"), strict=True)}
    for failed in figures["failed"]:
        failed["off_mm"] = worst[failed["task"], failed["state"]]
    is_whole = config.demos == DEMOS and config.states == STATES and selected == list(tasks(suite))
    if is_whole and config.suite == suite:
        about = {"seed": SEED, "demonstrations": DEMOS}
        write(suite, {**about, **learning(checkpoint, parts), **figures}, THREADS)
        # Which way round the other suites' things look alike is not known, so their yaw is not judged.
        if suite == SUITE:
            write("libero_accuracy", {**about, "n": figures["n"], **found}, THREADS)
    kept = ("success", "n", "interval", "mean_steps", "failures", "failed")
    told = {key: figures[key] for key in kept}
    per_task = {task: row["success"] for task, row in figures["per_task"].items()}
    places = {key: found[key] for key in ("position_mm_mean", "position_mm_p95")}
    return {**told, "per_task": per_task, **places}


def learning(checkpoint: Path, parts: Sequence[Part]) -> dict[str, float | None]:
    """How long mining and training of all parts took, the most memory of a process, and what came of it.

    None where one was interrupted.
    """
    seconds = [part.seconds for part in parts if part.seconds is not None]
    peaks = [part.peak_mb for part in parts if part.peak_mb is not None]
    return {
        "mine_and_train_s": round(sum(seconds), 1) if len(seconds) == len(parts) else None,
        "peak_mb": max(peaks) if len(peaks) == len(parts) else None,
        **size(checkpoint),
    }


def size(checkpoint: Path) -> dict[str, float]:
    """How many entries and objects all workplaces of a checkpoint hold, and how large it is."""
    memories = [read_memory(folder) for folder in folders(checkpoint)]
    held = sum(path.stat().st_size for path in checkpoint.rglob("*") if path.is_file())
    return {
        "entries": sum(len(memory.entries) for memory in memories),
        "objects": sum(len(memory.objects) for memory in memories),
        "checkpoint_mb": round(held / 1e6, 2),
    }


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
