"""How long a chunk takes, and a whole decision with images, on one thread and one environment.

python -m benchmarks.libero.latency
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from benchmarks.episodes import LazyImages, load
from benchmarks.results import run, write
from benchmarks.stages import LIBERO, policy
from benchmarks.worlds import libero

from lerobot_openspm.bench.latency import latency
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.types import Hand


@dataclass
class LatencyConfig:
    """In which task's scene."""

    task: str = "put_the_bowl_on_the_plate"


def main(config: LatencyConfig) -> dict[str, Any]:
    """Measure, write and return the result."""
    acting = load(str(policy(LIBERO)[0]))
    with libero(config.task, TUNING_SEED_START) as world:
        layout, vector = acting.config.layouts()[0], world.state().astype(float)
        hand = Hand(layout.poses(vector), float(layout.openings(vector)))
        images = dict(LazyImages(world, tuple(acting.config.image_features)))
        found = latency(acting, Observation(world.instruction, vector, hand, images, None))
    return write("libero_latency", {"seed": TUNING_SEED_START, "n": found["chunk_ms"]["n"], **found})


if __name__ == "__main__":
    run(LatencyConfig, main)
