"""What each part is worth: how key poses are followed, whose object poses, where key poses come from.

python -m benchmarks.libero.ablations --states=10

With --source=openai or qwen3vl also the paper's own memory ablation, key poses made up by a multimodal model.
"""

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
from benchmarks.libero.geometric_guess import GuessConfig, Source, guessing_policy, source_of
from benchmarks.libero.stages import dataset, evaluation, policy, run_folder

from lerobot_openspm.cli.pipeline import THREADS


@dataclass
class AblationConfig:
    """On how many initial states a task, and with which model beside the geometric guess.

    Args:
        states: Initial states a task, from the first on.
        source: The multimodal model to ask for key poses; see :class:`GuessConfig`, likewise the others.
        model_id: Its name.
        api_base: Where it is.
    """

    states: int = 10
    source: Source = "geometric"
    model_id: str | None = None
    api_base: str | None = None


def main(config: AblationConfig) -> dict[str, Any]:
    """Evaluate every variant on the same states, and write the result down."""
    root, folder = dataset(), run_folder()
    full, _ = policy(root, "train")
    oracle, _ = policy(root, "train_oracle", "--policy.perception=oracle")
    guess = guessing_policy(oracle, folder / "train_guess")
    variants: dict[str, Any] = {
        "closed_loop_trc": evaluation(folder / "ablation_full", full, config.states),
        "closed_loop": evaluation(
            folder / "ablation_closed_loop", full, config.states, execution="closed_loop"
        ),
        "open_loop": evaluation(folder / "ablation_open_loop", full, config.states, execution="open_loop"),
        "oracle": evaluation(folder / "ablation_oracle", oracle, config.states),
        "geometric_guess": evaluation(folder / "ablation_guess", guess, config.states),
    }
    if config.source != "geometric":
        place = folder / "train_zero_shot"
        asked = GuessConfig(str(oracle), str(place), config.source, config.model_id, config.api_base)
        model = guessing_policy(oracle, place, source_of(asked))
        variants["zero_shot"] = evaluation(folder / "ablation_zero_shot", model, config.states)
    runs = {name: summary(found) for name, found in variants.items()}
    n = min(run["n"] for run in runs.values())
    return write("libero_ablations", {"seed": SEED, "n": n, "states": config.states, "runs": runs}, THREADS)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    os.environ.setdefault("MUJOCO_GL", "egl")
    print(json.dumps(main(draccus.parse(AblationConfig, args=sys.argv[1:]))))
