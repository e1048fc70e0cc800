"""Evaluate a checkpoint on a suite's 50 initial states a task, resumably and without needless rendering.

    python -m benchmarks.libero.evaluate --checkpoint=FOLDER --output=FOLDER --suite=libero_spatial

An episode is the one of `lerobot-eval --env.type=libero --env.task=libero_spatial --seed=1000` with one
environment: initial state i, seed 1000 + i, ten settling steps, at most as many steps as LeRobot gives it.
`equality.py` compares the two action by action. Every episode is written down as it ends; a second run does
the rest.
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.episodes import load, run_episode
from benchmarks.harness import Row, checkpoint_files, measured_folder, resume
from benchmarks.libero import contacts, failures, pro_objects, variants
from benchmarks.libero.contacts import Contacts, shares, task_objects
from benchmarks.libero.failures import Grips, counts, failure_kind
from benchmarks.libero.variants import EXCHANGED, PRO_SUITES, exchanged, variant_file, variant_states
from benchmarks.results import run
from benchmarks.worlds import LIBERO_IMAGE_SIZE, LiberoWorld

from lerobot_openspm.cli.pipeline import rate
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.control.state import Status
from lerobot_openspm.envs.libero.simulator import OBJECTS, SUITE, LiberoSimulator, suite_of, task_file, tasks
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.oracle import name_simulator_poses
from lerobot_openspm.types import Execution

STATES, SEED = 50, 1000
SUITES = (*OBJECTS, *PRO_SUITES)
# Tuning scenes of the benchmark, apart from those that tests use.
TUNING_SEED = TUNING_SEED_START + 100_000


@dataclass
class EvaluationConfig:
    """What to evaluate.

    Args:
        checkpoint: Folder of the policy.
        output: Folder for episodes.jsonl.
        task: A task's name, several with commas, or "all".
        suite: One of LIBERO's, or one of LIBERO-PRO's variants of libero_goal.
        episodes: Initial states a task, from the first on.
        tuning: Draw as many scenes from tuning seeds instead of taking the benchmark's initial states; of a
            variant, with exchanges of our own.
        tuning_seed: The first of those seeds.
        workers: Episodes at a time, each in a process of its own; a single one stays in this process.
        execution: Of the policy; the checkpoint's if not given.
    """

    checkpoint: str
    output: str
    task: str = "all"
    suite: str = SUITE
    episodes: int = STATES
    tuning: bool = False
    tuning_seed: int = TUNING_SEED
    workers: int = 2
    execution: Execution | None = None

    def __post_init__(self) -> None:
        if self.suite not in SUITES:
            raise ValueError(f"suite is {self.suite!r}, expected one of {', '.join(SUITES)}")
        drawn = (*OBJECTS, EXCHANGED)
        if self.tuning and self.suite not in drawn:
            raise ValueError(f"tuning scenes are drawn for {', '.join(drawn)}, not for {self.suite}")
        if self.episodes < 1 or (self.episodes > STATES and not self.tuning):
            raise ValueError(f"episodes must be 1 to {STATES}, with tuning more, got {self.episodes}")
        self.selected()

    def selected(self) -> list[str]:
        """The tasks."""
        known = tasks(SUITE if self.suite in PRO_SUITES else self.suite)
        wanted = list(known) if self.task == "all" else self.task.split(",")
        if unknown := [task for task in wanted if task not in known]:
            raise ValueError(f"{self.suite} has no tasks {unknown}, expected some of {', '.join(known)}")
        return wanted


def main(config: EvaluationConfig) -> dict[str, Any]:
    """Evaluate, and return the summary; it is no published figure."""
    return summary(evaluate(config))


def evaluate(config: EvaluationConfig) -> list[Row]:
    """Run the episodes that are missing, and return all of them.

    Episodes of another policy, other settings or other code are removed, not mixed in.
    """
    settings = [f"{key}={getattr(config, key)}" for key in ("suite", "tuning", "tuning_seed", "execution")]
    code = [Path(str(module.__file__)) for module in (contacts, failures, pro_objects, variants)]
    files = [*checkpoint_files(Path(config.checkpoint)), *code]
    folder = measured_folder(Path(config.output), files, settings, __file__)
    jobs = {f"{task} {i}": (config, task, i) for task in config.selected() for i in range(config.episodes)}
    return resume(folder / "episodes.jsonl", jobs, evaluate_one, config.workers)


def evaluate_states(
    checkpoint: Path,
    output: Path,
    states: int = STATES,
    selected: Sequence[str] | None = None,
    execution: Execution | None = None,
    suite: str = SUITE,
) -> list[Row]:
    """Episodes on the first of the benchmark's initial states of all tasks or some, run if need be."""
    names = ",".join(selected) if selected else "all"
    return evaluate(EvaluationConfig(str(checkpoint), str(output), names, suite, states, execution=execution))


def summary(episodes: list[Row], off_mm: Sequence[float] | None = None) -> dict[str, Any]:
    """Rates over all episodes and per task, which of them failed, and by what as `failures` sorts them.

    Args:
        episodes: What was evaluated.
        off_mm: For each the largest error among the poses that were found at first, where that is known.
    """
    names = dict.fromkeys(e["task"] for e in episodes)
    order = list(tasks(suite_of(next(iter(names)))))
    own = {task: [e for e in episodes if e["task"] == task] for task in sorted(names, key=order.index)}
    errors = [None] * len(episodes) if off_mm is None else off_mm
    failed = [
        {
            **{key: e[key] for key in ("task", "state", "seed", "attempts", "parts")},
            "reason": reason(e),
            "kind": failure_kind(e, off),
        }
        for e, off in zip(episodes, errors, strict=True)
        if not e["success"]
    ]
    return {
        **_rate(episodes),
        "per_task": {task: _rate(es) for task, es in own.items()},
        "failures": counts([one["kind"] for one in failed]),
        "failed": failed,
    }


