"""Whether the harness acts as plain lerobot-eval does: the same episodes, compared action by action."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.episodes import load, run_episode
from benchmarks.libero.evaluate import SEED
from benchmarks.results import run, write
from benchmarks.stages import LIBERO, policy
from benchmarks.worlds import LIBERO_IMAGE_SIZE, LiberoWorld, initial_states
from lerobot.envs.configs import LiberoEnv
from lerobot.envs.factory import make_env, make_env_pre_post_processors
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from tqdm import tqdm

from lerobot_openspm.envs.libero.simulator import SUITE, LiberoSimulator, tasks
from lerobot_openspm.modeling_openspm import OpenSPMPolicy


@dataclass
class EqualityConfig:
    """How many of the benchmark's initial states a task to compare."""

    states: int = 2


def main(config: EqualityConfig) -> dict[str, Any]:
    """Run every episode twice, compare, write and return the result."""
    checkpoint, _ = policy(LIBERO)
    acting = load(str(checkpoint))
    plain, lazy = [], []
    for number, task in enumerate(tqdm(tasks(), unit="task")):
        plain += _plain(acting, checkpoint, number, config.states)
        simulator = LiberoSimulator(task, LIBERO_IMAGE_SIZE)
        for state in range(config.states):
            simulator.reset_to(SEED + state, initial_states(task)[state])
            lazy.append(run_episode(acting, LiberoWorld(simulator)).actions)
        simulator.close()
    equal = [len(a) == len(b) and np.array_equal(a, b) for a, b in zip(plain, lazy, strict=True)]
    together = [np.abs(a[: len(b)] - b[: len(a)]).max() for a, b in zip(plain, lazy, strict=True)]
    return write(
        "libero_equality",
        {
            "seed": SEED,
            "n": len(equal),
            "equal": sum(equal),
            "actions": sum(len(actions) for actions in plain),
            "largest_difference": float(max(together)),
        },
    )


def _plain(acting: OpenSPMPolicy, checkpoint: Path, number: int, states: int) -> list[np.ndarray]:
    """Actions of one task's episodes as lerobot-eval takes them."""
    env_config = LiberoEnv(task=SUITE, task_ids=[number])
    vector_env = make_env(env_config, n_envs=1)[SUITE][number]
    before, after = make_env_pre_post_processors(env_config, policy_cfg=acting.config)
    prepare, finish = make_pre_post_processors(acting.config, pretrained_path=str(checkpoint))
    found = []
    for state in range(states):
        told = rollout(vector_env, acting, before, after, prepare, finish, seeds=[SEED + state])
        done = told["done"][0].numpy()
        found.append(told["action"][0].numpy()[: int(np.argmax(done)) + 1 if done.any() else None])
    vector_env.close()
    return found


if __name__ == "__main__":
    run(EqualityConfig, main)
