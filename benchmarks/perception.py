"""Errors of the poses that the policy follows, at the start and all through episodes, and what they cost.

python -m benchmarks.perception [--env.type=libero]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.episodes import IMAGES, load, run_episode
from benchmarks.harness import Row, checkpoint_files, measured_folder, resume
from benchmarks.libero.evaluate import kept_simulator, move_hand
from benchmarks.libero.variants import exchanged
from benchmarks.results import run, write
from benchmarks.stages import LIBERO, CheckpointConfig, DatasetOption
from benchmarks.truth import Error, Truth, offsets, pose_error, summary, true_period
from benchmarks.worlds import WORLDS, LiberoWorld, World
from lerobot_openspm.bench.latency import times_ms
from lerobot_openspm.cli.pipeline import THREADS
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.episodes import step_s
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.pipeline import MOST_REMEMBERED, Perception
from lerobot_openspm.perception.tracking import kalman
from lerobot_openspm.perception.tracking.tracker import Tracker, TrackerSettings
from lerobot_openspm.types import Hand

# What the policy follows, each picture's own estimate, what would be followed with the first camera alone.
VARIANTS = ("filtered", "unfiltered", "one_view")
COST_RUNS = 50
# What is timed: the policy's first cameras, and objects of a task before others.
COST_VIEWS, COST_OBJECTS, COST_SIZE = 2, 3, 256
# A scene of our own in which what the task needs has changed places. So often the hand moves on by a little
# before it looks again.
MOVED_TASK, MOVED_SEED, APART = "put_the_bowl_on_the_plate", 20_000, 4
# Of an object at one moment: task, step, object, whether the hand held it, and the error of its pose.
type Sample = tuple[str, int, str, bool, *Error]


@dataclass
class PerceptionConfig(CheckpointConfig):
    """Compare a checkpoint's poses with a simulator's.

    Args:
        dataset: The demonstrations, whose simulator poses tell where on each object its learned frame stands.
    """

    dataset: DatasetOption = field(default_factory=DatasetOption)

    def demonstrations(self) -> Path:
        """Folder of the demonstrations, recorded if they are the default ones."""
        return Path(self.dataset.root) if self.dataset.root else self.env.dataset()


def main(config: PerceptionConfig) -> dict[str, Any]:
    """Measure, write and return the result."""
    checkpoint, root = config.checkpoint(), config.demonstrations()
    offsets(checkpoint, root)  # what is wrong with them is said here, not by every worker
    files = [*checkpoint_files(checkpoint), Path(__file__).with_name("truth.py"), root / "meta/info.json"]
    folder = measured_folder(config.folder("perception"), files, [str(root)], __file__)
    jobs = {
        f"{task} {seed}": (config.env.type, checkpoint, root, task, seed) for task, seed in config.turns()
    }
    rows = resume(folder / "episodes.jsonl", jobs, compared_episode, config.workers)
    figures = {**summarise(rows), **costs(config.env, checkpoint), "episodes": len(rows)}
    name = config.env.type.removeprefix("openspm_")
    return write(f"perception_{name}", {"seed": config.seed, **figures}, THREADS)


def compared_episode(env_type: str, checkpoint: Path, root: Path, task: str, seed: int) -> Row:
    """Run one episode and compare poses with the truth at every step; see :func:`measure_episode`."""
    policy = load(str(checkpoint))
    with WORLDS[env_type](task, seed) as world:
        success, samples = measure_episode(policy, world, env_type, task, offsets(checkpoint, root))
    return {"success": success, "samples": samples}


def measure_episode(
    policy: OpenSPMPolicy, world: World, env_type: str, task: str, T_sim_obj: Mapping[str, Array]
) -> tuple[bool, dict[str, list[Sample]]]:
    """Run one episode and compare poses with the truth at every step.

    All variants see the same pictures at the same moments; only the first one is acted on.

    Returns:
        Whether it succeeded, and the samples by variant.
    """
    truth, shadow = Truth(world.object_poses(), T_sim_obj), _Shadow(policy)
    samples: dict[str, list[Sample]] = {variant: [] for variant in VARIANTS}

    def compare(step: int, observation: Observation, controller: EpisodeController) -> None:
        if not controller.state.ranked:
            return
        T_world_ee = observation.hand.T_world_ee
        true = truth.now(world.object_poses())
        shadow.follow(observation, controller)
        known = {
            "filtered": controller.scene.tracker.poses(T_world_ee),
            "unfiltered": shadow.seen,
            "one_view": shadow.tracker.poses(T_world_ee),
        }
        for name in (name for name in controller.state.ranked[0].entry.objects if name in T_sim_obj):
            held = name in controller.scene.tracker.held
            for variant, poses in known.items():
                metres, radians = None, None
                if name in poses:
                    metres, radians = pose_error(true[name], poses[name], true_period(name, env_type))
                samples[variant].append((task, step, name, held, metres, radians))

    return run_episode(policy, world, note=compare).success, samples


class _Shadow:
    """What each picture alone tells, and what would be followed with the first camera alone."""

    def __init__(self, policy: OpenSPMPolicy) -> None:
        memory = policy.require_memory()
        first = next(iter(memory.cameras))
        one_camera = replace(memory, cameras={first: memory.cameras[first]})
        self._perception = Perception(one_camera, policy.config.hand_radius_m, policy.segmenter)
        self._step_s = step_s(policy.config)
        self.tracker = Tracker(memory.yaw_periods, TrackerSettings())
        self.seen: dict[str, Array] = {}
        self._time_s = self._looked_at_s = 0.0

    def follow(self, observation: Observation, controller: EpisodeController) -> None:
        """Look when the policy has looked, hold what it holds."""
        self._time_s += self._step_s
        self.tracker.predict(self._step_s)
        hand, scene = observation.hand.T_world_ee, controller.scene
        if scene.has_just_looked:
            estimates = scene.detections.estimates
            self.seen |= {name: e.T_world_obj for name, e in estimates.items() if e.status == "found"}
            expected = self.tracker.poses(hand)
            seen = self._perception.detect(observation, list(estimates), expected, self._time_s)
            self.tracker.look(seen.estimates, hand, self._time_s - self._looked_at_s)
            self._looked_at_s = self._time_s
        for name in scene.tracker.held - self.tracker.held:
            self.tracker.hold(name, hand)
        self.tracker.release(self.tracker.held - scene.tracker.held, hand)


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """All variants; of the first one also by task, by object, at the start and in the hand."""
    samples = {variant: [s for row in rows for s in row["samples"][variant]] for variant in VARIANTS}
    own = samples[VARIANTS[0]]
    overall = _summary(own)
    return {
        **{key: overall[key] for key in ("position_mm_mean", "position_mm_p95", "orientation_deg_mean")},
        "n": overall["poses"],
        "variants": {variant: _summary(found) for variant, found in samples.items()},
        "start": _summary([s for s in own if s[1] == 0]),
        "held": _summary([s for s in own if s[3]]),
        "tasks": _grouped(own, 0),
        "objects": _grouped(own, 2),
    }


def _summary(samples: Sequence[Sample]) -> dict[str, Any]:
    return summary([sample[4:] for sample in samples])


def _grouped(samples: Sequence[Sample], by: int) -> dict[str, Any]:
    keys = dict.fromkeys(str(sample[by]) for sample in samples)
    return {key: _summary([sample for sample in samples if sample[by] == key]) for key in keys}


def costs(env: Any, checkpoint: Path) -> dict[str, Any]:
    """What looks at three objects of a task take in two views of 256 pixels, and a step of the filter.

    On one thread.
    """
    cv2.setNumThreads(1)
    policy = load(str(checkpoint))
    with WORLDS[env.type](env.tasks()[0], 0) as world:
        spent = {"perception": look_ms(policy, [small_observation(policy, world)], COST_RUNS)}
    if env.type == LIBERO:
        spent["moved"] = look_ms(policy, _moved(policy), COST_RUNS)
    one, twenty = filter_us(1), filter_us(20)
    return {
        "ms_per_observation": spent["perception"]["first_ms"]["median"],
        "filter_us": one["median"],
        "cost": {**spent, "filter_us_1_object": one, "filter_us_20_objects": twenty},
    }


def _moved(policy: OpenSPMPolicy) -> list[Observation]:
    """What is seen of a scene in which things changed places, from as many places as looks are remembered."""
    simulator, rng = kept_simulator(MOVED_TASK, exchanged(MOVED_TASK, MOVED_SEED)), np.random.default_rng(0)
    simulator.reset(MOVED_SEED)
    seen = list[Observation]()
    for _ in range(MOST_REMEMBERED + 1):
        for _ in range(APART):
            move_hand(simulator, rng)
        seen.append(small_observation(policy, LiberoWorld(simulator)))
    return seen


def small_observation(policy: OpenSPMPolicy, world: World) -> Observation:
    """What the policy's first cameras see now, in images of 256 pixels."""
    vector, layout = world.state().astype(float), policy.config.layouts()[0]
    images = {}
    for key in list(policy.require_memory().cameras)[:COST_VIEWS]:
        image = cv2.resize(
            world.image(key.removeprefix(IMAGES)), (COST_SIZE, COST_SIZE), interpolation=cv2.INTER_AREA
        )
        images[key] = torch.from_numpy(image).permute(2, 0, 1).contiguous().float() / 255
    hand = Hand(layout.poses(vector), float(layout.openings(vector)))
    return Observation(world.instruction, vector, hand, images, None)


