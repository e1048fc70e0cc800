"""Errors of the poses that the policy follows, at the start and all through episodes, and what they cost."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_openspm.bench.episode import IMAGES, World, load, run_episode
from lerobot_openspm.bench.object_frames import offset
from lerobot_openspm.bench.truth import Truth, pose_error, true_period
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.envs.suites import find_suite
from lerobot_openspm.episodes import step_s
from lerobot_openspm.files import write_json
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.objects.base import Look
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.pipeline import Perception
from lerobot_openspm.perception.tracking import kalman
from lerobot_openspm.perception.tracking.tracker import Tracker, TrackerSettings
from lerobot_openspm.training import open_demonstrations
from lerobot_openspm.types import View

# What the policy follows, each picture's own estimate, what would be followed with the first camera alone.
VARIANTS = ("filtered", "unfiltered", "one_view")
WARM_UP = 20


COST_RUNS = 50
# What is timed: the policy's first cameras and objects.
COST_VIEWS, COST_OBJECTS = 2, 3


@dataclass(frozen=True)
class Setting:
    """What is measured and where: kind of simulator, checkpoint, its demonstrations and their name."""

    env_type: str
    checkpoint: str
    dataset: str
    repo_id: str


def tasks(env_type: str, selection: str) -> list[str]:
    """Names of the tasks that a selection stands for."""
    return find_suite(env_type).tasks(selection)


@contextlib.contextmanager
def world(env_type: str, task: str, seed: int) -> Generator[World]:
    """A task's scene drawn from a seed."""
    if env_type == "openspm_tabletop":
        from lerobot_openspm.bench.tabletop import TabletopWorld
        from lerobot_openspm.envs.tabletop.env import TabletopEnv

        with contextlib.closing(TabletopEnv(task=task)) as env:
            yield TabletopWorld(env, seed)
    else:
        from lerobot_openspm.bench.libero import IMAGE_SIZE, LiberoWorld
        from lerobot_openspm.envs.libero.simulator import LiberoSimulator

        with contextlib.closing(LiberoSimulator(task, IMAGE_SIZE)) as simulator:
            simulator.reset(seed)
            yield LiberoWorld(simulator)


def file_of(folder: Path, task: str, seed: int) -> Path:
    """Where one episode's samples are kept."""
    return folder / f"{task}_{seed}.json"


def run(setting: Setting, folder: Path, task: str, seed: int) -> None:
    """Measure one episode and write its samples down."""
    policy = load(setting.checkpoint)
    meta = LeRobotDatasetMetadata(setting.repo_id, root=setting.dataset)
    demonstrations = open_demonstrations(meta, policy.config)
    memory = policy.require_memory()
    offsets = {name: offset(memory, name, demonstrations) for name in memory.objects}
    with world(setting.env_type, task, seed) as scene:
        success, samples = measure_episode(policy, scene, setting.env_type, task, offsets)
    write_json(file_of(folder, task, seed), {"success": success, "samples": samples})


def read(folder: Path, jobs: Sequence[tuple[str, int]]) -> dict[str, list[Sample]]:
    """The samples of all episodes by variant."""
    samples: dict[str, list[Sample]] = {variant: [] for variant in VARIANTS}
    for task, seed in jobs:
        for variant, rows in json.loads(file_of(folder, task, seed).read_text())["samples"].items():
            samples[variant] += [tuple(row) for row in rows]
    return samples


def costs(setting: Setting) -> dict[str, Any]:
    """What a look at three objects in two views of 256 pixels takes, and a step of the filter; one thread."""
    cv2.setNumThreads(1)
    policy = load(setting.checkpoint)
    memory = policy.require_memory()
    task = tasks(setting.env_type, "all")[0]
    with world(setting.env_type, task, 0) as scene:
        vector = scene.state().astype(float)
        T_world_ee = policy.config.layouts()[0].poses(vector)
        views = {}
        for key, camera in list(memory.cameras.items())[:COST_VIEWS]:
            image = scene.image(key.removeprefix(IMAGES))
            image = np.asarray(cv2.resize(image, (256, 256), interpolation=cv2.INTER_AREA), np.uint8)
            scaled = camera.scaled(256, 256)
            views[key] = View(image, scaled, scaled.T_world_cam(T_world_ee))
    spent = milliseconds(policy, views, list(memory.objects)[:COST_OBJECTS], COST_RUNS)
    one, twenty = filter_microseconds(1), filter_microseconds(20)
    return {
        "ms_per_observation": spent["first_ms"]["median"],
        "filter_us": one["median"],
        "cost": {"perception": spent, "filter_us_1_object": one, "filter_us_20_objects": twenty},
    }


# Of an object at one moment: task, step, object, whether the hand held it, metres and radians
# off; None where nothing is known.
type Sample = tuple[str, int, str, bool, float | None, float | None]


def measure_episode(
    policy: OpenSPMPolicy, world: World, env_type: str, task: str, offsets: Mapping[str, Array]
) -> tuple[bool, dict[str, list[Sample]]]:
    """Run one episode and compare poses with the truth at every step.

    All variants see the same pictures at the same moments; only the first one is acted on.

    Returns:
        Whether it succeeded, and the samples by variant.
    """
    truth, shadow = Truth(world.object_poses(), offsets), _Shadow(policy)
    samples: dict[str, list[Sample]] = {variant: [] for variant in VARIANTS}

    def compare(step: int, observation: Observation, row: EpisodeController) -> None:
        if not row.state.ranked:
            return
        T_world_ee = observation.hand.T_world_ee
        true = truth.now(world.object_poses())
        shadow.follow(observation, row)
        known = {
            "filtered": row.scene.tracker.poses(T_world_ee),
            "unfiltered": shadow.seen,
            "one_view": shadow.tracker.poses(T_world_ee),
        }
        for name in (name for name in row.state.ranked[0].entry.objects if name in offsets):
            held = name in row.scene.tracker.held
            for variant, poses in known.items():
                error: tuple[float | None, float | None] = (None, None)
                if name in poses:
                    error = pose_error(true[name], poses[name], true_period(name, env_type))
                samples[variant].append((task, step, name, held, error[0], error[1]))

    return run_episode(policy, world, note=compare).success, samples


