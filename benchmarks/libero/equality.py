"""Whether the harness acts as plain lerobot-eval does: the same episodes, compared action by action.

python -m benchmarks.libero.equality --suite=libero_spatial
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.episodes import load, run_episode
from benchmarks.libero.evaluate import SEED, STATES
from benchmarks.libero.run import learned
from benchmarks.results import run, write
from benchmarks.stages import LIBERO
from benchmarks.worlds import LIBERO_IMAGE_SIZE, LiberoWorld, initial_states
from lerobot.envs.configs import LiberoEnv
from lerobot.envs.factory import make_env, make_env_pre_post_processors
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from tqdm import tqdm

from lerobot_openspm.envs.libero.simulator import OBJECTS, SUITE, LiberoSimulator, tasks
from lerobot_openspm.envs.suites import find_suite
from lerobot_openspm.modeling_openspm import OpenSPMPolicy


@dataclass
class EqualityConfig:
    """Which suite, and how many of the benchmark's initial states a task to compare."""

    suite: str = SUITE
    states: int = 1

    def __post_init__(self) -> None:
        if self.suite not in OBJECTS:
            raise ValueError(f"suite is {self.suite!r}, expected one of {', '.join(OBJECTS)}")
        if not 1 <= self.states <= STATES:
            raise ValueError(f"states must be 1 to {STATES}, got {self.states}")


def main(config: EqualityConfig) -> dict[str, Any]:
    """Run every episode twice, compare, write and return the result."""
    names = find_suite(LIBERO, config.suite).tasks("all")
    checkpoint, _ = learned({config.suite: names})
    acting = load(str(checkpoint))
    plain, lazy = [], []
    for task in tqdm(names, unit="task"):
        plain += _plain(acting, checkpoint, task, config)
        simulator = LiberoSimulator(task, LIBERO_IMAGE_SIZE)
        for state in range(config.states):
            simulator.reset_to(SEED + state, initial_states(task)[state])
            lazy.append(run_episode(acting, LiberoWorld(simulator)).actions)
        simulator.close()
    equal = [len(a) == len(b) and np.array_equal(a, b) for a, b in zip(plain, lazy, strict=True)]
    together = [np.abs(a[: len(b)] - b[: len(a)]).max() for a, b in zip(plain, lazy, strict=True)]
    return write(
        f"{config.suite}_equality",
        {
            "seed": SEED,
            "suite": config.suite,
            "n": len(equal),
            "equal": sum(equal),
            "actions": sum(len(actions) for actions in plain),
            "largest_difference": float(max(together)),
        },
    )


def _plain(acting: OpenSPMPolicy, checkpoint: Path, task: str, config: EqualityConfig) -> list[np.ndarray]:
    """Actions of one task's episodes as lerobot-eval takes them."""
    number = list(tasks(config.suite)).index(task)
    env_config = LiberoEnv(task=config.suite, task_ids=[number])
    vector_env = make_env(env_config, n_envs=1)[config.suite][number]
    before, after = make_env_pre_post_processors(env_config, policy_cfg=acting.config)
    prepare, finish = make_pre_post_processors(acting.config, pretrained_path=str(checkpoint))
    found = []
    for state in range(config.states):
        told = rollout(vector_env, acting, before, after, prepare, finish, seeds=[SEED + state])
        done = told["done"][0].numpy()
        found.append(told["action"][0].numpy()[: int(np.argmax(done)) + 1 if done.any() else None])
    vector_env.close()
    return found


if __name__ == "__main__":
    run(EqualityConfig, main)
