"""First looks at scenes of objects anywhere: pose errors, confidence, and what is found that is not there."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.calls import watched
from benchmarks.episodes import LazyImages, load
from benchmarks.harness import Row, checkpoint_files, measured_folder, resume
from benchmarks.truth import Truth, offsets, pose_error, summary, true_period
from benchmarks.worlds import TabletopWorld, tabletop
from lerobot_openspm.cli.pipeline import rate
from lerobot_openspm.envs.tabletop import env, scene
from lerobot_openspm.envs.tabletop.tasks import SELECTIONS
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.oracle import name_simulator_poses
from lerobot_openspm.perception.pipeline import detect
from lerobot_openspm.types import Hand

ENV = "openspm_tabletop"
# Looks with an object taken away, in all; one a scene and movable object that stands there once.
SCENES_PER_TASK = 7
# A confident pose is right within this.
CONFIDENT, RIGHT_M, RIGHT_RAD = 0.95, 0.010, np.deg2rad(10)
WORKERS = 2


def looks(checkpoint: Path, root: Path, folder: Path, seed: int) -> dict[str, Any]:
    """Look once at scenes of every task from a seed on, and at each with one known object taken away."""
    files = [*checkpoint_files(checkpoint), Path(__file__).with_name("truth.py"), root / "meta/info.json"]
    measured = measured_folder(folder, files, [str(root)], __file__)
    jobs = {
        f"{task} {number}": (checkpoint, root, task, number)
        for task in SELECTIONS["anywhere"]
        for number in range(seed, seed + SCENES_PER_TASK)
    }
    return summarise(resume(measured / "looks.jsonl", jobs, look, WORKERS))


def look(checkpoint: Path, root: Path, task: str, seed: int) -> Row:
    """Errors of the poses that the policy takes at first, and whether what was taken away is found.

    Returns:
        Also how many layouts were ``drawn`` until one could be used, and how many of these the expert
        ``tried``: the others do not show which object is meant.
    """
    policy, T_sim_obj = load(str(checkpoint)), offsets(checkpoint, root)
    objects, cameras = policy.require_memory().objects, policy.require_memory().cameras
    with (
        watched(env, "sample_anywhere") as drawn,
        watched(env, "expert_solves") as tried,
        tabletop(task, seed) as world,
    ):
        observation = observe(policy, world)
        right = right_places(world, T_sim_obj)
        with torch.inference_mode():
            policy.act([observation])
        controller = policy.episodes[0].controller
        poses = controller.scene.tracker.poses(observation.hand.T_world_ee)
        needed = controller.state.ranked[0].entry.objects if controller.state.ranked else ()
        found = []
        for name, estimate in controller.scene.detections.estimates.items():
            if name in right:
                errors, period = (None, None), true_period(name, ENV)
                if name in poses:
                    errors = min(pose_error(T, poses[name], period) for T in right[name])
                turns = period > 0
                found.append((name, name in needed, turns, estimate.confidence, *errors))
        gone = []
        for own, name in _taken_away(world, list(T_sim_obj)):
            with _without(world, own):
                views, _ = observe(policy, world).usable_views(cameras)
                estimate = detect(views, objects)[name]
                gone.append((name, estimate.status != "not_found", estimate.confidence))
    return {"found": found, "gone": gone, "drawn": len(drawn), "tried": len(tried)}


def observe(policy: OpenSPMPolicy, world: TabletopWorld) -> Observation:
    """What the policy sees of a world now."""
    vector, layout = world.state().astype(float), policy.config.layouts()[0]
    hand = Hand(layout.poses(vector), float(layout.openings(vector)))
    images = LazyImages(world, tuple(policy.config.image_features))
    return Observation(world.instruction, vector, hand, images, None)


def right_places(world: TabletopWorld, T_sim_obj: Mapping[str, Array]) -> dict[str, list[Array]]:
    """True poses ``T_world_obj`` ``(4, 4)`` by the policy's names; two of what the task does not name of two.

    Where the instruction names an object, its words say which of two is meant.
    """
    simulator, poses = world.env.simulator, world.object_poses()
    truth, second = Truth(poses, T_sim_obj), dict(poses)
    for name in scene.MOVABLE_NAMES:
        if scene.second(name) in simulator.movable:
            body = simulator.data.body(scene.second(name))
            second[name] = se3.transform(body.xmat.reshape(3, 3), body.xpos)
    first, other = truth.now(poses), truth.now(second)
    return {
        name: [T] if name in world.instruction or np.array_equal(T, other[name]) else [T, other[name]]
        for name, T in first.items()
    }


def _taken_away(world: TabletopWorld, names: Sequence[str]) -> list[tuple[str, str]]:
    """Movable objects that stand there once, by the simulator's and the policy's names."""
    simulator = world.env.simulator
    single = [name for name in scene.MOVABLE_NAMES if scene.second(name) not in simulator.movable]
    # The policy's name is told by which of its objects goes where the simulator's is.
    poses = world.object_poses()
    named = name_simulator_poses(poses, list(names), {})
    return [
        (own, name)
        for own in single
        for name in named
        if np.array_equal(named[name][:3, 3], poses[own][:3, 3])
    ]


@contextlib.contextmanager
def _without(world: TabletopWorld, name: str) -> Generator[None]:
    """A world in which one object is far away."""
    simulator, T_world_obj = world.env.simulator, world.object_poses()[name]
    away = T_world_obj.copy()
    away[:3, 3] = (5.0, 5.0, -3.0)
    simulator.put(name, away)
    try:
        yield
    finally:
        simulator.put(name, T_world_obj)


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Errors of all objects and of those that the task needs, false finds, and whether confidence holds."""
    found = [one for row in rows for one in row["found"]]
    gone = [is_found for row in rows for _, is_found, _ in row["gone"]]
    sure = [one for one in found if one[3] > CONFIDENT and one[4] is not None]
    mistaken = sum(is_found and told > CONFIDENT for row in rows for _, is_found, told in row["gone"])
    right = [one for one in sure if one[4] <= RIGHT_M and (not one[2] or one[5] <= RIGHT_RAD)]
    return {
        "looks": len(rows),
        "layouts": _layouts(rows),
        "poses": _errors(found),
        "poses_needed": _errors([one for one in found if one[1]]),
        "false_finds": rate(sum(gone), len(gone)),
        "confident_and_right": rate(len(right), len(sure) + mistaken),
    }


def _layouts(rows: Sequence[Row]) -> dict[str, Any]:
    """How many layouts were drawn, and how many of them were not used for which reason."""
    drawn, tried = (sum(row[key] for row in rows) for key in ("drawn", "tried"))
    return {"drawn": drawn, "hidden": drawn - tried, "unsolved": tried - len(rows)}


def _errors(found: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """Positions of all, and orientations of those whose yaw shows."""
    turning = [(one[4], one[5]) for one in found if one[2]]
    return {
        **summary([(one[4], None) for one in found]),
        "yaw_deg_mean": summary(turning)["orientation_deg_mean"],
        "turned_round": sum(radians is not None and radians > np.pi / 2 for _, radians in turning),
    }
