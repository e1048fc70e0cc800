"""How often a task succeeds that was only taught, to a policy that was trained on the other tasks.

    python -m benchmarks.teach

For every task of the tabletop a policy is trained on the demonstrations of the nine others; the task's first
demonstrations in the dataset are then taught to it, and it is evaluated on that task.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.episodes import load, run_episode
from benchmarks.harness import Row, measured_folder, resume
from benchmarks.results import run, write
from benchmarks.stages import (
    TABLETOP,
    DatasetOption,
    EpisodesConfig,
    dataset,
    demonstrations_of,
    first_episodes,
)
from benchmarks.worlds import tabletop
from lerobot_openspm.cli.pipeline import REPO_ID, THREADS, Episode, success, train
from lerobot_openspm.errors import DatasetError, OpenSPMError
from lerobot_openspm.memory.io import write_memory
from lerobot_openspm.mining.dataset import dataset_metadata

DEMOS = (1, 3)
NOT_TAUGHT = "not_taught"
# Of lerobot-train, beside those of the configuration.
OPTIONS: tuple[str, ...] = ()


@dataclass
class TeachConfig(EpisodesConfig):
    """Measure teaching on the tabletop; as many episodes for each number of demonstrations.

    Args:
        dataset: The demonstrations.
        output: Folder for policies and what is measured.
    """

    dataset: DatasetOption = field(default_factory=DatasetOption)
    seed: int = 9000  # no other rate was taken on these
    output: str = "outputs/bench/teach"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.env.type != TABLETOP:
            raise ValueError(f"teaching is measured on {TABLETOP}, got env.type={self.env.type}")


def main(config: TeachConfig) -> dict[str, Any]:
    """Train, teach, evaluate, each only where that is not done; write and return the result."""
    root = Path(config.dataset.root) if config.dataset.root else dataset(TABLETOP)
    tasks = config.env.tasks()
    check(root, tasks)
    folder = measured_folder(Path(config.output), [root / "meta/info.json"], [str(root)], __file__)
    taught = {(task, demos): folder / f"taught_{task}_{demos}" for task in tasks for demos in DEMOS}
    nine = {task: train_without(root, task, folder / f"without_{task}") for task in tasks}
    lessons = resume(
        folder / "lessons.jsonl",
        {path.name: (nine[task], root, task, demos, path) for (task, demos), path in taught.items()},
        teach,
        workers=1,  # because it is timed
    )
    errors = {(row["task"], row["demonstrations"]): row["error"] for row in lessons}
    jobs = {
        f"{taught[task, demos].name} {seed}": (taught[task, demos], errors[task, demos], task, demos, seed)
        for task, seed in config.turns()
        for demos in DEMOS
    }
    rows = resume(folder / "episodes.jsonl", jobs, taught_episode, config.workers)
    return write("teach", {"seed": config.seed, **summarise(rows, lessons)}, THREADS)


def check(root: Path, tasks: Sequence[str]) -> None:
    """Refuse demonstrations that are too few, before anything is trained."""
    numbers = demonstrations_of(root)
    for task in tasks:
        if len(numbers.get(task, ())) < max(DEMOS):
            raise DatasetError(
                f"{root} holds {len(numbers.get(task, ()))} demonstrations of {task}, expected at least "
                f"{max(DEMOS)}; record more: openspm collect --episodes=10"
            )


def train_without(root: Path, task: str, folder: Path) -> Path:
    """A policy that is trained on all tasks but one, unless it is there."""
    others = json.dumps(first_episodes(root, len(demonstrations_of(root)[task]), without=task))
    chosen = (f"--dataset.episodes={others}", f"--policy.memory_episodes={others}")
    return train(root, folder, (*chosen, *OPTIONS))[0]


def teach(policy: Path, root: Path, task: str, demos: int, folder: Path, repo_id: str = REPO_ID) -> Row:
    """Teach the first demonstrations of a task.

    Returns:
        ``seconds`` from loading the checkpoint to having saved the memory, and ``error``, None or what went
        wrong. The folder holds the taught checkpoint, unless there was an error.
    """
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(policy, folder)
    start_s = time.monotonic()
    try:
        taught = load(str(folder))
        lesson = taught.teach(dataset_metadata(repo_id, str(root)), demonstrations_of(root)[task][:demos])
        write_memory(taught.require_memory(), folder)
        found = {
            "error": None,
            "objects_learned": list(lesson.objects_learned),
            "skipped": list(lesson.skipped),
        }
    except OpenSPMError as error:
        found = {"error": str(error)}
    seconds = round(time.monotonic() - start_s, 2)
    return {"task": task, "demonstrations": demos, "seconds": seconds, **found}


def taught_episode(folder: Path, error: str | None, task: str, demos: int, seed: int) -> Row:
    """Run one episode of a taught policy."""
    about = {"task": task, "demonstrations": demos, "seed": seed}
    if error is not None:
        return {**about, "success": False, "steps": 0, "status": NOT_TAUGHT}
    with tabletop(task, seed) as world:
        return {**about, **run_episode(load(str(folder)), world).told()}


def summarise(rows: Sequence[Row], lessons: Sequence[Row]) -> dict[str, Any]:
    """Success by the number of demonstrations, and the longest lesson."""
    found = {
        str(demos): success(
            [
                Episode(**{name: row[name] for name in ("task", "seed", "steps", "success", "status")})
                for row in rows
                if row["demonstrations"] == demos
            ]
        )
        for demos in DEMOS
    }
    return {
        "teach_s": max(lesson["seconds"] for lesson in lessons),
        "success_1_demo": found["1"]["success"],
        "success_3_demos": found["3"]["success"],
        "n": min(one["n"] for one in found.values()),
        "demonstrations": found,
        "lessons": list(lessons),
    }


if __name__ == "__main__":
    run(TeachConfig, main)
