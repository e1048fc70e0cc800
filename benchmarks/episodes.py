"""One episode of a policy in a simulator, rendered only when the policy looks, with a place to interfere."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from benchmarks.harness import Row
from benchmarks.worlds import World
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.envs.recording import pose_vector
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.types import Hand

IMAGES = "observation.images."


class LazyImages(Mapping[str, torch.Tensor]):
    """The present images by LeRobot's names, rendered when one is asked for."""

    def __init__(self, world: World, cameras: tuple[str, ...]) -> None:
        self._world, self._cameras = world, cameras
        self._made: dict[str, torch.Tensor] = {}

    def __getitem__(self, key: str) -> torch.Tensor:
        if key not in self._made:
            image = torch.from_numpy(self._world.image(key.removeprefix(IMAGES)))
            self._made[key] = image.permute(2, 0, 1).contiguous().float() / 255
        return self._made[key]

    def __contains__(self, key: object) -> bool:
        return key in self._cameras

    def __iter__(self) -> Iterator[str]:
        return iter(self._cameras)

    def __len__(self) -> int:
        return len(self._cameras)


def load(checkpoint: str) -> OpenSPMPolicy:
    """A policy on one thread, without the line that LeRobot prints for every one that is loaded."""
    torch.set_num_threads(1)
    with contextlib.redirect_stdout(io.StringIO()):
        return OpenSPMPolicy.from_pretrained(checkpoint)


@dataclass(frozen=True)
class Episode:
    """What happened: whether the goal was reached, all actions ``(n, 7)``, the policy's state at the end."""

    success: bool
    actions: np.ndarray
    controller: EpisodeController

    def told(self) -> Row:
        """What is kept of it."""
        state, targets = self.controller.state, self.controller.executor.targets
        spent = (*state.spent, (state.attempts, self.controller.scene.time_s))
        began = (0.0, *(ended for _, ended in spent))
        return {
            "steps": len(self.actions),
            "success": self.success,
            "status": state.status.value,
            "refusal": state.refusal,
            "key_pose": state.index,
            "phase": targets[state.index].key_pose.phase if targets else None,
            "attempts": state.attempts,
            "parts": [
                {"attempts": attempts, "seconds": round(ended - start, 2)}
                for (attempts, ended), start in zip(spent, began, strict=False)
            ],
            "entry": " and ".join(one.source for one in state.used[-1]) if state.used else None,
        }


def run_episode(
    policy: OpenSPMPolicy,
    world: World,
    interfere: Callable[[int], None] | None = None,
    note: Callable[[int, Observation, EpisodeController], None] | None = None,
) -> Episode:
    """Act from the world's present state until it says that the episode is over.

    Args:
        policy: What acts.
        world: Where.
        interfere: Called with the number of the step before it is observed; may change the world.
        note: Called with what was observed and the policy's state, before the action is applied.
    """
    policy.reset()
    state_layout, action_layout = policy.config.layouts()
    cameras = tuple(policy.config.image_features)
    actions: list[np.ndarray] = []
    over = success = False
    while not over and len(actions) < world.max_steps:
        if interfere is not None:
            interfere(len(actions))
        vector = world.state().astype(float)
        hand = Hand(state_layout.poses(vector), float(state_layout.openings(vector)))
        poses = pose_vector(world.object_poses()) if policy.config.perception == "oracle" else None
        observation = Observation(world.instruction, vector, hand, LazyImages(world, cameras), poses)
        with torch.inference_mode():
            action = action_layout.encode_actions(policy.act([observation])[0, 0]).astype(np.float32)
        if note is not None:
            note(len(actions), observation, policy.episodes[0].controller)
        over, success = world.step(action)
        actions.append(action)
    return Episode(success, np.stack(actions), policy.episodes[0].controller)
