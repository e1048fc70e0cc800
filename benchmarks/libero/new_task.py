"""A new task by memory alone: the flow model learns nine tasks, the tenth is only written into the memory.

python -m benchmarks.libero.new_task --task=put_the_bowl_on_the_plate --demos=3
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import torch
from benchmarks.common import write
from benchmarks.libero.evaluate import SEED, summary
from benchmarks.libero.stages import (
    DEMOS,
    REPO_ID,
    STATES,
    dataset,
    evaluation,
    first_episodes,
    policy,
    run_folder,
)
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_openspm.cli.pipeline import THREADS
from lerobot_openspm.modeling_openspm import OpenSPMPolicy


@dataclass
class NewTaskConfig:
    """The task to add, from how many demonstrations, and on how many initial states to evaluate it."""

    task: str = "put_the_bowl_on_the_plate"
    demos: int = 3
    states: int = STATES


def main(config: NewTaskConfig) -> dict[str, Any]:
    """Train on nine tasks, append the tenth without a gradient step, evaluate it, write the result down."""
    root = dataset()
    nine, _ = policy(
        root, f"without_{config.task}", episodes=first_episodes(root, DEMOS, without=config.task)
    )
    name = f"{config.task}_{config.demos}"
    folder = run_folder() / f"taught_{name}"
    torch.set_num_threads(THREADS)
    taught_s = teach(nine, root, config, folder)
    episodes = evaluation(folder / "evaluation", folder, config.states, [config.task])
    taught = {"task": config.task, "demonstrations": config.demos, "teach_s": taught_s}
    figures = {"seed": SEED, **taught, **summary(episodes)}
    return write(f"libero_new_task_{name}", figures, THREADS)


def teach(nine: Path, root: Path, config: NewTaskConfig, folder: Path) -> float:
    """Append a task's first demonstrations to a checkpoint's memory. Returns the seconds it took."""
    start_s = time.monotonic()
    taught = OpenSPMPolicy.from_pretrained(nine)
    others = set(first_episodes(root, config.demos, without=config.task))
    chosen = [number for number in first_episodes(root, config.demos) if number not in others]
    taught.teach(LeRobotDatasetMetadata(REPO_ID, root=root), chosen)
    taught.save_pretrained(folder)
    return round(time.monotonic() - start_s, 1)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    os.environ.setdefault("MUJOCO_GL", "egl")
    print(json.dumps(main(draccus.parse(NewTaskConfig, args=sys.argv[1:]))))
