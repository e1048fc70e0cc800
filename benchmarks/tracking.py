"""Success on the tabletop when objects are moved, dropped, or cameras stand elsewhere.

python -m benchmarks.tracking --figure=tracking   # objects displaced or dropped, with and without tracking
python -m benchmarks.tracking --figure=cameras    # cameras up to 10 cm and 10 degrees elsewhere, calibrated
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.disturbances import GRASPED, Disturbance, move_cameras
from benchmarks.episodes import load, run_episode
from benchmarks.harness import Row, checkpoint_files, measured_folder, resume
from benchmarks.results import run, write
from benchmarks.stages import TABLETOP, CheckpointConfig
from benchmarks.worlds import tabletop
from lerobot_openspm.cli.pipeline import THREADS, rate
from lerobot_openspm.envs.tabletop.tasks import TASK_NAMES
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


CONDITIONS = {
    "tracking": (
        Condition("displaced", "displaced"),
        Condition("dropped", "dropped"),
        Condition("displaced_untracked", "displaced", tracking=False),
        Condition("dropped_untracked", "dropped", tracking=False),
    ),
    "cameras": (Condition("cameras_in_place"), Condition("cameras_moved", cameras_moved=True)),
}


@dataclass
class TrackingConfig(CheckpointConfig):
    """Disturb a checkpoint's episodes on the tabletop.

    Args:
        figure: What is disturbed: "tracking" (the objects), or "cameras".
    """

    figure: str = "tracking"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.figure not in CONDITIONS:
            raise ValueError(f"figure is {self.figure!r}, expected one of {', '.join(CONDITIONS)}")
        if self.env.type != TABLETOP:
            raise ValueError(f"the tabletop alone is disturbed, got env.type={self.env.type}")


def main(config: TrackingConfig) -> dict[str, Any]:
    """Measure, write and return the result."""
    jobs, checkpoint = jobs_of(config), config.checkpoint()
    folder = measured_folder(config.folder(config.figure), checkpoint_files(checkpoint), [], __file__)
    rows = resume(
        folder / "episodes.jsonl",
        {f"{one.name} {task} {seed}": (str(checkpoint), one, task, seed) for one, task, seed in jobs},
        disturbed_episode,
        config.workers,
    )
    found = summarise(rows)
    successes = {f"success_{name}": one["success"] for name, one in found.items()}
    n = min(one["n"] for one in found.values())
    return write(config.figure, {"seed": config.seed, **successes, "n": n, "conditions": found}, THREADS)


def jobs_of(config: TrackingConfig) -> list[tuple[Condition, str, int]]:
    """So many episodes of every condition, the selected tasks in turn, every task from the same seeds.

    Raises:
        OpenSPMError: A condition makes sense for none of the selected tasks.
    """
    found = []
    for condition in CONDITIONS[config.figure]:
        tasks = [task for task in config.env.tasks() if task in condition.tasks]
        if not tasks:
            raise OpenSPMError(
                f"env.task={config.env.task}: nothing can be {condition.name} there, expected some of "
                f"{', '.join(condition.tasks)}"
            )
        found.append([(condition, *turn) for turn in config.turns(tasks)])
    # In turns, so that an interrupted run has as many of each.
    return [job for turn in zip(*found, strict=True) for job in turn]


def disturbed_episode(checkpoint: str, condition: Condition, task: str, seed: int) -> Row:
    """Run one episode under one condition; `disturbed_at` is None if the moment for it never came."""
    policy = load(checkpoint)
    policy.config.tracking = condition.tracking
    rng = np.random.default_rng([seed, TASK_NAMES.index(task)])
    with tabletop(task, seed) as world:
        if condition.cameras_moved:
            memory = policy.require_memory()
            policy.memory = replace(memory, cameras=move_cameras(world.env.simulator, memory.cameras, rng))
        disturbance = Disturbance(world, condition.disturbance, rng) if condition.disturbance else None
        told = run_episode(policy, world, disturbance).told()
    disturbed_at = disturbance.step if disturbance else None
    return {"condition": condition.name, "task": task, "seed": seed, **told, "disturbed_at": disturbed_at}


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Success by condition, of the episodes in which what was to be done was done; the others are counted."""
    disturbances = {one.name for ones in CONDITIONS.values() for one in ones if one.disturbance}
    summary: dict[str, Any] = {}
    for name in dict.fromkeys(row["condition"] for row in rows):
        own = [row for row in rows if row["condition"] == name]
        counted = [row for row in own if row["disturbed_at"] is not None or name not in disturbances]
        undisturbed = [row for row in own if row not in counted]
        summary[name] = {
            **rate(sum(row["success"] for row in counted), len(counted)),
            "undisturbed": len(undisturbed),
            "undisturbed_failed": sum(not row["success"] for row in undisturbed),
            "failed": [[row["task"], row["seed"], row["status"]] for row in counted if not row["success"]],
        }
    return summary


if __name__ == "__main__":
    run(TrackingConfig, main)
