"""Lets an expert act in an environment."""

import numpy as np

from lerobot_openspm.envs.tabletop.env import TabletopEnv
from lerobot_openspm.envs.tabletop.experts import expert_actions


def run_expert(env: TabletopEnv, seed: int) -> tuple[dict, int]:
    """Let the expert act from `seed`, rendering nothing; returns the last info and the number of steps."""
    _, info = env.reset(seed=seed)
    steps = 0
    for action in expert_actions(env.simulator, env.task, np.random.default_rng(seed)):
        _, terminated, truncated, info = env.advance(action)
        steps += 1
        if terminated or truncated:
            break
    return info, steps
