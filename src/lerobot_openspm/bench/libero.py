"""libero_goal as a world to measure in."""

from __future__ import annotations

import numpy as np

from lerobot_openspm.envs.libero.simulator import LiberoSimulator

MAX_STEPS = 300
IMAGE_SIZE = 360  # lerobot-eval's default


class LiberoWorld:
    """One task of libero_goal, in the scene that its simulator is in; LIBERO ends an episode at success."""

    def __init__(self, simulator: LiberoSimulator) -> None:
        self.simulator = simulator
        self.instruction = simulator.instruction
        self.max_steps = MAX_STEPS

    def state(self) -> np.ndarray:
        """``observation.state`` (8,)."""
        return self.simulator.state()

    def image(self, name: str) -> np.ndarray:
        """A camera's present image (H, W, 3), uint8."""
        return self.simulator.image(name)

    def object_poses(self) -> dict[str, np.ndarray]:
        """True ``T_world_obj`` (4, 4) by name."""
        return self.simulator.object_poses()

    def step(self, action: np.ndarray) -> tuple[bool, bool]:
        """Apply an action; whether the episode is over, and whether its goal was reached."""
        success = self.simulator.step(action)
        return success, success
