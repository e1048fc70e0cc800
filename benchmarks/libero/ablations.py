"""What each part is worth: how key poses are followed, whose object poses, where key poses come from.

python -m benchmarks.libero.ablations --states=10

With --source=openai or qwen3vl also the paper's own memory ablation, key poses made up by a multimodal model.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.libero.evaluate import SEED, evaluate_states, summary
from benchmarks.libero.geometric_guess import GuessConfig, Source, guessing_policy, source_of
from benchmarks.results import run, write
from benchmarks.stages import LIBERO, policy, run_folder

from lerobot_openspm.cli.pipeline import THREADS
from lerobot_openspm.control.strategies import Execution


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
    folder = run_folder(LIBERO)
    full, _ = policy(LIBERO)
    oracle, _ = policy(LIBERO, "train_oracle", "--policy.perception=oracle")
    variants: dict[str, tuple[Path, Execution | None]] = {
        "closed_loop_trc": (full, None),
        "closed_loop": (full, "closed_loop"),
        "open_loop": (full, "open_loop"),
        "oracle": (oracle, None),
        "geometric_guess": (guessing_policy(oracle, folder / "train_guess"), None),
    }
    if config.source != "geometric":
        place = folder / "train_zero_shot"
        asked = GuessConfig(str(oracle), str(place), config.source, config.model_id, config.api_base)
        variants["zero_shot"] = guessing_policy(oracle, place, source_of(asked)), None
    runs = {
        name: summary(
            evaluate_states(checkpoint, folder / f"ablation_{name}", config.states, execution=execution)
        )
        for name, (checkpoint, execution) in variants.items()
    }
    n = min(run["n"] for run in runs.values())
    return write("libero_ablations", {"seed": SEED, "n": n, "states": config.states, "runs": runs}, THREADS)


if __name__ == "__main__":
    run(AblationConfig, main)
