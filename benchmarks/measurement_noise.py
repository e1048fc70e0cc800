"""Fit the mapping from what a pose estimate rests on to its covariance, and check its calibration.

    python -m benchmarks.measurement_noise [--env.type=libero]

Errors are those of the estimates that the policy gets along episodes from tuning seeds, the hand in the way
and all. Weights are fitted on all seeds but the last and judged on that, beside those in use. Fitted ones go
by hand into `perception/tracking/measurement.py`. Takes the options of `benchmarks.perception` that say what
is measured; it runs its own number of episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from benchmarks.episodes import load, run_episode
from benchmarks.perception import PerceptionConfig
from benchmarks.results import run, write
from benchmarks.truth import Truth, offsets, true_period
from benchmarks.worlds import WORLDS
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.tracking.measurement import (
    FLOOR_M,
    FLOOR_RAD,
    POSITION_WEIGHTS,
    YAW_WEIGHTS,
    features,
)

EPISODES = 3
FIRST_SEED = TUNING_SEED_START + 400_000
# What is further off is a mistake, not noise; the tracker treats it as another place.
MAX_ERROR_M, MAX_ERROR_RAD, MIN_CONFIDENCE = 0.03, 0.3, 0.5
BOUNDS = [(-10.0, 10.0), *[(0.0, 12.0)] * 5]


@dataclass(frozen=True)
class Sample:
    """One estimate against the truth: horizontal error (m), yaw error (rad; NaN if round), its grounds."""

    kind: str
    seed: int
    error: np.ndarray
    yaw: float
    covariance: np.ndarray
    features: np.ndarray


def collect(config: PerceptionConfig) -> list[Sample]:
    """Run the policy on tuning seeds and note every estimate of objects that the hand does not hold."""
    checkpoint = config.checkpoint()
    T_sim_obj = offsets(checkpoint, config.demonstrations())
    policy, samples = load(str(checkpoint)), list[Sample]()
    periods = policy.require_memory().yaw_periods
    for task in config.env.tasks():
        for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
            with WORLDS[config.env.type](task, seed) as world:
                truth = Truth(world.object_poses(), T_sim_obj)

                def note(
                    _: int,
                    __: Observation,
                    controller: EpisodeController,
                    truth=truth,
                    world=world,
                    seed=seed,
                ) -> None:
                    scene = controller.scene
                    if not scene.has_just_looked:
                        return
                    true = truth.now(world.object_poses())
                    for name, estimate in scene.detections.estimates.items():
                        if name in true and name not in scene.tracker.held and estimate.support is not None:
                            period = true_period(name, config.env.type)
                            is_round = 0 in (period, periods[name])
                            samples.extend(_sample(estimate, true[name], seed, is_round, period))

                run_episode(policy, world, note=note)
    return samples


def _sample(estimate: Any, T_true: np.ndarray, seed: int, is_round: bool, period: float) -> list[Sample]:
    T = estimate.T_world_obj
    error = T[:2, 3] - T_true[:2, 3]
    if estimate.status != "found" or estimate.confidence < MIN_CONFIDENCE or np.hypot(*error) > MAX_ERROR_M:
        return []
    turn = se3.yaw_of(T) - se3.yaw_of(T_true)
    yaw = np.nan if is_round else float(se3.wrap_angle(turn, period))
    row = features(estimate, estimate.support)
    return [Sample(estimate.support.kind, seed, error, yaw, estimate.covariance, row)]


def fit(samples: list[Sample]) -> dict[str, Any]:
    """Weights by maximum likelihood, and how large errors are beside what they say, on held-out seeds."""
    error, seed = np.array([s.error for s in samples]), np.array([s.seed for s in samples])
    yaw, row = np.array([s.yaw for s in samples]), np.array([s.features for s in samples])
    covariance = np.array([s.covariance for s in samples])
    held_out = seed == seed.max()

    def position(weights: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        S = covariance[which, :2, :2] * np.exp(row[which] @ weights)[:, None, None] + FLOOR_M**2 * np.eye(2)
        return np.einsum("ni,nij,nj->n", error[which], np.linalg.inv(S), error[which]), np.log(
            np.linalg.det(S)
        )

    def turn(weights: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        S = covariance[which, 3, 3] * np.exp(row[which] @ weights) + FLOOR_RAD**2
        return yaw[which] ** 2 / S, np.log(S)

    kind = samples[0].kind
    result = {"position": _fitted(position, ~held_out, held_out, 2, POSITION_WEIGHTS[kind])}
    known = np.nan_to_num(np.abs(yaw), nan=np.inf) < MAX_ERROR_RAD
    if kind == "shape":
        result["yaw"] = _fitted(turn, ~held_out & known, held_out & known, 1, YAW_WEIGHTS[kind])
    return result


def _fitted(
    squares: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    used: np.ndarray,
    held_out: np.ndarray,
    dimensions: int,
    in_use: Sequence[float],
) -> dict[str, Any]:
    def loss(weights: np.ndarray) -> float:
        squared, log_det = squares(weights, used)
        return float(np.mean(0.5 * (squared + log_det)) + 5e-4 * (weights[1:] ** 2).sum())

    starts = [np.r_[first, np.full(5, other)] for first in (0.0, 2.0, 4.0) for other in (0.0, 0.5, 2.0)]
    best = min((minimize(loss, start, bounds=BOUNDS) for start in starts), key=lambda one: one.fun)
    return {
        "n": int((used | held_out).sum()),
        "held_out": int(held_out.sum()),
        "fitted": _judged(squares(best.x, held_out)[0], dimensions) | {"weights": best.x.round(2).tolist()},
        "in_use": _judged(squares(np.array(in_use), used | held_out)[0], dimensions)
        | {"weights": list(in_use)},
    }


def _judged(squared: np.ndarray, dimensions: int) -> dict[str, Any]:
    """Squared errors beside what they are said to be: 1 and 0.95 where the covariance is right."""
    return {
        "squared_mean_per_dimension": round(float(squared.mean()) / dimensions, 2),
        "inside_95": round(float((squared < chi2.ppf(0.95, dimensions)).mean()), 3),
    }


def main(config: PerceptionConfig) -> dict[str, Any]:
    """Collect, fit, write and return the result."""
    samples = collect(config)
    kinds = sorted({sample.kind for sample in samples})
    result = {kind: fit([sample for sample in samples if sample.kind == kind]) for kind in kinds}
    name = f"measurement_noise{config.env.suffix}"
    return write(name, {"seed": FIRST_SEED, "n": len(samples), "kinds": result})


if __name__ == "__main__":
    run(PerceptionConfig, main)
