"""Success by the number of demonstrations a task: some of those that the main result used all ten of.

python -m benchmarks.libero.few_shot --demos=3
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from benchmarks.libero.evaluate import SEED, STATES, evaluate_states, summary
from benchmarks.results import run, write
from benchmarks.stages import LIBERO, dataset, first_episodes, policy, run_folder

from lerobot_openspm.cli.pipeline import THREADS


@dataclass
class FewShotConfig:
    """How many demonstrations a task to learn from, and on how many initial states a task to evaluate."""

    demos: int = 3
    states: int = STATES


def main(config: FewShotConfig) -> dict[str, Any]:
    """Train and evaluate with some of the demonstrations, and write the result down."""
    variant = f"few_{config.demos}"
    checkpoint, seconds = policy(LIBERO, variant, episodes=first_episodes(dataset(LIBERO), config.demos))
    folder = run_folder(LIBERO) / f"{variant}_evaluation"
    episodes = evaluate_states(checkpoint, folder, config.states)
    figures = {"seed": SEED, "demonstrations": config.demos, "mine_and_train_s": seconds, **summary(episodes)}
    return write(f"libero_few_shot_{config.demos}", figures, THREADS)


if __name__ == "__main__":
    run(FewShotConfig, main)
