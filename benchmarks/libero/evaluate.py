"""Evaluate a checkpoint on libero_goal's 50 initial states a task, resumably and without needless rendering.

    python benchmarks/libero/evaluate.py --checkpoint=FOLDER --output=FOLDER

An episode is meant to be the one of `lerobot-eval --env.type=libero --env.task=libero_goal --seed=1000`
with one environment (initial state i, seed 1000 + i, ten settling steps, at most 300 steps); the two have not
been compared action by action yet. Images are rendered only when the policy looks at them. Every episode is
written down as it ends; a second run does the rest.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))
from common import write

from lerobot_openspm.cli.pipeline import rate
from lerobot_openspm.control.executor import Execution, Hand
from lerobot_openspm.envs.libero.simulator import CAMERAS, LiberoSimulator, tasks
from lerobot_openspm.envs.recording import pose_vector
from lerobot_openspm.experience import load_experience
from lerobot_openspm.files import write_json
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.observation import Observation

SEED, MAX_STEPS = 1000, 300


@dataclass
class EvaluationConfig:
    """What to evaluate.

    Args:
        checkpoint: Folder of the policy.
        output: Folder for episodes.jsonl.
        task: A task's name, several with commas, or "all".
        episodes: Initial states a task, from the first on.
        tuning: Draw as many scenes from tuning seeds instead of taking the benchmark's initial states.
        processes: Tasks at a time.
        image_size: Pixels; lerobot-eval's default.
        execution: Of the policy; the checkpoint's if not given.
        result: Name of the file under benchmarks/results to write the rates to; none if not given.
        note: What a reader of that file has to know, such as stand-ins for assets that were not to be had.
    """

    checkpoint: str
    output: str
    task: str = "all"
    episodes: int = 50
    tuning: bool = False
    processes: int = 2
    image_size: int = 360
    execution: Execution | None = None
    result: str | None = None
    note: str = ""


class LazyImages(Mapping[str, torch.Tensor]):
    """The present images by LeRobot's names, rendered when one is asked for."""

    def __init__(self, simulator: LiberoSimulator) -> None:
        self._simulator = simulator
        self._made: dict[str, torch.Tensor] = {}

    def __getitem__(self, key: str) -> torch.Tensor:
        if key not in self._made:
            image = torch.from_numpy(self._simulator.image(key.removeprefix("observation.images.")))
            self._made[key] = image.permute(2, 0, 1).contiguous().float() / 255
        return self._made[key]

    def __iter__(self) -> Iterator[str]:
        return iter([f"observation.images.{name}" for name in CAMERAS])

    def __len__(self) -> int:
        return len(CAMERAS)


def main(config: EvaluationConfig) -> dict[str, Any]:
    """Evaluate what is missing, and return the rates."""
    output = Path(config.output)
    output.mkdir(parents=True, exist_ok=True)
    log = output / "episodes.jsonl"
    _refuse_others(config, output)
    wanted = list(tasks()) if config.task == "all" else config.task.split(",")
    done = {(e["task"], e["state"]) for e in _read(log)}
    jobs = [(config, task, i) for task in wanted for i in range(config.episodes) if (task, i) not in done]
    context = multiprocessing.get_context("spawn")
    with context.Pool(config.processes) as pool, log.open("a") as file:
        for episode in tqdm(pool.imap_unordered(evaluate_one, jobs), total=len(jobs), unit="episode"):
            file.write(json.dumps(episode) + "\n")
            file.flush()
    episodes = [e for e in _read(log) if e["task"] in wanted and e["state"] < config.episodes]
    result = _summary(config, episodes, wanted)
    return write(config.result, result) if config.result else result


def _refuse_others(config: EvaluationConfig, output: Path) -> None:
    """Keep episodes of different policies or settings apart.

    Raises:
        FileExistsError: The folder holds episodes of something else.
    """
    files = [Path(config.checkpoint) / name for name in ("model.safetensors", "memory.json")]
    made_of = {
        "policy": [hashlib.sha256(file.read_bytes()).hexdigest() for file in files],
        **{key: getattr(config, key) for key in ("tuning", "image_size", "execution")},
    }
    kept = output / "made_of.json"
    if kept.exists() and json.loads(kept.read_text()) != made_of:
        raise FileExistsError(
            f"{output} holds episodes of another policy or settings; choose another --output"
        )
    write_json(kept, made_of)


