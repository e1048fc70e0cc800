"""A new task by memory alone: the flow model learns nine tasks, the tenth is only written into the memory.

python -m benchmarks.libero.new_task --task=put_the_bowl_on_the_plate --demos=3
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from benchmarks.libero.evaluate import SEED, STATES, evaluate_states, summary
from benchmarks.results import run, write
from benchmarks.stages import DEMOS, LIBERO, dataset, first_episodes, policy, run_folder
from benchmarks.teach import teach

from lerobot_openspm.cli.pipeline import THREADS
from lerobot_openspm.envs.libero.simulator import SUITE, tasks
from lerobot_openspm.errors import OpenSPMError


@dataclass
class NewTaskConfig:
    """The task to add, from how many demonstrations, and on how many initial states to evaluate it."""

    task: str = "put_the_bowl_on_the_plate"
    demos: int = 3
    states: int = STATES

    def __post_init__(self) -> None:
        if self.task not in tasks(SUITE):
            raise ValueError(f"task is {self.task!r}, expected one of {', '.join(tasks(SUITE))}")
        if not (1 <= self.demos <= DEMOS and 1 <= self.states <= STATES):
            raise ValueError(
                f"demos must be 1 to {DEMOS} and states 1 to {STATES}, got {self.demos}, {self.states}"
            )


def main(config: NewTaskConfig) -> dict[str, Any]:
    """Train on nine tasks, append the tenth without a gradient step, evaluate it, write the result down."""
    root, name = dataset(LIBERO), f"{config.task}_{config.demos}"
    nine, _ = policy(
        LIBERO, f"without_{config.task}", episodes=first_episodes(root, DEMOS, without=config.task)
    )
    folder = run_folder(LIBERO) / f"taught_{name}"
    lesson = teach(nine, root, config.task, config.demos, folder, "local/libero")
    if lesson["error"]:
        raise OpenSPMError(lesson["error"])
    episodes = evaluate_states(
        folder, folder.with_name(f"{folder.name}_evaluation"), config.states, [config.task]
    )
    taught = {"task": config.task, "demonstrations": config.demos, "teach_s": lesson["seconds"]}
    return write(f"libero_new_task_{name}", {"seed": SEED, **taught, **summary(episodes)}, THREADS)


if __name__ == "__main__":
    run(NewTaskConfig, main)
