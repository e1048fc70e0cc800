"""`make libero`: collect, train and evaluate on libero_goal; prints one JSON object last.

python -m benchmarks.libero.run --demos=10 --states=50 --tasks=0-9
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

from benchmarks.libero.accuracy import accuracy
from benchmarks.libero.evaluate import SEED, STATES, evaluate_states, summary
from benchmarks.results import run, write
from benchmarks.stages import DEMOS, LIBERO, dataset, policy

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

    def __post_init__(self) -> None:
        select_tasks(self.tasks)
        if not 1 <= self.states <= STATES or self.demos < 1:
            raise ValueError(
                f"STATES must be 1 to {STATES} and DEMOS at least 1, got {self.states}, {self.demos}"
            )


def main(config: RunConfig) -> dict[str, Any]:
    """Do what is missing. The whole suite from 50 states is written down as a published result."""
    selected = select_tasks(config.tasks)
    logger.info("recording %d demonstrations of each of %d tasks", config.demos, len(selected))
    root = dataset(LIBERO, config.demos, selected)
    logger.info("mining and training")
    checkpoint, seconds = policy(LIBERO, root=root)
    folder = root.with_name("evaluation")
    logger.info("evaluating %d tasks from %d initial states", len(selected), config.states)
    episodes = evaluate_states(checkpoint, folder, config.states, selected)
    errors = accuracy(checkpoint, root, episodes)
    figures = summary(episodes, errors.pop("found_off_mm"))
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


def select_tasks(selection: str) -> list[str]:
    """Tasks by their numbers: "0-9", or "0,3,5-6".

    Raises:
        ValueError: There is no such task.
    """
    names = list(tasks())
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
