"""The simulators as worlds to measure in: one task in one scene."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Generator
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from lerobot_openspm.envs.libero.simulator import LiberoSimulator
    from lerobot_openspm.envs.tabletop.env import TabletopEnv

IMAGE_SIZE, LIBERO_IMAGE_SIZE = 256, 360  # of LIBERO lerobot-eval's default


class World(Protocol):
    """A simulator as an episode needs it.

    Attributes:
        instruction: What is to be done.
        max_steps: When to stop trying.
    """

    instruction: str
    max_steps: int

    def state(self) -> np.ndarray:
        """``observation.state`` ``(8,)``."""
        ...

    def image(self, name: str) -> np.ndarray:
        """A camera's present image ``(H, W, 3)``, uint8."""
        ...

    def object_poses(self) -> dict[str, np.ndarray]:
        """True poses ``T_world_obj`` ``(4, 4)`` by name."""
        ...

    def step(self, action: np.ndarray) -> tuple[bool, bool]:
        """Apply an action; whether the episode is over now, and whether its goal was reached."""
        ...


class TabletopWorld:
    """One task of the tabletop from one seed."""

    def __init__(self, env: TabletopEnv, seed: int) -> None:
        from lerobot_openspm.envs.tabletop.tasks import ANY_TASK

        self.env = env
        env.reset(seed=seed)
        self.instruction = env.task_description
        self.max_steps = ANY_TASK[env.task].max_steps
        self.state, self.object_poses = env.state, env.simulator.object_poses

    def image(self, name: str) -> np.ndarray:
        """A camera's present image ``(256, 256, 3)``, uint8."""
        return self.env.simulator.render(name, IMAGE_SIZE, IMAGE_SIZE)

    def step(self, action: np.ndarray) -> tuple[bool, bool]:
        """Apply an action; whether the episode is over, and whether its goal was reached."""
        _, terminated, truncated, info = self.env.advance(action)
        return terminated or truncated, bool(info["is_success"])


class LiberoWorld:
    """One task of LIBERO, in the scene that its simulator is in; LIBERO ends an episode at success."""

    def __init__(self, simulator: LiberoSimulator) -> None:
        self.simulator = simulator
        self.instruction, self.max_steps = simulator.instruction, simulator.max_steps
        self.state, self.image, self.object_poses = simulator.state, simulator.image, simulator.object_poses

    def step(self, action: np.ndarray) -> tuple[bool, bool]:
        """Apply an action; whether the episode is over, and whether its goal was reached."""
        success = self.simulator.step(action)
        return success, success


@contextlib.contextmanager
def tabletop(task: str, seed: int) -> Generator[TabletopWorld]:
    """A task's scene on the tabletop, drawn from a seed."""
    from lerobot_openspm.envs.tabletop.env import TabletopEnv

    with contextlib.closing(TabletopEnv(task=task)) as env:
        yield TabletopWorld(env, seed)


@contextlib.contextmanager
def libero(task: str, seed: int) -> Generator[LiberoWorld]:
    """A task's scene of LIBERO, drawn from a seed; the benchmark's own are :func:`initial_states`."""
    from lerobot_openspm.envs.libero.simulator import LiberoSimulator

    with contextlib.closing(LiberoSimulator(task, LIBERO_IMAGE_SIZE)) as simulator:
        simulator.reset(seed)
        yield LiberoWorld(simulator)


WORLDS = {"openspm_tabletop": tabletop, "libero": libero}


@functools.cache
def initial_states(task: str) -> np.ndarray:
    """The 50 initial states of a task of LIBERO, flattened as LIBERO keeps them."""
    from lerobot.envs.libero import _get_suite, get_task_init_states

    from lerobot_openspm.envs.libero.simulator import suite_of

    suite = _get_suite(suite_of(task))
    return np.asarray(get_task_init_states(suite, [one.name for one in suite.tasks].index(task)))
