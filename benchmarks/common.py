"""What the tabletop's benchmarks share: where things lie, and the stages that are run once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from lerobot_openspm.bench.results import write_result
from lerobot_openspm.cli.pipeline import collect_dataset, train

RESULTS = Path(__file__).parent / "results"
# Demonstrations and the default policy are those of `make demo`, made by whichever comes first.
RUN = Path("outputs/demo/demos_10")
DEMOS, EPISODES = 10, 20


def dataset() -> Path:
    """The demonstrations, recorded if need be."""
    collect_dataset(RUN / "dataset", DEMOS)
    return RUN / "dataset"


def policy(variant: str = "train", *options: str) -> tuple[Path, float | None]:
    """Checkpoint and training seconds of a variant of the policy, trained if need be."""
    checkpoint, seconds = train(dataset(), RUN / variant, options)
    return checkpoint, known(seconds)


def known(seconds: float) -> float | None:
    """None for the NaN of a training that was resumed: how long it took in all is not known."""
    return None if math.isnan(seconds) else seconds


def write(name: str, measured: dict[str, Any], threads: int | None = None) -> dict[str, Any]:
    """Write one result with its provenance into ``benchmarks/results``, and return it; see `write_result`."""
    return write_result(RESULTS / f"{name}.json", measured, threads)
