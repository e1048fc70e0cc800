"""Motions of the scripted experts: proportional control by 7-D actions, imperfect like a person's.

Every motion is a generator: it yields one action, is resumed after the environment has stepped, and looks at
the simulator again.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.geometry.se3 import transform

GAIN = 0.5
ACTION_NOISE = 0.03
PAUSE_SEGMENTS = 8
VIA_CHANCE = 0.6
GRASP_NOISE_M = 0.0012
GRASP_NOISE_RAD = math.radians(1.5)
# R_world_ee of a hand that points down and opens its fingers along the world's y.
DOWN = np.diag([1.0, -1.0, -1.0])

Actions = Iterator[np.ndarray]


class HandSimulator(Protocol):
    """What :class:`ScriptedHand` needs of a simulator."""

    def ee_pose(self) -> np.ndarray:
        """``T_world_ee``, (4, 4)."""
        ...

    def object_poses(self) -> dict[str, np.ndarray]:
        """True ``T_world_obj``, (4, 4), by name."""
        ...


@dataclass(frozen=True)
class Pace:
    """How a simulator's hand follows its actions.

    Attributes:
        step_m: How far a translation of 1 moves the hand in one step, in metres.
        step_rad: How far a rotation of 1 turns it in one step, in radians.
        closing_steps: Bounds [low, high) of the steps that closing fingers need to settle.
        opening_steps: The same for opening fingers.
        asked_m: How far a translation of 1 asks the hand to go; it may not get there in one step.
        asked_rad: How far a rotation of 1 asks it to turn.
    """

    step_m: float
    step_rad: float
    closing_steps: tuple[int, int]
    opening_steps: tuple[int, int]
    asked_m: float
    asked_rad: float


def yaw_matrix(yaw: float) -> np.ndarray:
    """Rotation about the world's z, (3, 3)."""
    return Rotation.from_euler("z", yaw).as_matrix()


def pointing_down(position: np.ndarray, yaw: float = 0.0) -> np.ndarray:
    """T_world_ee of a hand that points down, (4, 4); at yaw 0 the fingers open along the world's y."""
    return transform(yaw_matrix(yaw) @ DOWN, position)


def raised(T_world_ee: np.ndarray, height: float) -> np.ndarray:
    """The same pose `height` metres further up."""
    return transform(T_world_ee[:3, :3], T_world_ee[:3, 3] + [0.0, 0.0, height])


def in_world(T_world_obj: np.ndarray, point: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """A point (3,) of an object's frame in the world, (3,)."""
    return T_world_obj[:3, :3] @ np.asarray(point, float) + T_world_obj[:3, 3]


class ScriptedHand[SimulatorT: HandSimulator]:
    """Moves the hand of a simulator towards poses, one action at a time, with a person's imperfections.

    Args:
        simulator: Where the true poses are read from.
        rng: Source of every imperfection of this episode.
        pace: How the simulator's hand follows its actions.
    """

    def __init__(self, simulator: SimulatorT, rng: np.random.Generator, pace: Pace) -> None:
        self.simulator = simulator
        self.rng = rng
        self.pace = pace
        self.closing = False
        self._segment = 0
        self._pause_at = set(rng.integers(0, PAUSE_SEGMENTS, size=int(rng.integers(0, 4))).tolist())

    def frame(self, name: str) -> np.ndarray:
        """True T_world_obj of an object now, (4, 4)."""
        return self.simulator.object_poses()[name]

    def origin(self, name: str) -> np.ndarray:
        """Where an object's origin truly is now, (3,) metres."""
        return self.frame(name)[:3, 3]

    def grasp_noise(self) -> tuple[np.ndarray, float]:
        """Offset of a grasp or a release: (3,) metres in the horizontal plane, and a yaw in radians."""
        offset = np.append(self.rng.normal(0.0, GRASP_NOISE_M, size=2), 0.0)
        return np.clip(offset, -0.0025, 0.0025), float(self.rng.normal(0.0, GRASP_NOISE_RAD))

    def travel(self, goal: np.ndarray) -> Actions:
        """Cross free space to T_world_ee `goal`, often not quite straight; ends near it, still moving."""
        yield from self._maybe_pause()
        start = self.simulator.ee_pose()
        if self.rng.random() < VIA_CHANCE and np.linalg.norm(goal[:3, 3] - start[:3, 3]) > 0.12:
            direction = self.rng.normal(size=3)
            direction[2] = abs(direction[2])
            detour = direction / np.linalg.norm(direction) * self.rng.uniform(0.01, 0.04)
            via = transform(goal[:3, :3], (start[:3, 3] + goal[:3, 3]) / 2 + detour)
            yield from self._approach(via, 0.03, math.inf)
        yield from self._approach(goal, 0.012, 0.12)

    def retreat(self, height: float) -> Actions:
        """Travel `height` metres straight up."""
        yield from self.travel(raised(self.simulator.ee_pose(), height))

    def advance(self, goal: np.ndarray, slowness: float = 1.0) -> Actions:
        """Move straight to T_world_ee `goal` and arrive precisely."""
        yield from self._maybe_pause()
        yield from self._approach(goal, 0.0025, 0.035, slowness)

    def grip(self, closing: bool) -> Actions:
        """Close or open the fingers and hold still until they have settled."""
        self.closing = closing
        steps = self.pace.closing_steps if closing else self.pace.opening_steps
        yield from self.hold(int(self.rng.integers(*steps)))

    def hold(self, steps: int) -> Actions:
        """Stay where the hand is."""
        goal = self.simulator.ee_pose()
        for _ in range(steps):
            yield self._towards(goal, 0.3)

    def _maybe_pause(self) -> Actions:
        self._segment += 1
        if self._segment - 1 in self._pause_at:
            yield from self.hold(int(self.rng.integers(3, 11)))

    def _approach(
        self, goal: np.ndarray, tolerance_m: float, tolerance_rad: float, slowness: float = 1.0
    ) -> Actions:
        speed = float(self.rng.uniform(0.6, 1.0)) * slowness
        distance, angle = self._remaining(goal)
        limit = 25 + int((distance / self.pace.step_m + angle / self.pace.step_rad) / speed)
        for _ in range(limit):
            distance, angle = self._remaining(goal)
            if distance < tolerance_m and angle < tolerance_rad:
                return
            yield self._towards(goal, speed)

    def _remaining(self, goal: np.ndarray) -> tuple[float, float]:
        position, turn = self._errors(goal)
        return float(np.linalg.norm(position)), float(np.linalg.norm(turn))

    def _errors(self, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        current = self.simulator.ee_pose()
        turn = Rotation.from_matrix(goal[:3, :3] @ current[:3, :3].T).as_rotvec()
        return goal[:3, 3] - current[:3, 3], turn

    def _towards(self, goal: np.ndarray, speed: float) -> np.ndarray:
        position, turn = self._errors(goal)
        command = np.concatenate(
            [_scaled(position / self.pace.step_m, speed), _scaled(turn / self.pace.step_rad, speed)]
        )
        command += self.rng.normal(0.0, ACTION_NOISE, size=6)
        return np.append(np.clip(command, -1.0, 1.0), 1.0 if self.closing else -1.0).astype(np.float32)


def _scaled(error: np.ndarray, speed: float) -> np.ndarray:
    """Proportional command, its length bounded by `speed` so that the path stays straight."""
    command = GAIN * error
    length = float(np.linalg.norm(command))
    return command if length <= speed else command * (speed / length)
