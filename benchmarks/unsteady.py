"""A hand led by an unsteady operator: trembling, hesitating, overshooting, closing too early.

Stronger imperfections than those of :class:`~lerobot_openspm.envs.motions.ScriptedHand`, on top of them, for
measuring what mining makes of demonstrations that people give. Nothing is recorded with it by default.
"""

from __future__ import annotations

import math

import numpy as np

from lerobot_openspm.envs.motions import Actions, HandSimulator, Pace, ScriptedHand

STEPS_PER_S = 20
# A tremor of the hand: a wandering oscillation on every axis.
TREMOR_M, TREMOR_RAD = 0.0010, 0.008
TREMOR_HZ = (2.0, 5.0)
# The speed wanders between these shares of what it would be, over about a second.
SPEED_SHARE = (0.4, 1.0)
SPEED_WANDER = 0.15
# Chances, each with the bounds of what then happens.
PAUSE_CHANCE, PAUSE_STEPS = 0.25, (4, 21)
OVERSHOOT_CHANCE, OVERSHOOT_M = 0.5, (0.006, 0.020)
SHORT_STOP_CHANCE, SHORT_STOP_M, SHORT_STOP_STEPS = 0.5, (0.010, 0.030), (2, 11)
SHORT_STOP_ASIDE_M = 0.003
DELAY_CHANCE, DELAY_STEPS = 0.6, (2, 16)
FALSE_START_CHANCE, FALSE_START_STEPS = 0.3, (3, 8)


class UnsteadyHand[SimulatorT: HandSimulator](ScriptedHand[SimulatorT]):
    """A :class:`ScriptedHand` with stronger imperfections.

    - The hand trembles all the time, also while it waits for its fingers, and its speed wanders.
    - It pauses before ways, and goes too far and comes back at the end of ways through free space.
    - It stops short of contacts, a little aside, and hesitates there before it goes on.
    - It waits at contacts before the fingers move and after they have moved.
    - Its fingers close too early and open again, before they close for good.

    Args:
        simulator: Where the true poses are read from.
        rng: Source of every imperfection of this episode.
        pace: How the simulator's hand follows its actions.
    """

    def __init__(self, simulator: SimulatorT, rng: np.random.Generator, pace: Pace) -> None:
        super().__init__(simulator, rng, pace)
        self._phase = rng.uniform(0, 2 * math.pi, size=6)
        self._share = float(rng.uniform(*SPEED_SHARE))

    def travel(self, goal: np.ndarray) -> Actions:
        """Cross free space to T_world_ee `goal`, sometimes beyond it first."""
        yield from self._hesitate(PAUSE_CHANCE, PAUSE_STEPS)
        way = goal[:3, 3] - self.simulator.ee_pose()[:3, 3]
        length = float(np.linalg.norm(way))
        if length > 0.1 and self.rng.random() < OVERSHOOT_CHANCE:
            beyond = goal.copy()
            beyond[:3, 3] += way / length * self.rng.uniform(*OVERSHOOT_M)
            yield from super().travel(beyond)
        yield from super().travel(goal)

    def advance(self, goal: np.ndarray, slowness: float = 1.0) -> Actions:
        """Move to T_world_ee `goal` and arrive precisely, sometimes after a stop on the way."""
        yield from self._hesitate(PAUSE_CHANCE, PAUSE_STEPS)
        way = goal[:3, 3] - self.simulator.ee_pose()[:3, 3]
        length, left = float(np.linalg.norm(way)), self.rng.uniform(*SHORT_STOP_M)
        if length > 0.05 and self.rng.random() < SHORT_STOP_CHANCE:
            short = goal.copy()
            short[:3, 3] -= way / length * left
            if not self.closing:
                short[:3, 3] += self.rng.normal(0, SHORT_STOP_ASIDE_M, size=3)
            yield from super().advance(short, slowness)
            yield from self.hold(int(self.rng.integers(*SHORT_STOP_STEPS)))
        yield from super().advance(goal, slowness)

    def grip(self, closing: bool) -> Actions:
        """Close or open the fingers, with delays, and not always at the first try."""
        yield from self._hesitate(DELAY_CHANCE, DELAY_STEPS)
        if closing and self.rng.random() < FALSE_START_CHANCE:
            self.closing = True
            yield from self.hold(int(self.rng.integers(*FALSE_START_STEPS)))
            yield from super().grip(closing=False)
        yield from super().grip(closing)
        yield from self._hesitate(DELAY_CHANCE, DELAY_STEPS)

    def _hesitate(self, chance: float, steps: tuple[int, int]) -> Actions:
        if self.rng.random() < chance:
            yield from self.hold(int(self.rng.integers(*steps)))

    def _towards(self, goal: np.ndarray, speed: float) -> np.ndarray:
        wandered = self._share + self.rng.normal(0, SPEED_WANDER) * (SPEED_SHARE[1] - SPEED_SHARE[0])
        self._share = float(np.clip(wandered, *SPEED_SHARE))
        action = super()._towards(goal, speed * self._share)
        before = np.sin(self._phase)
        self._phase += 2 * math.pi * self.rng.uniform(*TREMOR_HZ, size=6) / STEPS_PER_S
        size = np.array([TREMOR_M / self.pace.asked_m] * 3 + [TREMOR_RAD / self.pace.asked_rad] * 3)
        trembling = action[:6] + size * (np.sin(self._phase) - before)
        return np.append(np.clip(trembling, -1.0, 1.0), action[6]).astype(np.float32)
