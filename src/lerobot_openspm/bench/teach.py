"""How often a task succeeds that was only taught, to a policy that was trained on the other tasks.

For every task of the tabletop a policy is trained on the demonstrations of the nine others, with the options
of ``configs/openspm_tabletop_train.yaml``; the task's first demonstrations in the dataset are then taught to
it, and it is evaluated on that task. Everything is kept in the output folder, so an interrupted run goes on.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_openspm.bench.results import ResultOption
from lerobot_openspm.bench.workers import each
from lerobot_openspm.cli.bench import DEFAULTS, DatasetOption, EnvironmentOption
from lerobot_openspm.envs.tabletop.tasks import TASKS, select_tasks
from lerobot_openspm.errors import DatasetError, OpenSPMError
from lerobot_openspm.files import write_json

logger = logging.getLogger(__name__)

# Seeds of evaluation that no other rate was taken on.
SEED = 9000
DEMOS = (1, 3)
# As in configs/openspm_tabletop_train.yaml.
STEPS, SAMPLES_PER_FRAME, TRAINING_SEED = 3000, 512, 1000
NOT_TAUGHT = "not_taught"


@dataclass
class Options(ResultOption):
    """Measure teaching on the tabletop."""

    env: EnvironmentOption = field(default_factory=EnvironmentOption)
    dataset: DatasetOption = field(default_factory=DatasetOption)
    episodes: int = 100  # for each number of demonstrations, the tasks in turn
    seed: int = SEED  # of the first scene of every task
    steps: int = STEPS  # of each policy's training
    workers: int = 2  # processes at a time
    output: str = "outputs/bench/teach"  # folder for policies and what was measured

    def __post_init__(self) -> None:
        if self.env.type != "openspm_tabletop":
            raise ValueError(f"bench teach measures on openspm_tabletop, got env.type={self.env.type}")
        select_tasks(self.env.task)
        for name in ("episodes", "steps", "workers"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class Demonstrations:
    """Where the demonstrations lie, and the numbers of each task's, in order."""

    root: str
    repo_id: str
    episodes: dict[str, list[int]]


def demonstrations(options: Options) -> Demonstrations:
    """The dataset, with at least as many demonstrations of each selected task as are taught.

    Raises:
        DatasetError: There is none, or it holds too few.
    """
    from lerobot_openspm.mining.dataset import dataset_metadata

    root = options.dataset.root or f"{DEFAULTS[options.env.type][0]}/dataset"
    repo_id = options.dataset.repo_id or DEFAULTS[options.env.type][1]
    meta = dataset_metadata(repo_id, root)
    told = [str(tasks[0]) for tasks in meta.episodes["tasks"]]  # pyright: ignore[reportOptionalSubscript]
    numbers = {
        name: [i for i, one in enumerate(told) if one == task.instruction] for name, task in TASKS.items()
    }
    for name in select_tasks(options.env.task):
        if len(numbers[name]) < max(DEMOS):
            raise DatasetError(
                f"{root} holds {len(numbers[name])} demonstrations of {name}, expected at least "
                f"{max(DEMOS)}; record more: openspm collect --episodes=10"
            )
    return Demonstrations(root, repo_id, numbers)


def train(data: Demonstrations, task: str, steps: int, folder: Path) -> None:
    """Train a policy on all tasks but one, unless it is there."""
    import torch
    from lerobot.policies.factory import make_policy

    from lerobot_openspm.configuration_openspm import OpenSPMConfig
    from lerobot_openspm.mining.dataset import dataset_metadata
    from lerobot_openspm.teaching import DATASET_CAMERAS

    if folder.exists():
        return
    # The same weights in any process: seeded as lerobot-train is, on one thread.
    torch.set_num_threads(1)
    torch.manual_seed(TRAINING_SEED)
    others = sorted(i for name, own in data.episodes.items() if name != task for i in own)
    config = OpenSPMConfig(
        device="cpu", push_to_hub=False, cameras=f"{data.root}/meta/{DATASET_CAMERAS}",
        samples_per_frame=SAMPLES_PER_FRAME, memory_episodes=others,
    )  # fmt: skip
    meta = dataset_metadata(data.repo_id, data.root)
    with contextlib.redirect_stdout(io.StringIO()):
        policy: Any = make_policy(config, ds_meta=meta)
    _fit(policy, _frames(meta, others), steps)
    _write(policy, folder)


def _frames(meta: Any, episodes: Sequence[int]) -> np.ndarray:
    """Dataset indices of all frames of some episodes."""
    bounds = [
        (meta.episodes["dataset_from_index"][i], meta.episodes["dataset_to_index"][i]) for i in episodes
    ]
    return np.concatenate([np.arange(first, last) for first, last in bounds])


