"""Errors of the object poses that the policy found at the start of evaluated episodes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness import Row
from benchmarks.stages import LIBERO
from benchmarks.truth import Error, middle, offsets, pose_error, summary, true_period

from lerobot_openspm.envs.libero.simulator import suite_of, tasks
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.perception.objects.patches.model import PatchModel


def found_errors(checkpoint: Path, dataset: Path, episodes: Sequence[Row]) -> list[dict[str, Error]]:
    """For every episode the errors of all objects that its task touches, by name."""
    models, T_sim_obj = read_memory(checkpoint).objects, offsets(checkpoint, dataset)

    def error(name: str, true: Sequence[float], seen: Sequence[float] | None) -> Error:
        if seen is None or name not in T_sim_obj:
            return None, None
        period = true_period(name, LIBERO)
        T_true, T = (se3.from_yaw(place[:3], place[3]) for place in (true, seen))
        # What is round is where its middle is, however it is found turned.
        T_obj_middle = middle(models[name])
        T_true_middle = T_true @ T_sim_obj[name] @ T_obj_middle
        metres, radians = pose_error(T_true_middle, T @ T_obj_middle, period)
        # Patches do not measure a yaw, and a round object has none.
        is_turned = period > 0 and not isinstance(models[name], PatchModel)
        return metres, radians if is_turned else None

    return [
        {name: error(name, true, episode["seen"].get(name)) for name, true in episode["true"].items()}
        for episode in episodes
    ]


def accuracy(episodes: Sequence[Row], errors: Sequence[Mapping[str, Error]]) -> dict[str, Any]:
    """Position and yaw errors, over all objects that an episode's task touches, per object and per task.

    ``off_mm`` holds the largest position error of every episode, in their order; None if an object was not
    found. ``found_off_mm`` holds that of the objects that were found.
    """
    by_object, by_task = defaultdict[str, list[Error]](list), defaultdict[str, list[Error]](list)
    off_mm, found_off_mm = list[float | None](), list[float]()
    for episode, found in zip(episodes, errors, strict=True):
        for name, error in found.items():
            by_object[name].append(error)
        by_task[episode["task"]] += found.values()
        metres = [metres for metres, _ in found.values() if metres is not None]
        is_complete = len(metres) == len(found)
        found_off_mm.append(round(1000 * max(metres, default=0.0), 1))
        off_mm.append(found_off_mm[-1] if is_complete else None)
    overall = summary([error for some in by_object.values() for error in some])
    order = tasks(suite_of(episodes[0]["task"]))
    return {
        **{key: overall[key] for key in ("position_mm_mean", "position_mm_p95")},
        "objects": {name: summary(some) for name, some in by_object.items()},
        "off_mm": off_mm,
        "found_off_mm": found_off_mm,
        "tasks": {task: summary(by_task[task]) for task in order if task in by_task},
    }
