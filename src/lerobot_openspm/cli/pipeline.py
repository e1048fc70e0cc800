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
from tqdm import tqdm

from lerobot_openspm.cli.collect import CollectConfig, collect
from lerobot_openspm.envs.tasks import TASK_NAMES

logger = logging.getLogger(__name__)

REPO_ID = "local/openspm_tabletop"
TRAIN_CONFIG = Path("configs/openspm_tabletop_train.yaml")
DONE, LOG = "done.json", "output.log"


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
    if not TRAIN_CONFIG.is_file():
        raise FileNotFoundError(f"no {TRAIN_CONFIG} here: run this from a checkout of the project")
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
    """Run lerobot-eval on all tasks, unless it is done. Returns its episodes.

    Two runs share the tasks, one environment each: on two cores that is twice as fast as one run with a batch
    of environments, whose images all pass through one process. An episode is the same either way.
    """
    done, log = output / DONE, output / "episodes.jsonl"
    if not done.exists():
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir(parents=True)
        runs = [
            _start_evaluation(
                checkpoint, output / f"lerobot_eval_{half}", tasks, log, episodes, seed, options
            )
            for half, tasks in enumerate((TASK_NAMES[::2], TASK_NAMES[1::2]))
        ]
        _wait(runs, log, episodes * len(TASK_NAMES))
        done.write_text("{}")
    return read_episodes(log, range(seed, seed + episodes))


def _start_evaluation(
    checkpoint: Path,
    folder: Path,
    tasks: Sequence[str],
    log: Path,
    episodes: int,
    seed: int,
    options: Sequence[str],
) -> subprocess.Popen[bytes]:
    command = [
        "lerobot-eval", f"--policy.path={checkpoint}", "--env.type=openspm_tabletop",
        f"--env.task={','.join(tasks)}", f"--env.episode_log={log.resolve()}",
        f"--eval.n_episodes={episodes}", "--eval.batch_size=1", "--policy.device=cpu",
        f"--seed={seed}", f"--output_dir={folder}", *options,
    ]  # fmt: skip
    logger.info("%s", " ".join(command))
    folder.mkdir()
    with (folder / LOG).open("wb") as file:
        return subprocess.Popen(_line(command), env=_environment(), stdout=file, stderr=subprocess.STDOUT)


def _wait(runs: Sequence[subprocess.Popen[bytes]], log: Path, total: int) -> None:
    """Show how many episodes are done until all runs are. A failed run stops the others and raises."""
    with tqdm(total=total, desc="Evaluating", unit="episode") as bar:
        while any(run.poll() is None for run in runs):
            time.sleep(1)
            bar.update((log.read_text().count("\n") if log.exists() else 0) - bar.n)
            if failed := [run for run in runs if run.poll() not in (None, 0)]:
                for run in runs:
                    run.kill()
                raise RuntimeError(
                    f"lerobot-eval failed with exit code {failed[0].returncode}; see {LOG} in {log.parent}/*"
                )


def read_episodes(log: Path, seeds: Sequence[int]) -> list[Episode]:
    """Episodes of the environment's log, one per task and seed."""
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    episodes = {(row["task"], row["seed"]): Episode(**row) for row in rows}
    kept = [episode for (_, seed), episode in episodes.items() if seed in set(seeds)]
    if len(kept) != len(TASK_NAMES) * len(seeds):
        raise RuntimeError(
            f"{log} holds {len(kept)} episodes, expected {len(TASK_NAMES)} tasks x {len(seeds)} "
            f"seeds; delete {log.parent} and run again"
        )
    return kept


def run_lerobot(*command: str) -> None:
    """Run one of LeRobot's command lines in this environment; its progress goes to our stderr."""
    logger.info("%s", " ".join(command))
    subprocess.run(_line(command), check=True, env=_environment(), stdout=sys.stderr)


def _line(command: Sequence[str]) -> list[str]:
    return [str(Path(sys.executable).with_name(command[0])), *command[1:]]


def _environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}


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
