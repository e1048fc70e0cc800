"""The steps that `openspm demo` and the benchmarks share: each one a LeRobot command line, run once."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm

import lerobot_openspm
from lerobot_openspm.envs.collection import SUMMARY_FILE, CollectConfig, SimulatorConfig, collect
from lerobot_openspm.envs.tabletop.tasks import TASK_NAMES
from lerobot_openspm.files import write_beside, write_json

logger = logging.getLogger(__name__)

REPO_ID = "local/openspm_tabletop"
TRAIN_CONFIG = Path("configs/openspm_tabletop_train.yaml")
LIBERO_ASSETS = Path("scripts/libero_assets.txt")
# Each process computes with one; several run side by side.
THREADS = 1
# lerobot-eval's own default; demonstrations are recorded from seeds far away from it.
EVALUATION_SEED = 1000
DONE, LOG = "done.json", "output.log"
GEOMETRY = ("geometry/camera.py", "geometry/se3.py")
# The package's files that make a simulator's demonstrations what they are.
RECORDED_BY = {
    "openspm_tabletop": ("envs/*.py", "envs/tabletop/*.py", *GEOMETRY),
    "libero": ("envs/*.py", "envs/libero/*.py", *GEOMETRY),
}


@dataclass(frozen=True)
class Episode:
    """One line of the environment's episode log."""

    task: str
    seed: int
    steps: int
    success: bool
    status: str


def collect_dataset(
    root: Path, demos: int, simulator: str = "openspm_tabletop", task: str = "all"
) -> dict[str, Any]:
    """Record demonstrations, or keep those that are there, finished or not, if the same code made them."""
    logger.info("recording %d demonstrations a task into %s", demos, root)
    # What else lies there is refused by `collect`, not removed.
    if not root.exists() or (root / SUMMARY_FILE).is_file():
        made_of = recorded_by(simulator)
        discard_unless(root, made_of)
        discard_unless(root.with_name(f"{root.name}.partial"), made_of)
    return collect(CollectConfig(SimulatorConfig(simulator, task), demos, str(root)))


def recorded_by(simulator: str) -> str:
    """The digest of what makes a simulator's demonstrations, to be kept beside them."""
    assets = [LIBERO_ASSETS] if simulator == "libero" and LIBERO_ASSETS.is_file() else []
    return digest(assets, [], RECORDED_BY[simulator])


def train(
    dataset: Path, output: Path, options: Sequence[str] = (), config_file: Path = TRAIN_CONFIG
) -> tuple[Path, float | None]:
    """Run lerobot-train, unless its checkpoint is there. Returns the checkpoint and the seconds it took.

    An interrupted run is resumed from its last checkpoint; the seconds are None then.
    """
    checkpoint, done = output / "checkpoints" / "last" / "pretrained_model", output / DONE
    if not config_file.is_file():
        raise FileNotFoundError(f"no {config_file} here: run this from a checkout of the project")
    made_of = digest([config_file, dataset / "meta" / "info.json", dataset / SUMMARY_FILE], options)
    discard_unless(output, made_of)
    if not done.exists():
        start_s = time.monotonic()
        config = checkpoint / "train_config.json"
        resumed = config.exists()
        if resumed:
            run_lerobot("lerobot-train", f"--config_path={config}", "--resume=true")
        else:
            # lerobot-train wants to make its folder itself.
            shutil.rmtree(output, ignore_errors=True)
            run_lerobot(
                "lerobot-train", f"--config_path={config_file}", f"--dataset.root={dataset}",
                f"--output_dir={output}", *options,
            )  # fmt: skip
        # What an interrupted run took before is not known any more.
        write_json(done, {"seconds": None if resumed else round(time.monotonic() - start_s, 1)})
    return checkpoint, json.loads(done.read_text())["seconds"]


def evaluate(
    checkpoint: Path,
    output: Path,
    episodes: int,
    seed: int,
    options: Sequence[str] = (),
    tasks: Sequence[str] = TASK_NAMES,
) -> list[Episode]:
    """Run lerobot-eval on all tasks, or those given, unless it is done. Returns its episodes.

    Two runs share the tasks, one environment each: on two cores that is twice as fast as one run with a batch
    of environments, whose images all pass through one process. An episode is the same either way. Tasks that
    were finished before an interruption are not run again.
    """
    log, seeds = output / "episodes.jsonl", range(seed, seed + episodes)
    made_of = digest([checkpoint / name for name in ("model.safetensors", "memory.json")], options)
    discard_unless(output, made_of)
    output.mkdir(parents=True, exist_ok=True)
    finished = Counter(e.task for e in read_episodes(log, seeds))
    left = [task for task in tasks if finished[task] < episodes]
    command = [
        "lerobot-eval", f"--policy.path={checkpoint}", "--env.type=openspm_tabletop",
        f"--env.episode_log={log.resolve()}", f"--eval.n_episodes={episodes}", "--eval.batch_size=1",
        "--policy.device=cpu", f"--seed={seed}",
    ]  # fmt: skip
    runs = []
    for half, some in enumerate((left[::2], left[1::2])):
        if some:
            folder = output / f"lerobot_eval_{half}"
            own = [f"--env.task={','.join(some)}", f"--output_dir={folder}"]
            runs.append(_started(folder, [*command, *own, *options]))
    _wait(runs, log, len(left) * episodes)
    found = read_episodes(log, seeds)
    if len(found) != len(tasks) * episodes:
        raise RuntimeError(
            f"{log} holds {len(found)} episodes, expected {len(tasks)} tasks x {episodes} seeds; "
            f"delete {output} and run again"
        )
    return found