def look_ms(policy: OpenSPMPolicy, observations: Sequence[Observation], n: int) -> dict[str, Any]:
    """Time of `n` first looks of a new episode, and of `n` looks that follow what was found.

    The first looks are at the first observation; those that follow are at the last one, after all others.

    A look is all that the policy does for one: the hand is masked, objects that hide one another are looked
    for again, and at the first look the cameras are compared. What a model keeps between episodes is there.
    """
    memory, observation = policy.require_memory(), observations[0]
    seen = replace(memory, cameras={key: memory.cameras[key] for key in observation.images})
    own = [entry for entry in memory.entries if entry.language == observation.instruction]
    needed = [name for entry in own for name in entry.objects]
    names = list(dict.fromkeys([*needed, *memory.objects]))[:COST_OBJECTS]

    def first() -> tuple[Perception, dict[str, Array]]:
        perception = Perception(seen, policy.config.hand_radius_m, policy.segmenter)
        estimates = perception.detect(observation, names, {}, 0.0).estimates
        return perception, {name: one.T_world_obj for name, one in estimates.items() if one.status == "found"}

    perception, found = first()
    first_ms = times_ms(first, n)
    for i, one in enumerate(observations[1:]):
        perception.detect(one, names, found, 0.1 * (i + 1))
    last_s = 0.1 * len(observations)
    followed_ms = times_ms(lambda: perception.detect(observations[-1], names, found, last_s), n)
    counted = {"views": len(observation.images), "objects": len(names), "found": len(found)}
    return {**counted, "first_ms": first_ms, "followed_ms": followed_ms}


def filter_us(objects: int, n: int = 2000) -> dict[str, float]:
    """Time of one prediction and update of the Kalman filter."""
    T, R = np.tile(np.eye(4), (objects, 1, 1)), np.tile(1e-6 * np.eye(6), (objects, 1, 1))
    belief = kalman.begin(T, R, 0.01, 0.1)
    step = kalman.motion(0.05, TrackerSettings().linear, TrackerSettings().angular)
    times = times_ms(lambda: kalman.update(kalman.predict(belief, step), T, R), n)
    return {name: round(1000 * times[name], 1) for name in ("median", "p99")}


if __name__ == "__main__":
    run(PerceptionConfig, main)
