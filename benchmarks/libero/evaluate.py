"""Evaluate a checkpoint on libero_goal's 50 initial states a task, resumably and without needless rendering.

    python -m benchmarks.libero.evaluate --checkpoint=FOLDER --output=FOLDER

An episode is the one of `lerobot-eval --env.type=libero --env.task=libero_goal --seed=1000` with one
environment: initial state i, seed 1000 + i, ten settling steps, at most 300 steps. `equality.py` compares the
two action by action. Every episode is written down as it ends; a second run does the rest.
"""

from __future__ import annotations

import gc
import json
import logging
import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from benchmarks.libero.episode import Episode, initial_states, run_episode
from tqdm import tqdm

from lerobot_openspm.cli.pipeline import digest, rate
from lerobot_openspm.control.state import Status
from lerobot_openspm.envs.libero.simulator import LiberoSimulator, tasks
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.files import write_beside
from lerobot_openspm.geometry import se3
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.types import Execution

logger = logging.getLogger(__name__)

SEED = 1000
# Tuning scenes of the benchmark, apart from those that tests use.
TUNING_SEED = TUNING_SEED_START + 100_000


@dataclass
class EvaluationConfig:
    """What to evaluate.

    Args:
        checkpoint: Folder of the policy.
        output: Folder for episodes.jsonl.
        task: A task's name, several with commas, or "all".
        episodes: Initial states a task, from the first on.
        tuning: Draw as many scenes from tuning seeds instead of taking the benchmark's initial states.
        tuning_seed: The first of those seeds.
        processes: Episodes at a time, each in a process of its own; a single one stays in this process.
        image_size: Pixels; lerobot-eval's default.
        execution: Of the policy; the checkpoint's if not given.
    """

    checkpoint: str
    output: str
    task: str = "all"
    episodes: int = 50
    tuning: bool = False
    tuning_seed: int = TUNING_SEED
    processes: int = 2
    image_size: int = 360
    execution: Execution | None = None


# Settings, task, number of the initial state.
type Job = tuple[EvaluationConfig, str, int]


def evaluate(config: EvaluationConfig) -> list[dict[str, Any]]:
    """Run the episodes that are missing, and return all of them.

    Episodes of another policy, other settings or other code are set aside, not mixed in.
    """
    output = Path(config.output)
    output.mkdir(parents=True, exist_ok=True)
    log = output / "episodes.jsonl"
    _set_others_aside(config, output, log)
    _drop_torn_line(log)
    wanted = list(tasks()) if config.task == "all" else config.task.split(",")
    if unknown := [task for task in wanted if task not in tasks()]:
        raise ValueError(f"libero_goal has no tasks {unknown}, expected some of {', '.join(tasks())}")
    done = {(e["task"], e["state"]) for e in _read(log)}
    jobs = [(config, task, i) for task in wanted for i in range(config.episodes) if (task, i) not in done]
    with log.open("a") as file:
        for episode in tqdm(_run(jobs, config.processes), total=len(jobs), unit="episode", disable=not jobs):
            file.write(json.dumps(episode) + "\n")
            file.flush()
    return [e for e in _read(log) if e["task"] in wanted and e["state"] < config.episodes]


def _run(jobs: Sequence[Job], processes: int) -> Iterator[dict[str, Any]]:
    if processes == 1:
        yield from map(evaluate_one, jobs)
    else:
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            yield from pool.imap_unordered(evaluate_one, jobs)


def _set_others_aside(config: EvaluationConfig, output: Path, log: Path) -> None:
    """Keep apart what was made of something else, and note what the next episodes are made of."""
    files = [Path(config.checkpoint) / name for name in ("model.safetensors", "memory.json", "config.json")]
    code = [Path(__file__), Path(__file__).with_name("episode.py")]
    keys = ("tuning", "tuning_seed", "image_size", "execution")
    settings = [f"{key}={getattr(config, key)}" for key in keys]
    made_of, kept = digest([*code, *files], settings), output / "made_of.sha256"
    if log.exists() and (not kept.exists() or kept.read_text() != made_of):
        aside = next(p for i in count(1) if not (p := output / f"episodes_before_{i}.jsonl").exists())
        logger.warning("%s holds episodes of another policy, settings or code; set aside as %s", log, aside)
        log.rename(aside)
    write_beside(kept, made_of.encode())


