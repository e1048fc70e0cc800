"""Success rates on the tabletop: one result file for each comparison, resumed where it was interrupted.

python -m benchmarks.tabletop execution      # three ways to follow key poses
python -m benchmarks.tabletop oracle         # object poses from the simulator, in place of perception
python -m benchmarks.tabletop conditioning   # the flow model told poses in the target's or the world's frame
python -m benchmarks.tabletop compound       # instructions of which only the parts were demonstrated
python -m benchmarks.tabletop two_bowls      # with a second bowl on the table

Demonstrations and the default policy are those of `make demo`, made if need be.
"""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path
from typing import Any

from benchmarks.common import DEMOS, EPISODES, RUN, dataset, policy, write

from lerobot_openspm.cli.demo import EVALUATION_SEED
from lerobot_openspm.cli.pipeline import THREADS, collect_dataset, evaluate, success
from lerobot_openspm.envs.tabletop.tasks import ANY_TASK, SELECTIONS

# Seeds of evaluation that nothing else was measured on; the code was tuned on 2,600,000 and more.
SELECTION_SEEDS = {"compound": 8000, "two_bowls": 11_000}


def execution() -> dict[str, Any]:
    """The three ways to follow key poses, with the same policy in the same episodes."""
    checkpoint, train_s = policy()
    collected = collect_dataset(dataset(), DEMOS)
    return {
        "train_s": train_s,
        "expert_steps": round(collected["frames"] / collected["episodes"], 1),
        "runs": {
            "closed_loop_trc": rate("eval_20", checkpoint),
            "closed_loop": rate("eval_closed_loop", checkpoint, "--policy.execution=closed_loop"),
            "open_loop": rate("eval_open_loop", checkpoint, "--policy.execution=open_loop"),
        },
    }


def oracle() -> dict[str, Any]:
    """The simulator's object poses in place of perception: what is lost to perception."""
    checkpoint, _ = policy("train_oracle", "--policy.perception=oracle")
    return {"runs": {"oracle": rate("eval_oracle", checkpoint, "--env.object_poses=true")}}


def conditioning() -> dict[str, Any]:
    """The flow model told the poses in the frame of the target, or in the world as in the paper."""
    paper, _ = policy("train_paper", "--policy.conditioning=paper")
    return {"runs": {"equivariant": rate("eval_20", policy()[0]), "paper": rate("eval_paper", paper)}}


def selection(name: str) -> dict[str, Any]:
    """Tasks beside the ten that were demonstrated."""
    tasks = SELECTIONS[name]
    episodes = evaluate(
        policy()[0], RUN / f"eval_{name}", EPISODES, SELECTION_SEEDS[name], tasks=tasks
    )  # fmt: skip
    return {
        "instructions": {task: ANY_TASK[task].instruction for task in tasks},
        "runs": {name: success(episodes)},
    }


def rate(name: str, checkpoint: Path, *options: str) -> dict[str, Any]:
    """Success in episodes of all ten tasks from unseen seeds, evaluated if need be."""
    return success(evaluate(checkpoint, RUN / name, EPISODES, EVALUATION_SEED, options))


COMPARISONS = {"execution": execution, "oracle": oracle, "conditioning": conditioning}


def main(name: str) -> dict[str, Any]:
    """Measure, write and return the result."""
    measured = COMPARISONS[name]() if name in COMPARISONS else selection(name)
    n = min(run["n"] for run in measured["runs"].values())
    return write(name, {"seed": SELECTION_SEEDS.get(name, EVALUATION_SEED), "n": n, **measured}, THREADS)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("comparison", choices=[*COMPARISONS, *SELECTION_SEEDS])
    print(json.dumps(main(parser.parse_args().comparison)))
