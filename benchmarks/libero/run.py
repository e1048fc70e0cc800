"""`make libero`: collect, train and evaluate on libero_goal; prints one JSON object last.

python -m benchmarks.libero.run --demos=10 --states=50 --tasks=0-9
"""

from __future__ import annotations

import json
import logging
import os
import sys
from dataclasses import dataclass
from typing import Any

import draccus
from benchmarks.common import write
from benchmarks.libero.accuracy import accuracy
from benchmarks.libero.evaluate import SEED, summary
from benchmarks.libero.stages import DEMOS, STATES, dataset, evaluation, policy, run_folder, select_tasks

from lerobot_openspm.cli.pipeline import THREADS
from lerobot_openspm.envs.libero.simulator import tasks

logger = logging.getLogger(__name__)


@dataclass
class RunConfig:
    """What `make libero` does. Finished stages are kept and not done again.

    Args:
        demos: Demonstrations a task.
        states: Initial states a task to evaluate, from the first on.
        tasks: Numbers of the tasks, such as 0-9 or 0,3,5.
    """

    demos: int = DEMOS
    states: int = STATES
    tasks: str = "0-9"


def main(config: RunConfig) -> dict[str, Any]:
    """Do what is missing. The whole suite from 50 states is written down as a published result."""
    selected = select_tasks(config.tasks)
    if not 1 <= config.states <= STATES or config.demos < 1:
        raise ValueError(
            f"STATES must be 1 to {STATES} and DEMOS at least 1, got {config.states}, {config.demos}"
        )
    logger.info("recording %d demonstrations of each of %d tasks", config.demos, len(selected))
    root = dataset(config.demos, selected)
    logger.info("mining and training")
    checkpoint, seconds = policy(root, "train")
    folder = run_folder(config.demos, selected) / "evaluation"
    logger.info("evaluating %d tasks from %d initial states", len(selected), config.states)
    episodes = evaluation(folder, checkpoint, config.states, selected)
    figures, errors = summary(episodes), accuracy(checkpoint, root, episodes)
    worst = {(e["task"], e["state"]): off for e, off in zip(episodes, errors.pop("off_mm"), strict=True)}
    for failed in figures["failed"]:
        failed["off_mm"] = worst[failed["task"], failed["state"]]
    timing = {"mine_and_train_s": seconds}
    if config.demos == DEMOS and config.states == STATES and selected == list(tasks()):
        about = {"seed": SEED, "demonstrations": DEMOS}
        write("libero_goal", {**about, **timing, **figures}, THREADS)
        write("libero_accuracy", {**about, "n": figures["n"], **errors}, THREADS)
    told = {key: figures[key] for key in ("success", "n", "mean_steps")}
    per_task = {task: row["success"] for task, row in figures["per_task"].items()}
    places = {key: errors[key] for key in ("position_mm_mean", "position_mm_p95")}
    return {**told, "per_task": per_task, **timing, **places, "checkpoint": str(checkpoint)}


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        print(json.dumps(main(draccus.parse(RunConfig, args=sys.argv[1:])), allow_nan=False))
    except ValueError as error:
        sys.exit(f"make libero: {error}")
