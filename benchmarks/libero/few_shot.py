"""Success by the number of demonstrations a task: some of those that the main result used all ten of.

python -m benchmarks.libero.few_shot --demos=3
python -m benchmarks.libero.few_shot --suite=libero_spatial --demos=3 --states=10
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from benchmarks.libero.evaluate import SEED, STATES, evaluate_states, summary
from benchmarks.libero.run import learned, learning
from benchmarks.results import run, write
from benchmarks.stages import DEMOS, LIBERO, run_folder

from lerobot_openspm.cli.pipeline import THREADS
from lerobot_openspm.envs.libero.simulator import OBJECTS, SUITE
from lerobot_openspm.envs.suites import find_suite


@dataclass
class FewShotConfig:
    """A suite, how many demonstrations a task to learn from, how many initial states a task to evaluate."""

    suite: str = SUITE
    demos: int = 3
    states: int = STATES

    def __post_init__(self) -> None:
        if self.suite not in OBJECTS:
            raise ValueError(f"suite is {self.suite!r}, expected one of {', '.join(OBJECTS)}")
        if not (1 <= self.demos <= DEMOS and 1 <= self.states <= STATES):
            raise ValueError(
                f"demos must be 1 to {DEMOS} and states 1 to {STATES}, got {self.demos}, {self.states}"
            )


def main(config: FewShotConfig) -> dict[str, Any]:
    """Train and evaluate with some of the demonstrations, and write the result down."""
    names = find_suite(LIBERO, config.suite).tasks("all")
    checkpoint, parts = learned({config.suite: names}, first=config.demos)
    folder = run_folder(LIBERO, DEMOS, config.suite) / f"few_{config.demos}_evaluation"
    episodes = evaluate_states(checkpoint, folder, config.states, names, suite=config.suite)
    about = {"seed": SEED, "suite": config.suite, "demonstrations": config.demos}
    figures = {**about, **learning(checkpoint, parts), **summary(episodes)}
    prefix = LIBERO if config.suite == SUITE else config.suite
    return write(f"{prefix}_few_shot_{config.demos}", figures, THREADS)


if __name__ == "__main__":
    run(FewShotConfig, main)
