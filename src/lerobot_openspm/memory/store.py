"""Entries and the robot model as JSON that a person can read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, cast, get_args

import numpy as np

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.language.lexicon import OPERATIONS as VERBS
from lerobot_openspm.language.lexicon import REFERENCES, RELATIONS
from lerobot_openspm.memory.entry import (
    PHASES,
    Anchor,
    Axis,
    AxisKind,
    MemoryEntry,
    MemoryKeyPose,
    Outcome,
    RetrievalKey,
)
from lerobot_openspm.memory.fields import (
    LIMIT,
    MALFORMED,
    Fields,
    choice,
    flag,
    integer,
    known,
    line,
    number,
    numbers,
    readable,
    text,
    texts,
)
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.types import OWN_WORDS, Reference, SubTask

ENTRY = frozenset(
    (
        "source", "language", "version", "quality", "trials", "successes", "key", "layout", "key_poses",
        "outcomes",
    )
)  # fmt: skip
KEY_POSE = frozenset(
    (
        "phase", "anchor", "T_obj_ee", "closed", "opening", "n_steps", "dwell", "confidence", "sub_task",
        "axis", "covariance",
    )
)  # fmt: skip
OUTCOME = frozenset(Outcome.__dataclass_fields__)
SUB_TASK = frozenset(SubTask.__dataclass_fields__)
OPERATIONS = (*VERBS, OWN_WORDS)
# "center" is what the grammar has for "in the middle of"; a goal has none where nothing is moved anywhere.
GOALS = (*RELATIONS, "center", "")
# What the numbers of a robot are between, wide enough for any units.
ROBOT = {
    "close_command": (-LIMIT, LIMIT), "open_command": (-LIMIT, LIMIT), "open_width": (0.0, LIMIT),
    "metres_per_action": (-1e3, 1e3), "radians_per_action": (-1e3, 1e3), "metres_per_step": (0.0, 1e3),
}  # fmt: skip


def entry_to_fields(entry: MemoryEntry) -> dict[str, Any]:
    """The JSON form of an entry. Transforms are their first three rows; what is empty is left out."""
    fields: dict[str, Any] = {
        "source": entry.source,
        "language": entry.language,
        "version": entry.version,
        "quality": entry.quality,
        "trials": entry.trials,
        "successes": entry.successes,
        "key": {
            "sub_tasks": [_sub_task_fields(sub_task) for sub_task in entry.key.sub_tasks],
            "phases": list(entry.key.phases),
        },
        "layout": {name: T[:3].tolist() for name, T in entry.layout.items()},
        "key_poses": [_key_pose_fields(pose) for pose in entry.key_poses],
    }
    if entry.outcomes:
        fields["outcomes"] = [_outcome_fields(outcome) for outcome in entry.outcomes]
    return fields


def _outcome_fields(outcome: Outcome) -> dict[str, Any]:
    return {
        "sub_task": outcome.sub_task,
        "target": outcome.target,
        "anchor": {"place": outcome.anchor.place, "axes": outcome.anchor.axes},
        "position": outcome.position.tolist(),
        "shown": outcome.shown.tolist(),
        "tolerance_m": outcome.tolerance_m,
    }


def _sub_task_fields(sub_task: SubTask) -> dict[str, Any]:
    return {name: value for name, value in asdict(sub_task).items() if value or name == "target"}


def _key_pose_fields(pose: MemoryKeyPose) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "phase": pose.phase,
        "sub_task": pose.sub_task,
        "anchor": {"place": pose.anchor.place, "axes": pose.anchor.axes},
        "closed": pose.closed,
        "opening": pose.opening,
        "n_steps": pose.n_steps,
        "dwell": pose.dwell,
        "confidence": pose.confidence,
        "T_obj_ee": pose.T_obj_ee[:3].tolist(),
    }
    if pose.axis is not None:
        axis = pose.axis
        fields["axis"] = {"kind": axis.kind, "direction": axis.direction.tolist(), "amount": axis.amount}
    if pose.covariance is not None:
        fields["covariance"] = pose.covariance.tolist()
    return fields


def entry_from_fields(fields: Any) -> MemoryEntry:
    """Inverse of :func:`entry_to_fields`.

    Raises:
        KeyError, TypeError, ValueError: A field is missing, unknown, of another type, or out of range. The
            error names it; :data:`~lerobot_openspm.memory.fields.MALFORMED` has all that may be raised.
    """
    fields = known(fields, ENTRY, "the entry")
    key = known(fields["key"], frozenset(("sub_tasks", "phases")), "'key'")
    sub_tasks = tuple(_sub_task(item) for item in key["sub_tasks"])
    rows = [known(row, KEY_POSE, "a key pose") for row in fields["key_poses"]]
    if not rows or not sub_tasks:
        raise ValueError("an entry needs a sub-task and a key pose")
    named = known(fields["layout"], frozenset(fields["layout"]), "'layout'")
    for name in named:
        readable(name, "a name in 'layout'", line=True)
    poses = _transforms([row["T_obj_ee"] for row in rows], "T_obj_ee of the key poses")
    layout = dict(zip(named, _transforms(list(named.values()), "'layout'"), strict=True))
    key_poses = tuple(_key_pose(row, T, len(sub_tasks)) for row, T in zip(rows, poses, strict=True))
    outcomes = tuple(_outcome(row, len(sub_tasks)) for row in fields.get("outcomes", []))
    needed = [pose.anchor.objects for pose in key_poses] + [outcome.objects for outcome in outcomes]
    if unknown := {name for names in needed for name in names} - set(layout):
        raise ValueError(f"anchors {sorted(unknown)} are not in its layout {sorted(layout)}")
    phases = texts(key, "phases")
    if phases != tuple(pose.phase for pose in key_poses):
        raise ValueError(f"'phases' are {phases}, but its key poses have others")
    trials = integer(fields, "trials")
    successes = integer(fields, "successes")
    if successes > trials:
        raise ValueError(f"'successes' is {successes}, more than the {trials} 'trials'")
    return MemoryEntry(
        RetrievalKey(sub_tasks, phases), _instruction(fields), key_poses,
        number(fields, "quality", 0, 1), integer(fields, "version", 1), line(fields, "source"), layout,
        trials, successes, outcomes,
    )  # fmt: skip


def _instruction(fields: Fields) -> str:
    if not (language := text(fields, "language")).strip():
        raise ValueError("'language' is empty, expected the instruction of the demonstration")
    return language


def _sub_task(fields: Any) -> SubTask:
    fields = known(fields, SUB_TASK, "a sub-task")
    words = {name: text(fields, name) for name in fields if not name.endswith("_where")}
    for name, choices in (("operation", OPERATIONS), ("relation", GOALS)):
        if name in words:
            choice(fields, name, choices)
    if (words.get("operation") == OWN_WORDS) != bool(words.get("words")):
        raise ValueError(
            f"a sub-task of operation {words.get('operation')!r} has the words {words.get('words', '')!r}, "
            f"expected words where the operation is {OWN_WORDS!r}, and only there"
        )
    return SubTask(
        **words,
        target_where=_reference(fields.get("target_where")),
        landmark_where=_reference(fields.get("landmark_where")),
    )


def _reference(fields: Any) -> Reference | None:
    if fields is None:
        return None
    fields = known(fields, frozenset(("relation", "landmarks")), "which of several objects is meant")
    return Reference(choice(fields, "relation", REFERENCES), texts(fields, "landmarks"))


def _key_pose(fields: Fields, T_obj_ee: Array, n_sub_tasks: int) -> MemoryKeyPose:
    phase = text(fields, "phase")
    if phase not in PHASES:
        raise ValueError(f"phase is {phase!r}, expected one of {PHASES}")
    axis, covariance = fields.get("axis"), fields.get("covariance")
    return MemoryKeyPose(
        _anchor(fields),
        T_obj_ee,
        phase,
        number(fields, "confidence", 0, 1),
        flag(fields, "closed"),
        number(fields, "opening"),
        integer(fields, "n_steps"),
        flag(fields, "dwell"),
        None if axis is None else _axis(axis),
        _sub_task_number(fields, n_sub_tasks),
        None if covariance is None else _covariance(covariance),
    )


def _anchor(fields: Fields) -> Anchor:
    anchor = known(fields["anchor"], frozenset(("place", "axes")), "'anchor'")
    return Anchor(text(anchor, "place"), text(anchor, "axes"))


def _sub_task_number(fields: Fields, n_sub_tasks: int) -> int:
    if (sub_task := integer(fields, "sub_task")) >= n_sub_tasks:
        raise ValueError(f"'sub_task' is {sub_task}, but the entry has {n_sub_tasks} sub-tasks from 0 on")
    return sub_task


def _outcome(fields: Any, n_sub_tasks: int) -> Outcome:
    fields = known(fields, OUTCOME, "an outcome")
    return Outcome(
        _sub_task_number(fields, n_sub_tasks),
        line(fields, "target"),
        _anchor(fields),
        numbers(fields["position"], (3,), "the outcome's 'position'"),
        numbers(fields["shown"], (3,), "the outcome's 'shown'"),
        number(fields, "tolerance_m", 0),
    )


def _axis(fields: Any) -> Axis:
    fields = known(fields, frozenset(("kind", "direction", "amount")), "'axis'")
    kind, direction = text(fields, "kind"), numbers(fields["direction"], (3,), "the axis's unit 'direction'")
    if kind not in get_args(AxisKind):
        raise ValueError(f"axis is of kind {kind!r}, expected one of {get_args(AxisKind)}")
    if not abs(float(np.linalg.norm(direction)) - 1) < 1e-6:
        raise ValueError(f"axis has direction {direction.tolist()}, expected a unit vector of 3 numbers")
    return Axis(cast(AxisKind, kind), direction, number(fields, "amount"))


def _covariance(value: Any) -> Array:
    covariance = numbers(value, (6, 6), "'covariance'")
    scale = float(np.abs(covariance).max())
    if not np.allclose(covariance, covariance.T, rtol=0, atol=1e-9 * scale):
        raise ValueError("'covariance' is not symmetric")
    if np.linalg.eigvalsh(covariance)[0] < -1e-9 * scale:
        raise ValueError("'covariance' is not positive semi-definite")
    return covariance


def _transforms(rows: list[Any], what: str) -> Array:
    """Rigid transforms ``(n, 4, 4)`` of their first three rows each."""
    T = np.zeros((len(rows), 4, 4))
    T[:, 3, 3] = 1
    if rows:
        T[:, :3] = numbers(rows, (len(rows), 3, 4), what)
    if not se3.is_rigid(T):
        raise ValueError(f"{what} must be rigid transforms, three rows of four numbers each")
    return T


def robot_to_dict(robot: RobotModel) -> dict[str, Any]:
    """The JSON form of a robot model."""
    return {**asdict(robot), "workspace": robot.workspace.tolist()}


def robot_from_dict(fields: Mapping[str, Any], where: str) -> RobotModel:
    """Inverse of :func:`robot_to_dict`. Raises MemoryFormatError naming file and field."""
    try:
        fields = known(fields, frozenset(RobotModel.__dataclass_fields__), "the robot")
        own = {name: number(fields, name, *within) for name, within in ROBOT.items()}
        workspace = numbers(fields["workspace"], (2, 3), "'workspace'")
        if not (workspace[0] <= workspace[1]).all():
            raise ValueError(
                f"'workspace' is {workspace.tolist()}, expected the lowest, then the highest corner"
            )
        return RobotModel(workspace=workspace, **own)
    except MALFORMED as error:
        raise MemoryFormatError(
            f"{where}: 'robot' is malformed: {error!r}; train or pull it again"
        ) from error
