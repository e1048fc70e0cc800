"""Success, from pixels, on tasks beside the ten: made of their parts, or with a second bowl on the table.

python -m benchmarks.selection compound
python -m benchmarks.selection two_bowls
"""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path

from benchmarks.common import EPISODES, RUN, policy, success, write

from lerobot_openspm.cli.pipeline import evaluate
from lerobot_openspm.envs.tasks import ANY_TASK, SELECTIONS

# Seeds of evaluation that nothing else was measured on; the code was tuned on 2,600,000 and more.
SEEDS = {"compound": 8000, "two_bowls": 11_000}


def main(selection: str, checkpoint: Path | None = None, output: Path | None = None) -> dict:
    """Evaluate, write and return the result.

    Args:
        selection: "compound" or "two_bowls".
        checkpoint: A policy trained on the ten tasks; by default that of `make demo`, trained if need be.
        output: Folder of the evaluation, which is resumed where it was interrupted.
    """
    checkpoint, tasks, seed = checkpoint or policy()[0], SELECTIONS[selection], SEEDS[selection]
    episodes = evaluate(checkpoint, output or RUN / f"eval_{selection}", EPISODES, seed, tasks=tasks)
    instructions = {task: ANY_TASK[task].instruction for task in tasks}
    runs = {selection: success(episodes)}
    return write(selection, {"seed": seed, "instructions": instructions, "runs": runs})


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("selection", choices=sorted(SEEDS))
    parser.add_argument("--checkpoint", type=Path, help="default: that of `make demo`")
    parser.add_argument("--output", type=Path, help="default: beside the checkpoint of `make demo`")
    arguments = parser.parse_args()
    result = main(arguments.selection, arguments.checkpoint, arguments.output)
    run = result["runs"][arguments.selection]
    print(json.dumps({key: run[key] for key in ("success", "n", "interval", "per_task")}))
