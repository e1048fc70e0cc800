"""The steps that `openspm demo` and the benchmarks share: each one a LeRobot command line, run once."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from lerobot_openspm.cli.collect import CollectConfig, collect

logger = logging.getLogger(__name__)

REPO_ID = "local/openspm_tabletop"
CAMERAS = Path("configs/cameras/openspm_tabletop.json")
TRAIN_CONFIG = Path("configs/openspm_tabletop_train.yaml")
DONE = "done.json"


@dataclass(frozen=True)
class Episode:
    """One line of the environment's episode log."""

    task: str
    seed: int
    steps: int
    success: bool
    status: str


def collect_dataset(root: Path, demos: int) -> dict[str, Any]:
    """Record demonstrations, or keep those that are there."""
    logger.info("recording %d demonstrations a task into %s", demos, root)
    return collect(CollectConfig(episodes=demos, root=str(root), repo_id=REPO_ID))


def train(dataset: Path, output: Path, options: Sequence[str] = ()) -> tuple[Path, float]:
    """Run lerobot-train, unless its checkpoint is there. Returns the checkpoint and the seconds it took."""
    checkpoint, done = output / "checkpoints" / "last" / "pretrained_model", output / DONE
    if not done.exists():
        shutil.rmtree(output, ignore_errors=True)  # an interrupted run
        start_s = time.monotonic()
        run_lerobot(
            "lerobot-train", f"--config_path={TRAIN_CONFIG}", f"--dataset.root={dataset}",
            f"--output_dir={output}", *options,
        )  # fmt: skip
        done.write_text(json.dumps({"seconds": round(time.monotonic() - start_s, 1)}))
    return checkpoint, float(json.loads(done.read_text())["seconds"])


def evaluate(
    checkpoint: Path, output: Path, episodes: int, seed: int, options: Sequence[str] = ()
) -> list[Episode]:
    """Run lerobot-eval on all tasks, unless it is done. Returns its episodes."""
    done, log = output / DONE, output / "episodes.jsonl"
    if not done.exists():
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir(parents=True)
        run_lerobot(
            "lerobot-eval", f"--policy.path={checkpoint}", "--env.type=openspm_tabletop", "--env.task=all",
            f"--env.episode_log={log.resolve()}", f"--eval.n_episodes={episodes}",
            f"--eval.batch_size={min(episodes, 4)}", "--eval.use_async_envs=true", "--policy.device=cpu",
            f"--seed={seed}", f"--output_dir={output / 'lerobot_eval'}", *options,
        )  # fmt: skip
        done.write_text("{}")
    return read_episodes(log, range(seed, seed + episodes))


def read_episodes(log: Path, seeds: Sequence[int]) -> list[Episode]:
    """Episodes of the environment's log, one per task and seed."""
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    episodes = {(row["task"], row["seed"]): Episode(**row) for row in rows}
    return [episode for (_, seed), episode in episodes.items() if seed in set(seeds)]


def run_lerobot(command: str, *options: str) -> None:
    """Run one of LeRobot's command lines in this environment; its progress goes to our stderr."""
    line = [str(Path(sys.executable).with_name(command)), *options]
    logger.info("%s", " ".join([command, *options]))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    subprocess.run(line, check=True, env=environment, stdout=sys.stderr)


def rate(successes: int, n: int) -> dict[str, Any]:
    """A success rate with its 95 % Wilson interval."""
    interval = binomtest(successes, n).proportion_ci(method="wilson")
    return {"success": successes / n, "n": n, "interval": [round(interval.low, 4), round(interval.high, 4)]}


def mean_steps(episodes: Sequence[Episode]) -> float:
    """Mean steps of the successful episodes; NaN if there is none."""
    return (
        float(np.mean([e.steps for e in episodes if e.success]))
        if any(e.success for e in episodes)
        else float("nan")
    )
