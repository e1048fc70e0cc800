"""LIBERO-PRO's variants of libero_goal, with the policy that learned from the plain demonstrations.

    python -m benchmarks.libero_pro --suite=libero_goal_swap --states=50

The task files and initial states are LIBERO-PRO's own, unmodified: in `libero_goal_swap` objects change
places, in `libero_goal_lan` the instructions are worded otherwise, in `libero_goal_task` they ask for what
was never demonstrated, mostly new combinations, in `libero_goal_object` the objects of the
task have another colour or size. Their classes are run from LIBERO-PRO's unpacked files, and the installed
LIBERO stays as it is. Where its files are looked for is said by the error if they are not there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.libero.accuracy import accuracy, found_errors
from benchmarks.libero.evaluate import SEED, STATES, EvaluationConfig, evaluate, summary
from benchmarks.libero.variants import EXCHANGED, PRO_SUITES
from benchmarks.results import run, write
from benchmarks.stages import DEMOS, LIBERO, dataset, policy
from lerobot_openspm.cli.pipeline import THREADS


@dataclass
class ProConfig:
    """What to evaluate.

    Args:
        suite: libero_goal_swap, libero_goal_lan, libero_goal_task or libero_goal_object.
        states: Initial states a task, from the first on.
        task: A task's name, several with commas, or "all".
        tuning: Take exchanges of our own, drawn from tuning seeds, instead of LIBERO-PRO's.
    """

    suite: str = PRO_SUITES[0]
    states: int = STATES
    task: str = "all"
    tuning: bool = False

    def __post_init__(self) -> None:
        if self.suite not in PRO_SUITES:
            raise ValueError(f"suite is {self.suite!r}, expected one of {', '.join(PRO_SUITES)}")
        if not 1 <= self.states <= STATES:
            raise ValueError(f"states must be 1 to {STATES}, got {self.states}")
        if self.tuning and self.suite != EXCHANGED:
            raise ValueError(f"tuning is for {EXCHANGED}, got {self.suite}")
        self.evaluation(Path(), Path())

    def evaluation(self, checkpoint: Path, output: Path) -> EvaluationConfig:
        """What it asks of the evaluation. Raises ValueError where there is no such task."""
        return EvaluationConfig(
            str(checkpoint), str(output), self.task, self.suite, self.states, tuning=self.tuning
        )


def main(config: ProConfig) -> dict[str, Any]:
    """Evaluate; the whole suite is written down as a published result."""
    checkpoint, _ = policy(LIBERO)
    kind = "tuning" if config.tuning else "evaluation"
    folder = checkpoint.parents[2].with_name(f"{config.suite}_{kind}")
    episodes = evaluate(config.evaluation(checkpoint, folder))
    errors = found_errors(checkpoint, dataset(LIBERO), episodes)
    figures = summary(episodes, accuracy(episodes, errors)["found_off_mm"])
    if config.states == STATES and config.task == "all" and not config.tuning:
        write(config.suite, {"seed": SEED, "demonstrations": DEMOS, **figures}, THREADS)
    return {
        key: figures[key]
        for key in ("success", "interval", "n", "mean_steps", "touched", "moved", "failures", "per_task")
    }


if __name__ == "__main__":
    run(ProConfig, main)