def _summary(config: EvaluationConfig, episodes: list[dict[str, Any]], wanted: list[str]) -> dict[str, Any]:
    """Rates over all and per task, and how many demonstrations stand behind them."""
    entries = Counter(entry.language for entry in load_experience(Path(config.checkpoint)).entries)
    own = {task: [e for e in episodes if e["task"] == task] for task in wanted}
    return {
        **rate(sum(e["success"] for e in episodes), len(episodes)),
        "mean_steps": round(float(np.mean([e["steps"] for e in episodes if e["success"]] or [np.nan])), 1),
        "demonstrations": sorted(set(entries.values())),
        "image_size": config.image_size,
        "states": "tuning seeds" if config.tuning else "evaluation",
        "note": config.note,
        "per_task": {
            task: {
                "success": sum(e["success"] for e in es) / len(es),
                "n": len(es),
                "mean_steps": round(float(np.mean([e["steps"] for e in es if e["success"]] or [np.nan])), 1),
            }
            for task, es in own.items()
        },
        "failed": [
            [e["task"], e["state"], e["status"], e["phase"], e["attempts"]]
            for e in episodes
            if not e["success"]
        ],
    }


def evaluate_one(job: tuple[EvaluationConfig, str, int]) -> dict[str, Any]:
    """Run one episode, with a policy and a simulator kept by the process."""
    config, task, state = job
    policy, simulator = _policy(config), _simulator(task, config.image_size)
    if config.tuning:
        from lerobot_openspm.envs.seeds import TUNING_SEED_START

        simulator.reset(TUNING_SEED_START + 100_000 + state)
    else:
        simulator.reset_to(SEED + state, _initial_states(task)[state])
    policy.reset()
    state_layout = policy.config.layouts()[0]
    success, steps = False, 0
    while not success and steps < MAX_STEPS:
        vector = simulator.state().astype(float)
        hand = Hand(state_layout.poses(vector), float(state_layout.openings(vector)))
        poses = pose_vector(simulator.object_poses()) if policy.config.perception == "oracle" else None
        with torch.inference_mode():
            action = policy.act(
                [Observation(simulator.instruction, vector, hand, LazyImages(simulator), poses)]
            )[0]
        success = simulator.step(np.clip(action, -1.0, 1.0))
        steps += 1
    row = policy._rows[0]
    return {
        "task": task,
        "state": state,
        "steps": steps,
        "success": success,
        "status": str(row.status),
        "key_pose": row.executor.index,
        "phase": row.executor.plan[row.executor.index].memory.phase if row.executor.plan else None,
        "attempts": row.executor.attempts,
        "entry": row.ranked[0].entry.source if row.ranked else None,
    }


_KEPT: dict[str, Any] = {}


def _policy(config: EvaluationConfig) -> OpenSPMPolicy:
    if "policy" not in _KEPT:
        torch.set_num_threads(1)
        _KEPT["policy"] = OpenSPMPolicy.from_pretrained(config.checkpoint)
        if config.execution:
            _KEPT["policy"].config.execution = config.execution
    return _KEPT["policy"]


def _simulator(task: str, image_size: int) -> LiberoSimulator:
    if _KEPT.get("task") != task:
        if "simulator" in _KEPT:
            _KEPT["simulator"].close()
        _KEPT.update(task=task, simulator=LiberoSimulator(task, image_size, render_steps=False))
    return _KEPT["simulator"]


def _initial_states(task: str) -> np.ndarray:
    from lerobot.envs.libero import _get_suite, get_task_init_states

    suite = _get_suite("libero_goal")
    return np.asarray(get_task_init_states(suite, [one.name for one in suite.tasks].index(task)))


def _read(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


if __name__ == "__main__":
    os.environ.setdefault("MUJOCO_GL", "egl")
    print(json.dumps(main(draccus.parse(EvaluationConfig, args=sys.argv[1:]))))
