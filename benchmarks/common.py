"""What the tabletop's benchmarks share: where things lie, and how a result is written down."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

from lerobot_openspm.cli.demo import EVALUATION_SEED
from lerobot_openspm.cli.pipeline import Episode, collect_dataset, evaluate, mean_steps, rate, train

RESULTS = Path(__file__).parent / "results"
# Demonstrations and the default policy are those of `make demo`, made by whichever comes first.
RUN = Path("outputs/demo/demos_10")
DEMOS, EPISODES = 10, 20


def dataset() -> Path:
    """The demonstrations, recorded if need be."""
    collect_dataset(RUN / "dataset", DEMOS)
    return RUN / "dataset"


def policy(variant: str = "train", *options: str) -> tuple[Path, float | None]:
    """Checkpoint and training seconds of a variant of the policy, trained if need be."""
    checkpoint, seconds = train(dataset(), RUN / variant, options)
    return checkpoint, known(seconds)


def known(seconds: float) -> float | None:
    """None for the NaN of a training that was resumed: how long it took in all is not known."""
    return None if math.isnan(seconds) else seconds


def evaluation(name: str, checkpoint: Path, *options: str) -> list[Episode]:
    """Episodes of all ten tasks from unseen seeds, evaluated if need be."""
    return evaluate(checkpoint, RUN / name, EPISODES, EVALUATION_SEED, options)


def success(episodes: list[Episode]) -> dict[str, Any]:
    """Rate, interval, steps, and the rate of each task."""
    tasks = dict.fromkeys(e.task for e in episodes)
    own = {task: [e for e in episodes if e.task == task] for task in tasks}
    return {
        **rate(sum(e.success for e in episodes), len(episodes)),
        "mean_steps": round(mean_steps(episodes), 1),
        "per_task": {task: sum(e.success for e in es) / len(es) for task, es in own.items()},
        "failed": [[e.task, e.seed, e.status] for e in episodes if not e.success],
    }


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], capture_output=True, text=True, check=False).stdout.strip()


def write(name: str, result: dict[str, Any]) -> dict[str, Any]:
    """Write one result beside what it was measured on, and return it."""
    commit = _git("rev-parse", "--short=12", "HEAD")
    if _git("status", "--porcelain", "--", "src", "configs"):
        commit += "-dirty"
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    RESULTS.mkdir(exist_ok=True)
    content = {"commit": commit, "machine": machine, **result}
    (RESULTS / f"{name}.json").write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    return content
