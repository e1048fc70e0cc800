"""`openspm bench keyposes`: mined key poses against the simulators' contacts.

Scripted experts, led by an unsteady operator (:mod:`lerobot_openspm.envs.unsteady`), give demonstrations;
mining sees of them what a dataset holds, and is judged by what the simulator saw
(:mod:`lerobot_openspm.bench.contact_events`).
"""

from __future__ import annotations

import multiprocessing
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from lerobot_openspm.bench.contact_events import PHASES, contact_events
from lerobot_openspm.bench.recording import OPERATORS, Job, Recording, record
from lerobot_openspm.bench.results import ResultOption
from lerobot_openspm.envs.recording import Names
from lerobot_openspm.envs.suites import find_suite
from lerobot_openspm.geometry.vector_layout import RotationKind, parse_layout
from lerobot_openspm.mining.key_poses import find_key_poses
from lerobot_openspm.mining.signals import Episode, observe_robot

SIMULATORS = ("openspm_tabletop", "libero")
# The package's files that make a recording what it is.
RECORDED_BY = ("envs/**/*.py", "geometry/se3.py", "bench/recording.py", "bench/contact_sensor.py")
TOLERANCE_STEPS = 3
# LIBERO's names of the rotation's numbers are wrong, as in the public dataset.
ROTATIONS: Mapping[str, RotationKind | None] = {"openspm_tabletop": None, "libero": "axis_angle"}
# Words of the bodies that the goal of a task, by the words of its name, is about. What else a hand brushes in
# passing ends no phase.
GOALS: Mapping[tuple[str, ...], tuple[str, ...]] = {
    ("bowl", "top", "drawer"): ("drawer_top", "cabinet_top", "bowl"),
    ("middle", "drawer"): ("drawer_middle", "cabinet_middle"),
    ("turn", "stove"): ("knob", "button"),
    ("push", "plate"): ("plate",),
    ("bottle",): ("bottle",),
    ("cheese",): ("cheese",),
    ("box",): ("box",),
    ("bowl",): ("bowl",),
}


@dataclass
class SimulatorOption:
    """Where to measure."""

    type: str = "all"  # openspm_tabletop, libero (its suite libero_goal), or all that are installed
    task: str = "all"  # a task name, a comma list of them, or "all"


@dataclass
class Options(ResultOption):
    """Compare mined key poses with the simulators' contacts."""

    env: SimulatorOption = field(default_factory=SimulatorOption)
    episodes: int = 100  # of each simulator, its tasks in turn
    seed: int = 10_000  # of the first scene of every task
    operator: str = "unsteady"  # who gives the demonstrations: unsteady, or steady as in `openspm collect`
    workers: int = 2  # episodes at a time, each in a process of its own
    output: str = "outputs/bench/keyposes"  # folder for the recordings; kept until what records them changes

    def __post_init__(self) -> None:
        if self.env.type not in (*SIMULATORS, "all"):
            raise ValueError(f"env.type is {self.env.type!r}, expected one of {', '.join(SIMULATORS)}, all")
        if "libero" in self.simulators and find_spec("libero") is None:
            raise ValueError("env.type=libero needs LIBERO; install it with: pip install 'lerobot[libero]'")
        if self.operator not in OPERATORS:
            raise ValueError(f"operator is {self.operator!r}, expected one of {', '.join(OPERATORS)}")
        if self.episodes < 1 or self.workers < 1:
            raise ValueError(
                f"episodes and workers must be at least 1, got {self.episodes} and {self.workers}"
            )
        for simulator in self.simulators:
            find_suite(simulator).tasks(self.env.task)

    @property
    def simulators(self) -> tuple[str, ...]:
        """The simulators that are asked for; of all, LIBERO only where it is installed."""
        if self.env.type != "all":
            return (self.env.type,)
        return SIMULATORS if find_spec("libero") else ("openspm_tabletop",)

    def jobs(self, simulator: str) -> list[Job]:
        """The demonstrations of one simulator."""
        tasks = find_suite(simulator).tasks(self.env.task)
        return [
            Job(simulator, tasks[i % len(tasks)], self.seed + i // len(tasks), self.operator)
            for i in range(self.episodes)
        ]


@dataclass(frozen=True)
class Verdict:
    """How key poses of one phase in one episode compare: how many, and millimetres and frames off."""

    simulator: str
    phase: str
    mined: int
    true: int
    off_mm: tuple[float, ...]
    off_steps: tuple[int, ...]


def measure(options: Options) -> dict[str, Any]:
    """Record what is missing, mine it, compare. Called by `openspm bench keyposes`."""
    from lerobot_openspm.cli.pipeline import digest, measured_folder

    folder = measured_folder(Path(options.output), digest([], [], RECORDED_BY))
    jobs = {simulator: options.jobs(simulator) for simulator in options.simulators}
    _record(
        [job for ones in jobs.values() for job in ones if not job.file(folder).is_file()], folder, options
    )
    verdicts, failures, wrong = [], 0, []
    for ones in jobs.values():
        recordings = [Recording.read(job.file(folder)) for job in ones]
        found = compare(recordings)
        failures += sum(recording.failures for recording in recordings)
        verdicts += [verdict for own in found for verdict in own]
        wrong += [
            [job.env_type, job.task, job.seed, v.phase, v.mined, v.true]
            for job, own in zip(ones, found, strict=True)
            for v in own
            if len(v.off_mm) < max(v.mined, v.true)
        ]
    return {
        **summary(verdicts),
        "episodes": sum(map(len, jobs.values())),
        "operator": options.operator,
        "failed_attempts": failures,
        "simulators": _grouped(verdicts, "simulator"),
        "phases": _grouped(verdicts, "phase"),
        "wrong": wrong,
    }


def _record(jobs: Sequence[Job], folder: Path, options: Options) -> None:
    from tqdm import tqdm

    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.workers, context) as pool:
        running = [pool.submit(record, job, folder) for job in jobs]
        try:
            for future in tqdm(as_completed(running), "Episodes", len(running), disable=not jobs):
                future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def compare(recordings: Sequence[Recording]) -> list[list[Verdict]]:
    """Mine the recordings of one simulator together, as a dataset, and compare each with its truth."""
    episodes = [_episode(recording, i) for i, recording in enumerate(recordings)]
    robot = observe_robot(episodes)
    verdicts = []
    for recording, episode in zip(recordings, episodes, strict=True):
        goal = goal_things(recording.job.task)
        tracks = [track for track in recording.tracks if any(word in track.name for word in goal)]
        true = contact_events(tracks, recording.T_world_ee, recording.opening)
        mined = find_key_poses(episode, robot)
        own = []
        for phase in PHASES:
            poses = [
                pose
                for pose, after in zip(mined, [*mined[1:], None], strict=True)
                if pose.phase == phase and not (phase == "push" and after and after.phase == phase)
            ]
            frames = [event.frame for event in true if event.phase == phase]
            pairs = match([pose.frame for pose in poses], frames)
            off = [
                float(np.linalg.norm(poses[i].T_world_ee[:3, 3] - recording.T_world_ee[frames[j], :3, 3]))
                for i, j in pairs
            ]
            steps = tuple(poses[i].frame - frames[j] for i, j in pairs)
            millimetres = tuple(1000 * metres for metres in off)
            own.append(Verdict(recording.job.env_type, phase, len(poses), len(frames), millimetres, steps))
        verdicts.append(own)
    return verdicts


