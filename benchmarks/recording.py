"""Demonstrations of an unsteady scripted expert, with everything that the hand touches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.contact_sensor import ContactSensor, ThingTrack
from benchmarks.unsteady import UnsteadyHand
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.geometry.se3 import Array

MAX_STEPS = 900
# A demonstration that did not reach its goal is none: the next scene is tried, so many steps further on.
NEXT_SEED, MAX_ATTEMPTS = 1000, 10


@dataclass(frozen=True)
class Job:
    """One demonstration to record: simulator, task, seed of the first scene to try."""

    env_type: str
    task: str
    seed: int


@dataclass(frozen=True)
class Recording:
    """What a dataset would hold of a demonstration of `n` frames, and the simulator's truth beside it.

    Attributes:
        job: What was to be recorded.
        instruction: What was to be done.
        failures: Scenes that were tried before, in which the goal was not reached.
        state: ``observation.state`` ``(n, d)``, float32, of every frame before its action.
        action: ``action`` ``(n, 7)``, float32.
        T_world_ee: Where the hand truly was, ``(n, 4, 4)``.
        opening: True distance of the fingers, ``(n,)`` in metres.
        tracks: Everything that the hand ever touched.
    """

    job: Job
    instruction: str
    failures: int
    state: NDArray[np.float32]
    action: NDArray[np.float32]
    T_world_ee: Array
    opening: Array
    tracks: tuple[ThingTrack, ...]


def record(job: Job) -> Recording:
    """Record a demonstration.

    The operator finishes what they do: unlike :mod:`lerobot_openspm.envs.recording`, nothing is cut when the
    goal is first reached.

    Raises:
        OpenSPMError: No attempt reached the goal.
    """
    for failures in range(MAX_ATTEMPTS):
        scene = _libero if job.env_type == "libero" else _tabletop
        steps = scene(job.task, job.seed + NEXT_SEED * failures)
        recording = _gather(job, failures, steps)
        if recording is not None:
            return recording
    raise OpenSPMError(
        f"the expert of {job.env_type} did not do {job.task} in {MAX_ATTEMPTS} scenes from seed {job.seed} "
        "on; choose another --seed"
    )


@dataclass(frozen=True)
class _Step:
    """One frame: what is seen, where the hand truly is, what is done, whether that reached the goal."""

    state: NDArray[np.float32]
    T_world_ee: Array
    opening: float
    action: NDArray[np.float32]
    success: bool
    sensor: ContactSensor
    instruction: str


def _gather(job: Job, failures: int, steps: Iterator[_Step]) -> Recording | None:
    """The recording of an attempt; None if it failed."""
    kept = [step for _, step in zip(range(MAX_STEPS), steps, strict=False)]
    if not any(step.success for step in kept):
        return None
    return Recording(
        job,
        kept[0].instruction,
        failures,
        np.stack([step.state for step in kept]).astype(np.float32),
        np.stack([step.action for step in kept]).astype(np.float32),
        np.stack([step.T_world_ee for step in kept]),
        np.array([step.opening for step in kept]),
        tuple(kept[0].sensor.tracks()),
    )


def _tabletop(task: str, seed: int) -> Iterator[_Step]:
    from lerobot_openspm.envs.tabletop.env import TabletopEnv
    from lerobot_openspm.envs.tabletop.experts import expert_actions

    env = TabletopEnv(task, episode_length=MAX_STEPS)
    env.reset(seed=seed)
    simulator = env.simulator
    sensor = ContactSensor(simulator.model, simulator.data, ("finger_left", "finger_right"))
    for action in expert_actions(simulator, task, np.random.default_rng(seed), UnsteadyHand):
        sensor.record()
        seen = (env.state(), simulator.ee_pose(), float(np.abs(simulator.finger_positions()).sum()))
        _, _, _, info = env.advance(action)
        if info["unstable"]:
            break
        yield _Step(*seen, action, info["is_success"], sensor, env.task_description)
    env.close()


def _libero(task: str, seed: int) -> Iterator[_Step]:
    from lerobot_openspm.envs.libero.experts import expert_actions
    from lerobot_openspm.envs.libero.simulator import LiberoSimulator

    simulator = LiberoSimulator(task)
    simulator.reset(seed)
    model, data = simulator.sim.model._model, simulator.sim.data._data
    sensor = ContactSensor(model, data, ("gripper0_leftfinger", "gripper0_rightfinger"))
    for action in expert_actions(simulator, task, np.random.default_rng(seed), UnsteadyHand):
        sensor.record()
        seen = (simulator.state(), simulator.ee_pose(), float(np.abs(simulator.finger_positions()).sum()))
        yield _Step(*seen, action, simulator.step(action), sensor, simulator.instruction)
    simulator.close()
