"""One episode of libero_goal as plain lerobot-eval runs it, but rendered only when the policy looks."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.bench.episode import run_episode as run_in_world
from lerobot_openspm.bench.libero import LiberoWorld
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.envs.libero.simulator import SUITE, LiberoSimulator
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.oracle import name_simulator_poses


@dataclass(frozen=True)
class Episode:
    """What happened.

    Attributes:
        success: Whether the goal was reached in time.
        actions: Every action ``(n, 7)``, float32.
        row: The policy's state at the end.
        seen: Poses ``T_world_obj`` that the policy found when it planned, by its names.
        true: The simulator's poses of the objects that the instruction names, for measuring alone.
    """

    success: bool
    actions: np.ndarray
    row: EpisodeController
    seen: dict[str, np.ndarray]
    true: dict[str, np.ndarray]


def run_episode(policy: OpenSPMPolicy, simulator: LiberoSimulator) -> Episode:
    """Act from the simulator's present state until success or the cap."""
    models = policy.memory.objects if policy.memory else {}
    named = [name for one in parse_instruction(simulator.instruction) for name in one.objects]
    seen: dict[str, np.ndarray] = {}
    true: dict[str, np.ndarray] = {}

    def note(step: int, observation: Observation, row: EpisodeController) -> None:
        if step == 0:
            seen.update(row.scene.tracker.poses(observation.hand.T_world_ee))
            true.update(name_simulator_poses(simulator.object_poses(), list(dict.fromkeys(named)), models))

    done = run_in_world(policy, LiberoWorld(simulator), note=note)
    return Episode(done.success, done.actions, done.row, seen, true)


@functools.cache
def initial_states(task: str) -> np.ndarray:
    """The benchmark's 50 initial states of a task, flattened as LIBERO keeps them."""
    from lerobot.envs.libero import _get_suite, get_task_init_states

    suite = _get_suite(SUITE)
    return np.asarray(get_task_init_states(suite, [one.name for one in suite.tasks].index(task)))