class _Shadow:
    """What each picture alone tells, and what would be followed with the first camera alone."""

    def __init__(self, policy: OpenSPMPolicy) -> None:
        memory = policy.require_memory()
        first = next(iter(memory.cameras))
        one_camera = replace(memory, cameras={first: memory.cameras[first]})
        self._eyes = Perception(one_camera, policy.config.hand_radius_m, policy.segmenter)
        self._step_s = step_s(policy.config)
        self.tracker = Tracker(memory.yaw_periods, TrackerSettings())
        self.seen: dict[str, Array] = {}
        self._time_s = self._looked_at_s = 0.0

    def follow(self, observation: Observation, row: EpisodeController) -> None:
        """Look when the policy has looked, hold what it holds."""
        self._time_s += self._step_s
        self.tracker.predict(self._step_s)
        hand = observation.hand.T_world_ee
        if row.scene.has_just_looked:
            estimates = row.scene.detections.estimates
            self.seen |= {name: e.T_world_obj for name, e in estimates.items() if e.status == "found"}
            seen = self._eyes.detect(observation, list(estimates), self.tracker.poses(hand), self._time_s)
            self.tracker.look(seen.estimates, hand, self._time_s - self._looked_at_s)
            self._looked_at_s = self._time_s
        for name in row.scene.tracker.held - self.tracker.held:
            self.tracker.hold(name, hand)
        self.tracker.release(self.tracker.held - row.scene.tracker.held, hand)


def summary(samples: Sequence[Sample]) -> dict[str, Any]:
    """Mean and 95th percentile of position errors, mean of orientation errors, and what was not known."""
    metres, radians = (np.array([sample[i] for sample in samples], float) for i in (4, 5))
    known = np.isfinite(metres)
    if not known.any():
        nothing = dict.fromkeys(("position_mm_mean", "position_mm_p95", "orientation_deg_mean"))
        return {"poses": len(samples), "unknown": len(samples), **nothing}
    return {
        "poses": len(samples),
        "unknown": int((~known).sum()),
        "position_mm_mean": round(1000 * float(metres[known].mean()), 2),
        "position_mm_p95": round(1000 * float(np.percentile(metres[known], 95)), 2),
        "orientation_deg_mean": round(float(np.rad2deg(radians[known].mean())), 2),
    }


def summarise(samples: Mapping[str, Sequence[Sample]]) -> dict[str, Any]:
    """All variants; of the first one also by task, by object, at the start and in the hand."""
    own = samples[VARIANTS[0]]
    overall = summary(own)
    parts = {
        "start": [s for s in own if s[1] == 0],
        "held": [s for s in own if s[3]],
    }
    return {
        **{key: overall[key] for key in ("position_mm_mean", "position_mm_p95", "orientation_deg_mean")},
        "n": overall["poses"],
        "variants": {variant: summary(found) for variant, found in samples.items()},
        **{part: summary(found) for part, found in parts.items()},
        "tasks": _grouped(own, 0),
        "objects": _grouped(own, 2),
    }


def _grouped(samples: Sequence[Sample], by: int) -> dict[str, Any]:
    keys = dict.fromkeys(str(sample[by]) for sample in samples)
    return {key: summary([sample for sample in samples if sample[by] == key]) for key in keys}


def milliseconds(
    policy: OpenSPMPolicy, views: Mapping[str, View], names: Sequence[str], n: int
) -> dict[str, Any]:
    """Time of finding objects in the views of one moment, never seen before and then followed.

    Args:
        policy: Whose objects.
        views: Of one moment.
        names: The objects to find.
        n: Runs.
    """
    objects = [policy.require_memory().objects[name] for name in names]

    def find(expected: Mapping[str, Array]) -> dict[str, Array]:
        look = Look(views, expected=expected)
        return {one.name: one.localise(look).T_world_obj for one in objects}

    found = find({})
    first, followed = _times(lambda: find({}), n), _times(lambda: find(found), n)
    return {"views": len(views), "objects": len(names), "first_ms": first, "followed_ms": followed}


def filter_microseconds(objects: int, n: int = 2000) -> dict[str, float]:
    """Time of one prediction and update of the Kalman filter."""
    T, R = np.tile(np.eye(4), (objects, 1, 1)), np.tile(1e-6 * np.eye(6), (objects, 1, 1))
    belief = kalman.begin(T, R, 0.01, 0.1)
    step = kalman.motion(0.05, TrackerSettings().linear, TrackerSettings().angular)
    times = _times(lambda: kalman.update(kalman.predict(belief, step), T, R), n)
    return {name: round(1000 * value, 1) for name, value in times.items()}


def _times(run: Callable[[], object], n: int) -> dict[str, float]:
    """Milliseconds of a call: median and 99th percentile of n."""
    spent = []
    for _ in range(n + WARM_UP):
        start_s = time.perf_counter()
        run()
        spent.append(1000 * (time.perf_counter() - start_s))
    kept = np.array(spent[WARM_UP:])
    return {"median": round(float(np.median(kept)), 4), "p99": round(float(np.percentile(kept, 99)), 4)}
