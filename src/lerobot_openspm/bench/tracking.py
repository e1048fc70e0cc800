"""How often tasks succeed on the tabletop when objects are moved, dropped, or cameras stand elsewhere."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_openspm.bench.episode import load, run_episode
from lerobot_openspm.bench.tabletop import GRASPED, Disturbance, TabletopWorld, move_cameras
from lerobot_openspm.cli.pipeline import rate
from lerobot_openspm.envs.tabletop.env import TabletopEnv
from lerobot_openspm.envs.tabletop.tasks import TASK_NAMES, select_tasks
from lerobot_openspm.errors import OpenSPMError


@dataclass(frozen=True)
class Condition:
    """What is done to an episode.

    Attributes:
        name: Its name in the results.
        disturbance: "displaced", "dropped", or None.
        tracking: Whether the policy tracks.
        cameras_moved: Whether the fixed cameras stand up to 10 cm and 10 degrees elsewhere, their calibration
            given.
    """

    name: str
    disturbance: str | None = None
    tracking: bool = True
    cameras_moved: bool = False

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks it makes sense for."""
        return TASK_NAMES if self.disturbance is None else tuple(GRASPED)


TRACKING = (
    Condition("displaced", "displaced"),
    Condition("dropped", "dropped"),
    Condition("displaced_untracked", "displaced", tracking=False),
    Condition("dropped_untracked", "dropped", tracking=False),
)
CAMERAS = (Condition("cameras_in_place"), Condition("cameras_moved", cameras_moved=True))


@dataclass(frozen=True)
class Result:
    """One episode; `disturbed_at` is the step of the disturbance, None where the moment for it never came."""

    condition: str
    task: str
    seed: int
    success: bool
    steps: int
    status: str
    attempts: int
    disturbed_at: int | None


def run(checkpoint: str, condition: Condition, task: str, seed: int) -> Result:
    """Run one episode under one condition."""
    policy = load(checkpoint)
    policy.config.tracking = condition.tracking
    env = TabletopEnv(task=task)
    world = TabletopWorld(env, seed)
    rng = np.random.default_rng([seed, TASK_NAMES.index(task)])
    if condition.cameras_moved:
        memory = policy.require_memory()
        policy.memory = replace(memory, cameras=move_cameras(env.simulator, memory.cameras, rng))
    disturbance = Disturbance(world, condition.disturbance, rng) if condition.disturbance else None
    episode = run_episode(policy, world, disturbance)
    env.close()
    return Result(
        condition.name, task, seed, episode.success, len(episode.actions), episode.row.state.status.value,
        episode.row.state.attempts, disturbance.step if disturbance else None,
    )  # fmt: skip


def jobs(
    conditions: Sequence[Condition], selection: str, episodes: int, seed: int
) -> list[tuple[Condition, str, int]]:
    """So many episodes of every condition, the selected tasks in turn, every task from the same seeds.

    Raises:
        OpenSPMError: A condition makes sense for none of the selected tasks.
    """
    found = []
    for condition in conditions:
        tasks = [task for task in select_tasks(selection) if task in condition.tasks]
        if not tasks:
            raise OpenSPMError(
                f"env.task={selection}: nothing can be {condition.name} there, expected some of "
                f"{', '.join(condition.tasks)}"
            )
        found.append([(condition, tasks[i % len(tasks)], seed + i // len(tasks)) for i in range(episodes)])
    # In turns, so that an interrupted run has as many of each.
    return [job for turn in zip(*found, strict=True) for job in turn]


def read(log: Path) -> dict[tuple[str, str, int], Result]:
    """Results that were written down, by condition, task and seed; a torn line is left out."""
    results = {}
    for line in log.read_text().splitlines() if log.exists() else []:
        try:
            result = Result(**json.loads(line))
        except ValueError:
            continue
        results[result.condition, result.task, result.seed] = result
    return results


def write_line(log: Path, result: Result) -> None:
    """Write a result down, on a line of its own even if the one before was torn."""
    torn = log.exists() and not log.read_bytes().endswith(b"\n")
    with log.open("a") as file:
        file.write("\n" * torn + json.dumps(asdict(result)) + "\n")


def summarise(results: Sequence[Result]) -> dict[str, Any]:
    """Success by condition, of the episodes in which what was to be done was done; the others are counted."""
    by_condition: dict[str, list[Result]] = defaultdict(list)
    for result in results:
        by_condition[result.condition].append(result)
    disturbances = {one.name for one in (*TRACKING, *CAMERAS) if one.disturbance}
    summary: dict[str, Any] = {}
    for name, found in by_condition.items():
        counted = [r for r in found if r.disturbed_at is not None or name not in disturbances]
        undisturbed = [r for r in found if r not in counted]
        summary[name] = {
            **rate(sum(result.success for result in counted), len(counted)),
            "undisturbed": len(undisturbed),
            "undisturbed_failed": sum(not result.success for result in undisturbed),
            "failed": [[r.task, r.seed, r.status] for r in counted if not r.success],
        }
    return summary