def _rate(episodes: Sequence[Row]) -> dict[str, Any]:
    """Success rate, mean steps of the successes, None if there is none, and contacts as `shares` tells."""
    steps = [e["steps"] for e in episodes if e["success"]]
    mean = round(float(np.mean(steps)), 1) if steps else None
    found = shares([e["contacts"] for e in episodes])
    return {**rate(len(steps), len(episodes)), "mean_steps": mean, **found}


def reason(episode: Row) -> str:
    """Why an episode failed, as far as the policy can tell."""
    match episode["status"]:
        case Status.DONE:
            return "every key pose was met, but the goal does not hold"
        case Status.RUNNING | Status.PAUSED:
            return f"time was up at {episode['phase']}"
        case Status.NO_PROGRESS:
            return f"gave up at {episode['phase']}"
        case status:
            refusal = episode.get("refusal")
            return status.replace("_", " ") + (f": {refusal}" if refusal else "")


def evaluate_one(config: EvaluationConfig, task: str, state: int) -> Row:
    """Run one episode, with a policy and a simulator kept by the process.

    Returns:
        What is kept of it. ``seen`` are the poses that the policy found when it planned, ``true`` the
        simulator's poses of the objects that the instruction names, ``contacts`` as `Contacts` tells them,
        ``gripped`` as `Grips` does.
    """
    seed = (config.tuning_seed if config.tuning else SEED) + state
    is_exchanged = config.tuning and config.suite == EXCHANGED
    file = exchanged(task, seed) if is_exchanged else variant_file(config.suite, task)
    policy, simulator = _policy(config.checkpoint, config.execution), kept_simulator(task, file)
    if config.tuning:
        simulator.reset(seed)
        move_hand(simulator, np.random.default_rng(seed))
        # The benchmark's states hold no fixtures: these are drawn anew, and stand elsewhere than they stood
        # when the things were put on or into them.
        simulator.reset_to(seed + 1, simulator.sim.get_state().flatten())
    else:
        simulator.reset_to(seed, variant_states(config.suite, task)[state])
    sub_tasks = parse_instruction(simulator.instruction)
    named = list(dict.fromkeys(name for sub_task in sub_tasks for name in sub_task.objects))
    of_task = task_objects(simulator.instruction, file or task_file(task), simulator.suite)
    watch = Contacts(simulator, of_task)
    grips, places = Grips(), dict[str, Any]()

    def note(step: int, observation: Observation, controller: EpisodeController) -> None:
        watch.note()
        state, targets = controller.state, controller.executor.targets
        grips.note(state.part, [target.key_pose.phase for target in targets], state.index)
        if step == 0:
            poses = without_several(simulator.object_poses(), of_task)
            true = name_simulator_poses(poses, named, policy.require_memory().objects)
            seen = controller.scene.tracker.poses(observation.hand.T_world_ee)
            places["seen"] = {name: _place(T) for name, T in seen.items()}
            places["true"] = {name: _place(T) for name, T in true.items()}

    episode = run_episode(policy, LiberoWorld(simulator), note=note)
    watch.note()
    found = {"contacts": watch.told(), "gripped": grips.told(), **places}
    return {"task": task, "state": state, "seed": seed, **episode.told(), **found}


def without_several(poses: Mapping[str, np.ndarray], of_task: Collection[str]) -> dict[str, np.ndarray]:
    """Poses without those of two of a kind that a task is about: a name may mean either."""
    kinds = {name[:-2] for name in of_task if name.endswith("_2")}
    return {name: T for name, T in poses.items() if name.removesuffix("_2") not in kinds}


def move_hand(simulator: LiberoSimulator, rng: np.random.Generator) -> None:
    """Begin elsewhere, as the benchmark's own states do; a seeded reset always begins in the same place."""
    towards = rng.uniform(-0.6, 0.6, size=3)
    for share in (1.0, 1.0, 1.0, 0.0, 0.0):
        simulator.step(np.array([*(share * towards), 0.0, 0.0, 0.0, -1.0]))


def _place(T_world_obj: np.ndarray) -> list[float]:
    """Position in metres and yaw in radians."""
    return [round(float(x), 5) for x in (*T_world_obj[:3, 3], se3.yaw_of(T_world_obj))]


@functools.lru_cache(1)
def _policy(checkpoint: str, execution: Execution | None) -> OpenSPMPolicy:
    policy = load(checkpoint)
    if execution:
        policy.config.execution = execution
    # robosuite collects garbage at every reset; it need not look through all modules each time.
    gc.freeze()
    return policy


# The last simulator by its task and file; a cache would drop it without closing it.
_SIMULATOR: dict[tuple[str, Path | None], LiberoSimulator] = {}


def kept_simulator(task: str, file: Path | None) -> LiberoSimulator:
    """A task's simulator, the same one as before if it was asked for last; else that is closed."""
    if (task, file) not in _SIMULATOR:
        while _SIMULATOR:
            _SIMULATOR.popitem()[1].close()
        _SIMULATOR[task, file] = LiberoSimulator(task, LIBERO_IMAGE_SIZE, file)
    return _SIMULATOR[task, file]


if __name__ == "__main__":
    run(EvaluationConfig, main)
