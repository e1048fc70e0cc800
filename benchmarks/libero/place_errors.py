"""Estimates of where things are beside the truth: shares, errors, and what a high confidence is worth."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from benchmarks.harness import Row
from benchmarks.stages import LIBERO
from benchmarks.truth import pose_error, true_period, upright

from lerobot_openspm.cli.pipeline import rate
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import KnownObject
from lerobot_openspm.perception.objects.patches.model import PatchModel
from lerobot_openspm.perception.oracle import name_simulator_poses
from lerobot_openspm.types import PoseEstimate

# What counts as right, and from which confidence on estimates should be; metres and radians.
NEAR_M, NEAR_RAD, SURE = 0.010, np.deg2rad(10), 0.95


def judged(
    name: str,
    estimate: PoseEstimate,
    meant: PoseEstimate,
    poses: Mapping[str, Array],
    T_sim_obj: Array,
    models: Mapping[str, KnownObject],
) -> Row:
    """An estimate beside the truth; of several of a kind, that of the one that the instruction is about.

    Args:
        name: What was sought, by the instructions' name.
        estimate: What was found.
        meant: The same, or where the one stands that the instruction is about.
        poses: The simulator's poses ``T_world_obj`` of everything in the scene, by its names. Of several of a
            kind, instructions are about the first.
        T_sim_obj: The learned frame in the simulator's upright one.
        models: What was learned, by name.
    """
    there = [upright(T) @ T_sim_obj for T in _of_kind(name, poses, models)]
    is_found = meant.status == "found"
    row: Row = {"found": is_found, "confidence": round(float(meant.confidence), 4), "of": len(there)}
    if not is_found or not there:
        return row
    period, model = true_period(name, LIBERO), models[name]
    shows_yaw = period > 0 and model.yaw_period > 0 and not isinstance(model, PatchModel)
    # A round thing is compared by its axis. The simulator's frame lies on it, the learned one may lie beside.
    T_obj_sim = se3.inverse(T_sim_obj) if period == 0 else np.eye(4)
    there = [T @ T_obj_sim for T in there]
    found = [T @ T_obj_sim for T in (estimate.T_world_obj, *estimate.others)]
    T_found = meant.T_world_obj @ T_obj_sim
    metres, radians = pose_error(there[0], T_found, period)
    off = T_found[:3, 3] - there[0][:3, 3]
    apart = [min(pose_error(T, one, 0.0)[0] for one in found) for T in there]
    return {
        **row,
        "mm": round(1000 * metres, 1),
        "deg": round(float(np.rad2deg(radians)), 1) if shows_yaw else None,
        "off_mm": (1000 * off).round(1).tolist(),
        "near": sum(one < NEAR_M for one in apart),
    }


def not_known(name: str, poses: Mapping[str, Array], models: Mapping[str, KnownObject]) -> Row:
    """The row of a thing that was not learned: wherever there is one, it is not found."""
    return {"found": False, "confidence": 0.0, "of": len(_of_kind(name, poses, models))}


def _of_kind(name: str, poses: Mapping[str, Array], models: Mapping[str, KnownObject]) -> list[Array]:
    """The simulator's poses ``T_world_obj`` of all that an instruction's name fits."""
    named = [name_simulator_poses({re.sub(r"_\d+$", "", one): T}, [name], models) for one, T in poses.items()]
    return [one[name] for one in named if one]


def several_of_a_kind(poses: Mapping[str, Array], models: Mapping[str, KnownObject]) -> list[str]:
    """The known names that fit several things in a scene, which instructions tell apart by words."""
    return [name for name in models if len(_of_kind(name, poses, models)) > 1]


def is_right(row: Row) -> bool:
    """Whether an estimate is near the truth, and turned as that is where its yaw is known."""
    return row.get("mm", np.inf) < 1000 * NEAR_M and (row["deg"] is None or row["deg"] < np.rad2deg(NEAR_RAD))


def of_object(rows: Sequence[Row]) -> dict[str, Any]:
    """What was found of one thing in all scenes. Shares are of the scenes that hold it."""
    held, absent = [row for row in rows if row["of"]], [row for row in rows if not row["of"]]
    found, several = [row for row in held if row["found"]], [row for row in held if row["of"] > 1]
    return {
        "found": rate(len(found), len(held)),
        "within_10_mm": rate(sum(row["mm"] < 1000 * NEAR_M for row in found), len(held)),
        **{f"position_mm_{key}": value for key, value in _spread([row["mm"] for row in found]).items()},
        **{f"yaw_deg_{key}": value for key, value in _spread([row["deg"] for row in found]).items()},
        "several": {"n": len(several), "all_within_10_mm": sum(r.get("near") == r["of"] for r in several)},
        "absent": {"n": len(absent), "reported": sum(row["found"] for row in absent)},
    }


def _spread(values: Sequence[float | None]) -> dict[str, float | None]:
    known = [value for value in values if value is not None]
    levels = {"median": 50, "p95": 95}
    return {key: round(float(np.percentile(known, at)), 1) if known else None for key, at in levels.items()}


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Per object and of all together, and how many of all estimates that are said to be sure are right."""
    names = dict.fromkeys(name for row in rows for name in row["objects"])
    every = [one for row in rows for one in row["objects"].values()]
    sure = [one for one in every if one["found"] and one["confidence"] > SURE]
    return {
        "found": {name: of_object([row["objects"][name] for row in rows]) for name in names},
        "all": of_object(every),
        "sure": rate(sum(map(is_right, sure)), len(sure)),
        "sure_and_wrong": [
            [name, row["task"], row["seed"], one.get("mm"), one.get("deg")]
            for row in rows
            for name, one in row["objects"].items()
            if one["found"] and one["confidence"] > SURE and not is_right(one)
        ],
        "first_look_cpu_ms": _spread([row["look_cpu_ms"] for row in rows]),
    }