def goal_things(task: str) -> tuple[str, ...]:
    """Words that the names of the bodies hold that a task is about."""
    words = task.split("_")
    return next(things for key, things in GOALS.items() if all(word in words for word in key))


def match(
    mined: Sequence[int], true: Sequence[int], tolerance: int = TOLERANCE_STEPS
) -> list[tuple[int, int]]:
    """Pair frames one to one: as many as possible within the tolerance, and those as near as possible."""
    if not mined or not true:
        return []
    apart = np.abs(np.subtract.outer(np.asarray(mined), np.asarray(true)))
    # A pair beyond the tolerance costs more than all others together.
    cost = np.where(apart <= tolerance, apart, (tolerance + 1) * (len(mined) + len(true)))
    pairs = zip(*linear_sum_assignment(cost), strict=True)
    return [(int(i), int(j)) for i, j in pairs if apart[i, j] <= tolerance]


def summary(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """F1, distance of the matched key poses, number of true events; and what these are made of."""
    off = [mm for verdict in verdicts for mm in verdict.off_mm]
    steps = [step for verdict in verdicts for step in verdict.off_steps]
    mined, true = sum(v.mined for v in verdicts), sum(v.true for v in verdicts)
    return {
        "f1_3_frames": round(2 * len(off) / (mined + true), 4) if mined + true else None,
        "position_mm_mean": round(float(np.mean(off)), 2) if off else None,
        "n": true,
        "position_mm_p95": round(float(np.percentile(off, 95)), 2) if off else None,
        "frames_mean": round(float(np.mean(steps)), 2) if steps else None,
        "mined": mined,
        "matched": len(off),
    }


def _grouped(verdicts: Sequence[Verdict], by: str) -> dict[str, Any]:
    groups: dict[str, list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        groups[getattr(verdict, by)].append(verdict)
    return {name: summary(own) for name, own in groups.items()}


def _episode(recording: Recording, index: int) -> Episode:
    """What mining reads of a recording, by the same layouts as of a dataset."""
    kind = ROTATIONS[recording.job.env_type]
    names = find_suite(recording.job.env_type).names
    state = parse_layout(_flat(names["observation.state"]), "state", kind)
    action = parse_layout(_flat(names["action"]), "action", kind)
    vectors = recording.state.astype(float)
    actions = action.decode_actions(recording.action.astype(float))
    return Episode(index, recording.instruction, 0, state.poses(vectors), state.openings(vectors), actions)


def _flat(names: Names) -> list[str]:
    return names if isinstance(names, list) else [name for group in names.values() for name in group]