def _fit(policy: Any, frames: np.ndarray, steps: int) -> None:
    """LeRobot's training loop without its loader, which decodes videos that the flow model never sees."""
    import torch

    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    scheduler = policy.config.get_scheduler_preset().build(optimizer, steps)
    clip = policy.config.get_optimizer_preset().grad_clip_norm
    policy.train()
    for index in np.random.default_rng(TRAINING_SEED).choice(frames, steps):
        loss, _ = policy.forward({"index": torch.tensor([int(index)])})
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), clip)
        optimizer.step()
        optimizer.zero_grad()
        scheduler.step()


def _write(policy: Any, folder: Path) -> None:
    """Save a policy as a whole or not at all."""
    beside = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(beside, ignore_errors=True)
    policy.save_pretrained(beside)
    beside.rename(folder)


def teach(data: Demonstrations, nine: Path, task: str, demos: int, folder: Path) -> dict[str, Any]:
    """Teach the first demonstrations of a task, unless that is done.

    Returns:
        ``seconds`` from loading the checkpoint to having saved the memory, and ``error``, None or what went
        wrong. The folder holds the taught checkpoint, unless there was an error.
    """
    from lerobot_openspm.bench.episode import load
    from lerobot_openspm.memory.io import write_memory
    from lerobot_openspm.mining.dataset import dataset_metadata

    note = folder.with_name(f"{folder.name}.json")
    if note.is_file():
        return json.loads(note.read_text())
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(nine, folder)
    start_s, result = time.monotonic(), {"task": task, "demonstrations": demos}
    try:
        policy = load(str(folder))
        lesson = policy.teach(dataset_metadata(data.repo_id, data.root), data.episodes[task][:demos])
        write_memory(policy.require_memory(), folder)
        found = {"error": None, "objects_learned": lesson.objects_learned, "skipped": lesson.skipped}
    except OpenSPMError as error:
        found = {"error": str(error)}
    result |= {"seconds": round(time.monotonic() - start_s, 2), **found}
    write_json(note, result)
    return result


def run(folder: Path, task: str, demos: int, seed: int) -> Any:
    """Run one episode of a taught policy."""
    from lerobot_openspm.bench.episode import load, run_episode
    from lerobot_openspm.bench.tabletop import TabletopWorld
    from lerobot_openspm.bench.tracking import Result
    from lerobot_openspm.envs.tabletop.env import TabletopEnv

    if json.loads(folder.with_name(f"{folder.name}.json").read_text())["error"] is not None:
        return Result(str(demos), task, seed, False, 0, NOT_TAUGHT, 0, None)
    env = TabletopEnv(task=task)
    episode = run_episode(load(str(folder)), TabletopWorld(env, seed))
    env.close()
    return Result(
        str(demos), task, seed, episode.success, len(episode.actions), episode.row.state.status.value,
        episode.row.state.attempts, None,
    )  # fmt: skip


def measure(options: Options) -> dict[str, Any]:
    """Train, teach, evaluate; each only where that is not done."""
    from lerobot_openspm.bench import tracking
    from lerobot_openspm.cli.pipeline import digest, measured_folder

    data = demonstrations(options)
    made_of = digest([Path(data.root) / "meta/info.json"], [data.root, str(options.steps)])
    folder = measured_folder(Path(options.output), made_of)
    tasks = select_tasks(options.env.task)
    nine = {task: folder / f"without_{task}" for task in tasks}
    left = [(data, task, options.steps, nine[task]) for task in tasks if not nine[task].exists()]
    list(each(options.workers, train, left, "Training without a task"))
    taught = {(task, demos): folder / f"taught_{task}_{demos}" for task in tasks for demos in DEMOS}
    left = [(data, nine[task], task, demos, path) for (task, demos), path in taught.items()]
    # One at a time, because it is timed.
    lessons = list(each(1, teach, left, "Teaching"))
    turns = [(tasks[i % len(tasks)], options.seed + i // len(tasks)) for i in range(options.episodes)]
    jobs = [(taught[task, demos], task, demos, seed) for task, seed in turns for demos in DEMOS]
    log = folder / "episodes.jsonl"
    done = tracking.read(log)
    for result in each(options.workers, run, [j for j in jobs if (str(j[2]), j[1], j[3]) not in done]):
        tracking.write_line(log, result)
    done = tracking.read(log)
    return summarise([done[str(demos), task, seed] for _, task, demos, seed in jobs], lessons)


def summarise(results: Sequence[Any], lessons: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Success by the number of demonstrations, and the longest lesson."""
    from lerobot_openspm.bench.tracking import summarise as by_condition

    found = by_condition(results)
    one, three = (found[str(demos)] for demos in DEMOS)
    by_task = {
        task: {
            demos: _mean([r for r in results if (r.task, r.condition) == (task, demos)]) for demos in found
        }
        for task in dict.fromkeys(result.task for result in results)
    }
    return {
        "teach_s": max(lesson["seconds"] for lesson in lessons),
        "success_1_demo": one["success"],
        "success_3_demos": three["success"],
        "n": min(one["n"], three["n"]),
        "tasks": by_task,
        "demonstrations": found,
        "lessons": list(lessons),
    }


def _mean(results: Sequence[Any]) -> float:
    return sum(result.success for result in results) / len(results)
