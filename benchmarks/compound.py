"""Success, from pixels, of instructions of which the parts were demonstrated and the whole never was."""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path

from benchmarks.common import EPISODES, RUN, policy, success, write

from lerobot_openspm.cli.pipeline import evaluate
from lerobot_openspm.envs.tasks import COMPOUND_TASK_NAMES, COMPOUND_TASKS

# Seeds of evaluation that nothing else was measured on; the code was tuned on 2,700,000 and more.
SEED = 8000


def main(checkpoint: Path | None = None, output: Path = RUN / "eval_compound") -> dict:
    """Evaluate, write and return the result.

    Args:
        checkpoint: A policy trained on the ten tasks; by default that of `make demo`, trained if need be.
        output: Folder of the evaluation, which is resumed where it was interrupted.
    """
    checkpoint = checkpoint or policy()[0]
    episodes = evaluate(checkpoint, output, EPISODES, SEED, tasks=COMPOUND_TASK_NAMES)
    instructions = {task.name: task.instruction for task in COMPOUND_TASKS.values()}
    return write(
        "compound", {"seed": SEED, "instructions": instructions, "runs": {"compound": success(episodes)}}
    )


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--checkpoint", type=Path, help="default: that of `make demo`")
    parser.add_argument("--output", type=Path, default=RUN / "eval_compound")
    arguments = parser.parse_args()
    result = main(arguments.checkpoint, arguments.output)
    run = result["runs"]["compound"]
    print(json.dumps({key: run[key] for key in ("success", "n", "interval", "per_task")}))
