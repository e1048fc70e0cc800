"""Success by the number of demonstrations a task: some of those that the main result used all ten of."""

from __future__ import annotations

import json
import logging
import os
import sys
from dataclasses import dataclass
from typing import Any

import draccus
from benchmarks.common import write
from benchmarks.libero.evaluate import SEED, summary
from benchmarks.libero.stages import STATES, dataset, evaluation, first_episodes, policy, run_folder

from lerobot_openspm.cli.pipeline import THREADS


@dataclass
class FewShotConfig:
    """How many demonstrations a task to learn from, and on how many initial states a task to evaluate."""

    demos: int = 3
    states: int = STATES


def main(config: FewShotConfig) -> dict[str, Any]:
    """Train and evaluate with some of the demonstrations, and write the result down."""
    root = dataset()
    variant = f"few_{config.demos}"
    checkpoint, seconds = policy(root, variant, episodes=first_episodes(root, config.demos))
    episodes = evaluation(run_folder() / f"{variant}_evaluation", checkpoint, config.states)
    figures = {"seed": SEED, "demonstrations": config.demos, "mine_and_train_s": seconds, **summary(episodes)}
    return write(f"libero_few_shot_{config.demos}", figures, THREADS)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    os.environ.setdefault("MUJOCO_GL", "egl")
    print(json.dumps(main(draccus.parse(FewShotConfig, args=sys.argv[1:]))))