def digest(files: Sequence[Path], options: Sequence[str], code: Sequence[str] = ("**/*.py",)) -> str:
    """What a result is made of, the code too, so that a kept one is only used again for the same.

    Args:
        files: What it is made of beside the code.
        options: With which settings.
        code: Patterns of the package's files that make it; all if not given.
    """
    found = hashlib.sha256("\n".join(options).encode())
    package = Path(lerobot_openspm.__file__).parent
    for file in [*sorted({path for pattern in code for path in package.glob(pattern)}), *files]:
        found.update(file.read_bytes())
    return found.hexdigest()


def discard_unless(output: Path, made_of: str) -> None:
    """Remove a kept result, finished or not, that was made of something else; note what comes next."""
    # Beside the folder, because lerobot-train insists on making that itself.
    kept = output.with_name(f"{output.name}.sha256")
    if output.exists() and (not kept.exists() or kept.read_text() != made_of):
        logger.info("%s was made of something else; making it anew", output)
        shutil.rmtree(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    write_beside(kept, made_of.encode())


def _started(folder: Path, command: Sequence[str]) -> subprocess.Popen[bytes]:
    """One of LeRobot's command lines, started; what it prints goes to a file in the folder."""
    logger.info("%s", " ".join(command))
    folder.mkdir(exist_ok=True)
    with (folder / LOG).open("wb") as file:
        return subprocess.Popen(_line(command), env=_environment(), stdout=file, stderr=subprocess.STDOUT)


def _wait(runs: Sequence[subprocess.Popen[bytes]], log: Path, total: int) -> None:
    """Show how many episodes are done until all runs are. A failed run stops the others and raises."""
    before = _lines_in(log)
    with tqdm(total=total, desc="Evaluating", unit="episode", disable=not runs) as bar:
        while any(run.poll() is None for run in runs):
            time.sleep(1)
            bar.update(_lines_in(log) - before - bar.n)
        bar.update(_lines_in(log) - before - bar.n)
    if failed := [run for run in runs if run.returncode != 0]:
        raise RuntimeError(
            f"lerobot-eval failed with exit code {failed[0].returncode}; see {LOG} under {log.parent}"
        )


def _lines_in(log: Path) -> int:
    return log.read_text().count("\n") if log.exists() else 0


def read_episodes(log: Path, seeds: Sequence[int]) -> list[Episode]:
    """Episodes of the environment's log, one per task and seed; none if there is no log yet."""
    rows = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    episodes = {(row["task"], row["seed"]): Episode(**row) for row in rows}
    return [episode for (_, seed), episode in episodes.items() if seed in set(seeds)]


def run_lerobot(*command: str) -> None:
    """Run one of LeRobot's command lines in this environment; its progress goes to our stderr."""
    logger.info("%s", " ".join(command))
    subprocess.run(_line(command), check=True, env=_environment(), stdout=sys.stderr)


def _line(command: Sequence[str]) -> list[str]:
    return [str(Path(sys.executable).with_name(command[0])), *command[1:]]


def _environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": str(THREADS), "HF_HUB_OFFLINE": "1"}


def rate(successes: int, n: int) -> dict[str, Any]:
    """A success rate with its 95 % Wilson interval; of no episodes nothing is known."""
    if n == 0:
        return {"success": None, "n": 0, "interval": [0.0, 1.0]}
    interval = binomtest(successes, n).proportion_ci(method="wilson")
    return {
        "success": successes / n,
        "n": n,
        "interval": [round(float(interval.low), 4), round(float(interval.high), 4)],
    }


def success(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Rate, interval, mean steps of the successes (None without one), rate of each task, what failed."""
    own = {task: [e for e in episodes if e.task == task] for task in dict.fromkeys(e.task for e in episodes)}
    return {
        **rate(sum(e.success for e in episodes), len(episodes)),
        "mean_steps": mean_steps(episodes),
        "per_task": {task: sum(e.success for e in es) / len(es) for task, es in own.items()},
        "failed": [[e.task, e.seed, e.status] for e in episodes if not e.success],
    }


def mean_steps(episodes: Sequence[Episode]) -> float | None:
    """Mean steps of the successful episodes, to a tenth; None if there is none."""
    steps = [episode.steps for episode in episodes if episode.success]
    return round(float(np.mean(steps)), 1) if steps else None