def _drop_torn_line(log: Path) -> None:
    """Forget an episode that was being written when a run was killed; it is run again."""
    if log.exists() and (text := log.read_text()) and not text.endswith("\n"):
        write_beside(log, text[: text.rfind("\n") + 1].encode())


def summary(episodes: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates over all episodes and per task, and which of them failed."""
    names = dict.fromkeys(e["task"] for e in episodes)
    own = {
        task: [e for e in episodes if e["task"] == task] for task in sorted(names, key=list(tasks()).index)
    }
    return {
        **rate(sum(e["success"] for e in episodes), len(episodes)),
        "mean_steps": mean_steps(episodes),
        "per_task": {
            task: {**rate(sum(e["success"] for e in es), len(es)), "mean_steps": mean_steps(es)}
            for task, es in own.items()
        },
        "failed": [
            {**{key: e[key] for key in ("task", "state", "seed", "attempts")}, "reason": reason(e)}
            for e in episodes
            if not e["success"]
        ],
    }


def reason(episode: dict[str, Any]) -> str:
    """Why an episode failed, as far as the policy can tell."""
    match episode["status"]:
        case Status.DONE:
            return "every key pose was met, but the goal does not hold"
        case Status.RUNNING | Status.PAUSED:
            return f"time was up at {episode['phase']}"
        case Status.NO_PROGRESS:
            return f"gave up at {episode['phase']}"
        case status:
            return status.replace("_", " ")


def mean_steps(episodes: list[dict[str, Any]]) -> float | None:
    """Mean steps of the successes; None if there is none."""
    steps = [e["steps"] for e in episodes if e["success"]]
    return round(float(np.mean(steps)), 1) if steps else None


def evaluate_one(job: Job) -> dict[str, Any]:
    """Run one episode, with a policy and a simulator kept by the process."""
    config, task, state = job
    policy, simulator = _policy(config), _simulator(task, config.image_size)
    seed = (config.tuning_seed if config.tuning else SEED) + state
    if config.tuning:
        simulator.reset(seed)
        _move_hand(simulator, np.random.default_rng(seed))
    else:
        simulator.reset_to(seed, initial_states(task)[state])
    return {"task": task, "state": state, "seed": seed, **_told(run_episode(policy, simulator))}


def _move_hand(simulator: LiberoSimulator, rng: np.random.Generator) -> None:
    """Begin elsewhere, as the benchmark's own states do; a seeded reset always begins in the same place."""
    towards = rng.uniform(-0.6, 0.6, size=3)
    for share in (1.0, 1.0, 1.0, 0.0, 0.0):
        simulator.step(np.array([*(share * towards), 0.0, 0.0, 0.0, -1.0]))


def _told(episode: Episode) -> dict[str, Any]:
    """An episode as a line of JSON."""
    state, targets = episode.row.state, episode.row.executor.targets
    return {
        "steps": len(episode.actions),
        "success": episode.success,
        "status": str(state.status),
        "key_pose": state.index,
        "phase": targets[state.index].key_pose.phase if targets else None,
        "attempts": state.attempts,
        "entry": state.ranked[0].entry.source if state.ranked else None,
        "seen": {name: _place(T) for name, T in episode.seen.items()},
        "true": {name: _place(T) for name, T in episode.true.items()},
    }


def _place(T_world_obj: np.ndarray) -> list[float]:
    """Position in metres and yaw in radians."""
    return [round(float(x), 5) for x in (*T_world_obj[:3, 3], se3.yaw_of(T_world_obj))]


_KEPT: dict[str, Any] = {}


def _policy(config: EvaluationConfig) -> OpenSPMPolicy:
    if "policy" not in _KEPT:
        torch.set_num_threads(1)
        _KEPT["policy"] = OpenSPMPolicy.from_pretrained(config.checkpoint)
        # robosuite collects garbage at every reset; it need not look through all modules each time.
        gc.freeze()
        if config.execution:
            _KEPT["policy"].config.execution = config.execution
    return _KEPT["policy"]


def _simulator(task: str, image_size: int) -> LiberoSimulator:
    if _KEPT.get("task") != task:
        if "simulator" in _KEPT:
            _KEPT["simulator"].close()
        _KEPT.update(task=task, simulator=LiberoSimulator(task, image_size))
    return _KEPT["simulator"]


def _read(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


if __name__ == "__main__":
    os.environ.setdefault("MUJOCO_GL", "egl")
    print(json.dumps(summary(evaluate(draccus.parse(EvaluationConfig, args=sys.argv[1:])))))
