"""How long a chunk takes, and a whole decision with images, on one thread and one environment."""

from __future__ import annotations

import argparse
import json
import os
import time
from typing import Any

import numpy as np
import torch
from benchmarks.common import write
from benchmarks.libero.stages import dataset, policy

from lerobot_openspm.bench.episode import LazyImages
from lerobot_openspm.bench.libero import LiberoWorld
from lerobot_openspm.envs.libero.simulator import LiberoSimulator
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.types import Hand

TASK = "put_the_bowl_on_the_plate"
CHUNKS, LOOKS, WARM_UP = 1000, 100, 20


def main() -> dict[str, Any]:
    """Measure, write and return the result."""
    torch.set_num_threads(1)
    checkpoint, _ = policy(dataset(), "train")
    acting = OpenSPMPolicy.from_pretrained(checkpoint)
    simulator = LiberoSimulator(TASK, 360)
    simulator.reset(TUNING_SEED_START)
    layout, vector = acting.config.layouts()[0], simulator.state().astype(float)
    hand = Hand(layout.poses(vector), float(layout.openings(vector)))
    images = dict(LazyImages(LiberoWorld(simulator), tuple(acting.config.image_features)))
    observation = Observation(simulator.instruction, vector, hand, images, None)
    with torch.inference_mode():
        first = _times(lambda: (acting.reset(), acting.act([observation])), LOOKS)
        row = acting.episodes[0].controller
        chunk = _times(lambda: acting._chunk(row, hand), CHUNKS)
    horizon = acting.config.chunk_size
    return write(
        "libero_latency",
        {
            "seed": TUNING_SEED_START,
            "n": CHUNKS,
            "chunk_size": horizon,
            "parameters": sum(p.numel() for p in acting.parameters()),
            "chunk_ms": chunk,
            "equivalent_hz": round(1000 * horizon / chunk["median"], 1),
            "decisions_hz": round(1000 / chunk["median"], 1),
            "first_action_ms": first,
        },
    )


def _times(run: Any, n: int) -> dict[str, float]:
    """Milliseconds: median and 99th percentile of `n` runs after some to warm up."""
    spent = []
    for _ in range(n + WARM_UP):
        start_s = time.perf_counter()
        run()
        spent.append(1000 * (time.perf_counter() - start_s))
    kept = spent[WARM_UP:]
    return {
        "median": round(float(np.median(kept)), 2),
        "p99": round(float(np.percentile(kept, 99)), 2),
        "n": n,
    }


if __name__ == "__main__":
    os.environ.setdefault("MUJOCO_GL", "egl")
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(json.dumps(main()))
