"""Errors of the object poses that the policy found at the start of evaluated episodes."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.libero.stages import REPO_ID
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_openspm.bench.object_frames import error, offset, summary
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.libero.simulator import tasks
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.perception.objects.patches.model import PatchModel
from lerobot_openspm.training import open_demonstrations

# By which angle each object truly turns into itself.
TRUE_PERIODS = {
    "bowl": 0.0,
    "plate": 0.0,
    "wine bottle": 0.0,
    "cream cheese": np.pi,
    "rack": 2 * np.pi,
    "cabinet": 2 * np.pi,
    "stove": 2 * np.pi,
}
NOT_FOUND = (float("nan"), float("nan"))


def accuracy(checkpoint: Path, dataset: Path, episodes: list[dict[str, Any]]) -> dict[str, Any]:
    """Position and yaw errors, over all objects that an episode's task touches, per object and per task.

    ``off_mm`` holds the largest position error of every episode, in their order; None if an object was not
    found.
    """
    memory = read_memory(checkpoint)
    config = OpenSPMConfig(device="cpu", push_to_hub=False, rotation="axis_angle")
    demonstrations = open_demonstrations(LeRobotDatasetMetadata(REPO_ID, root=dataset), config)
    offsets = {name: offset(memory, name, demonstrations) for name in memory.objects}
    # Patches do not measure a yaw: such an object is taken to stand as demonstrated.
    periods = {
        name: 0.0 if isinstance(model, PatchModel) else TRUE_PERIODS[name]
        for name, model in memory.objects.items()
    }
    by_object, by_task = defaultdict(list), defaultdict(list)
    off_mm = []
    for episode in episodes:
        off = [0.0]
        for name, true in episode["true"].items():
            seen = episode["seen"].get(name)
            one = NOT_FOUND if seen is None else error(_pose(true), _pose(seen), offsets[name], periods[name])
            by_object[name].append(one)
            by_task[episode["task"]].append(one)
            off.append(one[0])
        off_mm.append(None if np.isnan(off).any() else round(1000 * max(off), 1))
    everything = 1000 * np.concatenate([np.array(found)[:, 0] for found in by_object.values()])
    known = [task for task in tasks() if task in by_task]
    return {
        "position_mm_mean": round(float(np.nanmean(everything)), 2),
        "position_mm_p95": round(float(np.nanpercentile(everything, 95)), 2),
        "objects": {name: summary(np.array(found), periods[name]) for name, found in by_object.items()},
        "off_mm": off_mm,
        "tasks": {task: summary(np.array(by_task[task]), _turning(by_task[task])) for task in known},
    }


def _turning(errors: list[tuple[float, float]]) -> float:
    """A period for a summary: 0 if no object of a task has a yaw that is measured."""
    return 0.0 if np.isnan(np.array(errors)[:, 1]).all() else 2 * np.pi


def _pose(place: list[float]) -> np.ndarray:
    return se3.from_yaw(place[:3], place[3])
