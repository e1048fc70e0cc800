"""One episode of libero_goal as plain lerobot-eval runs it, but rendered only when the policy looks."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from lerobot_openspm.control.executor import Hand
from lerobot_openspm.control.row import Row
from lerobot_openspm.envs.libero.simulator import CAMERAS, SUITE, LiberoSimulator
from lerobot_openspm.envs.recording import pose_vector
from lerobot_openspm.memory.instruction import parse_instruction
from lerobot_openspm.mining.mine import name_simulator_poses
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.observation import Observation

MAX_STEPS = 300


class LazyImages(Mapping[str, torch.Tensor]):
    """The present images by LeRobot's names, rendered when one is asked for."""

    def __init__(self, simulator: LiberoSimulator) -> None:
        self._simulator = simulator
        self._made: dict[str, torch.Tensor] = {}

    def __getitem__(self, key: str) -> torch.Tensor:
        if key not in self._made:
            image = torch.from_numpy(self._simulator.image(key.removeprefix("observation.images.")))
            self._made[key] = image.permute(2, 0, 1).contiguous().float() / 255
        return self._made[key]

    def __iter__(self) -> Iterator[str]:
        return iter([f"observation.images.{name}" for name in CAMERAS])

    def __len__(self) -> int:
        return len(CAMERAS)


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
    row: Row
    seen: dict[str, np.ndarray]
    true: dict[str, np.ndarray]


def run_episode(policy: OpenSPMPolicy, simulator: LiberoSimulator) -> Episode:
    """Act from the simulator's present state until success or the cap."""
    policy.reset()
    state_layout, action_layout = policy.config.layouts()
    actions: list[np.ndarray] = []
    seen: dict[str, np.ndarray] = {}
    true: dict[str, np.ndarray] = {}
    success = False
    while not success and len(actions) < MAX_STEPS:
        vector = simulator.state().astype(float)
        hand = Hand(state_layout.poses(vector), float(state_layout.openings(vector)))
        poses = pose_vector(simulator.object_poses()) if policy.config.perception == "oracle" else None
        observation = Observation(simulator.instruction, vector, hand, LazyImages(simulator), poses)
        with torch.inference_mode():
            action = action_layout.encode_actions(policy.act([observation])[0]).astype(np.float32)
        if not seen:
            seen = dict(policy.rows[0].layout)
            models = policy.experience.objects if policy.experience else {}
            named = [name for one in parse_instruction(simulator.instruction) for name in one.objects]
            true = name_simulator_poses(simulator.object_poses(), list(dict.fromkeys(named)), models)
        success = simulator.step(action)
        actions.append(action)
    return Episode(success, np.stack(actions), policy.rows[0], seen, true)


@functools.cache
def initial_states(task: str) -> np.ndarray:
    """The benchmark's 50 initial states of a task, flattened as LIBERO keeps them."""
    from lerobot.envs.libero import _get_suite, get_task_init_states

    suite = _get_suite(SUITE)
    return np.asarray(get_task_init_states(suite, [one.name for one in suite.tasks].index(task)))
