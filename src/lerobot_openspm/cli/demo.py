"""`openspm demo`: the main job end to end, from recorded demonstrations to one page about the result."""

from __future__ import annotations

import json
import os
import platform
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus

from lerobot_openspm.cli.pipeline import EVALUATION_SEED, collect_dataset, evaluate, mean_steps, rate, train
from lerobot_openspm.cli.report import write_report


@dataclass
class DemoConfig:
    """Collect, train, evaluate, and write one page about it. Finished steps are kept and not done again.

    Args:
        demos: Demonstrations a task.
        episodes: Evaluation episodes a task.
        output: Folder for everything.
        started_at: When the set-up began, in seconds since the epoch; counts towards ``total_s``.
    """

    demos: int = 10
    episodes: int = 20
    output: str = "outputs/demo"
    started_at: float | None = None

    def __post_init__(self) -> None:
        if self.demos < 1 or self.episodes < 1:
            raise ValueError(f"demos and episodes must be at least 1, got {self.demos} and {self.episodes}")


def main(args: list[str]) -> None:
    """Run the demo and print one JSON object."""
    config = draccus.parse(DemoConfig, args=args)
    start_s = config.started_at or time.time()
    output = Path(config.output)
    # What is kept from an earlier run is kept by what it was made of.
    run = output / f"demos_{config.demos}"
    dataset = run / "dataset"
    collected = collect_dataset(dataset, config.demos)
    checkpoint, train_s = train(dataset, run / "train")
    evaluation = run / f"eval_{config.episodes}"
    episodes = evaluate(checkpoint, evaluation, config.episodes, EVALUATION_SEED)
    result: dict[str, Any] = {
        **rate(sum(e.success for e in episodes), len(episodes)),
        "mean_steps": mean_steps(episodes),
        "train_s": train_s,
        "demos": config.demos,
        "episodes": config.episodes,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "expert_steps": collected["frames"] / collected["episodes"],
    }
    report = write_report(run / "report", result, episodes, dataset, checkpoint, evaluation)
    summary = {
        "success": round(result["success"], 4),
        "n": result["n"],
        "mean_steps": result["mean_steps"],
        "train_s": train_s,
        "total_s": round(time.time() - start_s, 1),
        "checkpoint": str(checkpoint),
        "report": str(report),
    }
    print(f"the page: {report}")
    print(json.dumps(summary))
