"""Entries and the robot model as JSON that a person can read, and arrays beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, cast, get_args

import numpy as np

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import (
    PHASES,
    Anchor,
    Axis,
    AxisKind,
    MemoryEntry,
    MemoryKeyPose,
    Reference,
    RetrievalKey,
    SubTask,
)
from lerobot_openspm.memory.robot import RobotModel

# What reading a field of another kind, or a number beyond what Python converts, ends in.
MALFORMED = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)

KEY_POSE_ARRAY, LAYOUT_ARRAY = "entries.T_obj_ee", "entries.T_world_obj"


def entries_to_parts(entries: Sequence[MemoryEntry]) -> tuple[list[dict[str, Any]], dict[str, Array]]:
    """Split entries into JSON rows and two arrays of transforms, in the order of the rows."""
    rows: list[dict[str, Any]] = []
    for entry in entries:
        key_poses = [_key_pose_fields(pose) for pose in entry.key_poses]
        rows.append(
            {
                "language": entry.language,
                "key": asdict(entry.key),
                "quality": entry.quality,
                "version": entry.version,
                "source": entry.source,
                "key_poses": key_poses,
                "layout": list(entry.layout),
            }
        )
    poses = [pose.T_obj_ee for entry in entries for pose in entry.key_poses]
    layouts = [T for entry in entries for T in entry.layout.values()]
    return rows, {KEY_POSE_ARRAY: _stacked(poses), LAYOUT_ARRAY: _stacked(layouts)}


def _key_pose_fields(pose: MemoryKeyPose) -> dict[str, Any]:
    """What a key pose says beside its transform."""
    fields = {name: value for name, value in asdict(pose).items() if name != "T_obj_ee"}
    if pose.axis is not None:
        fields["axis"] = {**fields["axis"], "direction": pose.axis.direction.tolist()}
    return fields


def _stacked(transforms: Sequence[Array]) -> Array:
    return np.stack(transforms) if transforms else np.zeros((0, 4, 4))


def entries_from_parts(
    rows: Sequence[Mapping[str, Any]], arrays: Mapping[str, Array], where: str
) -> tuple[MemoryEntry, ...]:
    """Inverse of :func:`entries_to_parts`. Raises MemoryFormatError naming file and field."""
    poses = _transforms(arrays, KEY_POSE_ARRAY, where)
    layouts = _transforms(arrays, LAYOUT_ARRAY, where)
    entries: list[MemoryEntry] = []
    n_poses, n_layouts = 0, 0
    for i, row in enumerate(rows):
        try:
            k, n = len(row["key_poses"]), len(row["layout"])
            entry = _entry(row, poses[n_poses : n_poses + k], layouts[n_layouts : n_layouts + n])
        except MALFORMED as error:
            raise MemoryFormatError(
                f"{where}: entries[{i}] is malformed: {error!r}; train or pull it again"
            ) from error
        entries.append(entry)
        n_poses, n_layouts = n_poses + k, n_layouts + n
    if n_poses != len(poses) or n_layouts != len(layouts):
        raise MemoryFormatError(
            f"{where}: got {len(poses)} key poses and {len(layouts)} object poses, expected {n_poses} and "
            f"{n_layouts}; the files do not belong together, train or pull it again"
        )
    return tuple(entries)


def _entry(row: Mapping[str, Any], poses: Array, layouts: Array) -> MemoryEntry:
    if len(poses) != len(row["key_poses"]) or len(layouts) != len(row["layout"]):
        raise ValueError("fewer transforms than the entry names")
    sub_tasks = tuple(_sub_task(item) for item in row["key"]["sub_tasks"])
    key = RetrievalKey(sub_tasks, tuple(str(phase) for phase in row["key"]["phases"]))
    key_poses = tuple(_key_pose(fields, T) for fields, T in zip(row["key_poses"], poses, strict=True))
    layout = {str(name): T for name, T in zip(row["layout"], layouts, strict=True)}
    if unknown := {name for pose in key_poses for name in pose.anchor.objects} - set(layout):
        raise ValueError(f"anchors {sorted(unknown)} are not in its layout {sorted(layout)}")
    quality = float(row["quality"])
    if not 0 <= quality <= 1:
        raise ValueError(f"quality is {quality}, expected 0 to 1")
    if not key_poses or not sub_tasks:
        raise ValueError("an entry needs a sub-task and a key pose")
    return MemoryEntry(
        key, str(row["language"]), key_poses, quality, int(row["version"]), str(row["source"]), layout
    )


def _sub_task(fields: Mapping[str, Any]) -> SubTask:
    words = {str(k): str(v) for k, v in fields.items() if not k.endswith("_where")}
    return SubTask(
        **words,
        target_where=_reference(fields.get("target_where")),
        landmark_where=_reference(fields.get("landmark_where")),
    )


def _reference(fields: Mapping[str, Any] | None) -> Reference | None:
    if fields is None:
        return None
    return Reference(str(fields["relation"]), tuple(str(name) for name in fields["landmarks"]))


def _key_pose(fields: Mapping[str, Any], T_obj_ee: Array) -> MemoryKeyPose:
    phase, confidence, opening = str(fields["phase"]), float(fields["confidence"]), float(fields["opening"])
    if phase not in PHASES:
        raise ValueError(f"phase is {phase!r}, expected one of {PHASES}")
    if not (0 <= confidence <= 1 and np.isfinite(opening)):
        raise ValueError(f"confidence {confidence} or opening {opening} is out of range")
    if not isinstance(fields["closed"], bool) or not isinstance(fields["dwell"], bool):
        raise ValueError("'closed' and 'dwell' must be true or false")
    anchor = Anchor(str(fields["anchor"]["place"]), str(fields["anchor"]["axes"]))
    return MemoryKeyPose(
        anchor,
        T_obj_ee,
        phase,
        confidence,
        fields["closed"],
        opening,
        int(fields["n_steps"]),
        fields["dwell"],
        None if fields.get("axis") is None else _axis(fields["axis"]),
    )


def _axis(fields: Mapping[str, Any]) -> Axis:
    kind, direction = str(fields["kind"]), np.asarray(fields["direction"], float)
    amount = float(fields["amount"])
    if kind not in get_args(AxisKind):
        raise ValueError(f"axis is of kind {kind!r}, expected one of {get_args(AxisKind)}")
    if direction.shape != (3,) or not abs(float(np.linalg.norm(direction)) - 1) < 1e-6:
        raise ValueError(f"axis has direction {direction.tolist()}, expected a unit vector of 3 numbers")
    if not np.isfinite(amount):
        raise ValueError(f"axis has amount {amount}, expected a finite number")
    return Axis(cast(AxisKind, kind), direction, amount)


def _transforms(arrays: Mapping[str, Array], name: str, where: str) -> Array:
    if name not in arrays:
        raise MemoryFormatError(
            f"{where}: array {name!r} is missing, got {sorted(arrays)}; train or pull it again"
        )
    T = arrays[name]
    if T.ndim != 3 or T.shape[1:] != (4, 4) or T.dtype != np.float64 or not se3.is_rigid(T):
        raise MemoryFormatError(
            f"{where}: array {name!r} has shape {T.shape} and type {T.dtype}, expected rigid transforms "
            "(n, 4, 4) of float64; train or pull it again"
        )
    return T


def robot_to_dict(robot: RobotModel) -> dict[str, Any]:
    """The JSON form of a robot model."""
    return {**asdict(robot), "workspace": robot.workspace.tolist()}


def robot_from_dict(fields: Mapping[str, Any], where: str) -> RobotModel:
    """Inverse of :func:`robot_to_dict`. Raises MemoryFormatError naming file and field."""
    try:
        numbers = {
            name: float(fields[name]) for name in RobotModel.__dataclass_fields__ if name != "workspace"
        }
        workspace = np.asarray(fields["workspace"], float)
    except MALFORMED as error:
        raise MemoryFormatError(
            f"{where}: 'robot' is malformed: {error!r}; train or pull it again"
        ) from error
    if workspace.shape != (2, 3) or not np.isfinite([*numbers.values(), *workspace.flat]).all():
        raise MemoryFormatError(f"{where}: 'robot' must hold finite numbers and a (2, 3) workspace")
    return RobotModel(workspace=workspace, **numbers)
