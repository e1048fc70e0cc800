"""How long a checkpoint's decisions take on this machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.observation import Observation

WARM_UP = 20


def latency(
    policy: OpenSPMPolicy, observation: Observation, chunks: int = 1000, looks: int = 100
) -> dict[str, Any]:
    """Times of a chunk of actions, and of an episode's first action, for which the objects are found.

    Args:
        policy: What acts, with as many threads as torch has.
        observation: What it sees; its images are decoded already.
        chunks: How many chunks are timed.
        looks: How many first actions are timed.

    Raises:
        OpenSPMError: The policy does not act on the observation.
    """
    with torch.inference_mode():
        first = times_ms(lambda: (policy.reset(), policy.act([observation])), looks)
        controller = policy.episodes[0].controller
        if not controller.executor.targets:
            raise OpenSPMError(
                f"the policy does not act on {observation.instruction!r}: its status is "
                f"{controller.state.status}; choose another frame or instruction"
            )
        chunk = times_ms(lambda: policy._chunk(controller, observation.hand), chunks)
    horizon = policy.config.chunk_size
    return {
        "chunk_size": horizon,
        "parameters": sum(p.numel() for p in policy.parameters()),
        "chunk_ms": chunk,
        "equivalent_hz": round(1000 * horizon / chunk["median"], 1),
        "decisions_hz": round(1000 / chunk["median"], 1),
        "first_action_ms": first,
    }


def times_ms(call: Callable[[], object], n: int) -> dict[str, float]:
    """Milliseconds of a call: median and 99th percentile of n, after some to warm up."""
    spent = []
    for _ in range(n + WARM_UP):
        start_s = time.perf_counter()
        call()
        spent.append(1000 * (time.perf_counter() - start_s))
    kept = np.array(spent[WARM_UP:])
    median, p99 = (round(float(np.percentile(kept, q)), 4) for q in (50, 99))
    return {"median": median, "p99": p99, "n": n}
