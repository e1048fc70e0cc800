"""Mined key poses against the simulators' contacts.

    python -m benchmarks.key_poses [--env.type=libero]

Scripted experts, led by an unsteady operator (:mod:`benchmarks.unsteady`), give demonstrations;
mining sees of them what a dataset holds, and is judged by what the simulator saw
(:mod:`benchmarks.contact_events`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.contact_events import PHASES, ContactEvent, contact_events
from benchmarks.harness import each
from benchmarks.recording import Job, Recording, record
from benchmarks.results import run, write
from benchmarks.stages import EpisodesConfig
from lerobot_openspm.envs.recording import Names
from lerobot_openspm.envs.suites import find_suite
from lerobot_openspm.geometry.vector_layout import RotationKind, parse_layout
from lerobot_openspm.mining.key_poses import KeyPose, find_key_poses
from lerobot_openspm.mining.signals import Episode, observe_robot

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
class KeyPosesConfig(EpisodesConfig):
    """Compare mined key poses with a simulator's contacts."""

    seed: int = 30_000


@dataclass(frozen=True)
class Verdict:
    """How key poses of one phase in one episode compare: how many, and millimetres and frames off."""

    phase: str
    mined: int
    true: int
    off_mm: tuple[float, ...]
    off_steps: tuple[int, ...]


def main(config: KeyPosesConfig) -> dict[str, Any]:
    """Record, mine, compare, write and return the result."""
    jobs = [Job(config.env.type, task, seed) for task, seed in config.turns()]
    made = {one.job: one for one in each(config.workers, record, [(job,) for job in jobs])}
    recordings = [made[job] for job in jobs]
    compared = compare(recordings)
    verdicts = [verdict for own in compared for verdict in own]
    by_phase: dict[str, list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        by_phase[verdict.phase].append(verdict)
    figures = {
        **summary(verdicts),
        "episodes": len(jobs),
        "failed_attempts": sum(recording.failures for recording in recordings),
        "phases": {phase: summary(own) for phase, own in by_phase.items()},
        "wrong": [
            [job.task, job.seed, v.phase, v.mined, v.true]
            for job, own in zip(jobs, compared, strict=True)
            for v in own
            if len(v.off_mm) < max(v.mined, v.true)
        ],
    }
    return write(f"keyposes_{config.env.type.removeprefix('openspm_')}", {"seed": config.seed, **figures})


def compare(recordings: Sequence[Recording]) -> list[list[Verdict]]:
    """Mine the recordings of one simulator together, as a dataset, and compare each with its truth."""
    episodes = [_episode(recording, i) for i, recording in enumerate(recordings)]
    robot = observe_robot(episodes)
    compared = []
    for recording, episode in zip(recordings, episodes, strict=True):
        goal = goal_things(recording.job.task)
        tracks = [track for track in recording.tracks if any(word in track.name for word in goal)]
        true = contact_events(tracks, recording.T_world_ee, recording.opening)
        mined = find_key_poses(episode, robot)
        # A push that goes on after a corner has not ended there.
        ends = [
            pose
            for pose, after in zip(mined, [*mined[1:], None], strict=True)
            if not (pose.phase == "push" and after and after.phase == "push")
        ]
        compared.append([_verdict(phase, recording, ends, true) for phase in PHASES])
    return compared


def _verdict(
    phase: str, recording: Recording, mined: Sequence[KeyPose], true: Sequence[ContactEvent]
) -> Verdict:
    """How the mined and the true ends of one kind of phase compare."""
    poses = [pose for pose in mined if pose.phase == phase]
    frames = [event.frame for event in true if event.phase == phase]
    pairs = match([pose.frame for pose in poses], frames)
    off_m = [
        float(np.linalg.norm(poses[i].T_world_ee[:3, 3] - recording.T_world_ee[frames[j], :3, 3]))
        for i, j in pairs
    ]
    steps = tuple(poses[i].frame - frames[j] for i, j in pairs)
    return Verdict(phase, len(poses), len(frames), tuple(1000 * metres for metres in off_m), steps)


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


def _episode(recording: Recording, index: int) -> Episode:
    """What mining reads of a recording, by the same layouts as of a dataset."""
    kind = ROTATIONS[recording.job.env_type]
    names = find_suite(recording.job.env_type, recording.job.task).names
    state = parse_layout(_flat(names["observation.state"]), "state", kind)
    action = parse_layout(_flat(names["action"]), "action", kind)
    vectors = recording.state.astype(float)
    actions = action.decode_actions(recording.action.astype(float))
    return Episode(index, recording.instruction, 0, state.poses(vectors), state.openings(vectors), actions)


def _flat(names: Names) -> list[str]:
    return names if isinstance(names, list) else [name for group in names.values() for name in group]


if __name__ == "__main__":
    run(KeyPosesConfig, main)
