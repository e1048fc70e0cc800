"""How the experts do on LIBERO: of all scenes that were tried for the demonstrations, successes and steps.

    python -m benchmarks.libero.experts

Records what is missing. A demonstration that does not reach the goal is not kept, and another scene is drawn.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from benchmarks.results import run, write
from benchmarks.stages import DEMOS, LIBERO, dataset

from lerobot_openspm.cli.pipeline import rate
from lerobot_openspm.envs.collection import SUMMARY_FILE
from lerobot_openspm.envs.libero.simulator import OBJECTS, scene_kind, tasks


@dataclass
class ExpertsConfig:
    """The figure has no options: it is of the demonstrations that the other figures are learned from."""


def main(_: ExpertsConfig) -> dict[str, Any]:
    """Count, and write what came out down as a published result."""
    recordings = list(_recordings())
    tried: dict[str, list[dict[str, Any]]] = {}
    for recording in recordings:
        for episode in (*recording["episodes"], *recording["discarded"]):
            tried.setdefault(episode["task"], []).append(episode)
    every = [episode for own in tried.values() for episode in own]
    per_task = {task: _told(own) for task, own in tried.items()}
    seed = recordings[0]["settings"]["seed"]
    return write("libero_experts", {"seed": seed, **_told(every), "per_task": per_task})


def _recordings() -> Iterator[dict[str, Any]]:
    """What was noted of each recording: scenes in which cameras and robot stand alike share one."""
    for suite in OBJECTS:
        alike: dict[str, list[str]] = {}
        for task in tasks(suite):
            alike.setdefault(scene_kind(task), []).append(task)
        for own in alike.values():
            yield json.loads((dataset(LIBERO, DEMOS, ",".join(own)) / SUMMARY_FILE).read_text())


def _told(episodes: list[dict[str, Any]]) -> dict[str, Any]:
    steps = [episode["steps"] for episode in episodes if episode["success"]]
    mean = round(sum(steps) / len(steps), 1) if steps else None
    return {**rate(len(steps), len(episodes)), "mean_steps": mean}


if __name__ == "__main__":
    run(ExpertsConfig, main)
