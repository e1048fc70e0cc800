"""The JSON of a memory: a schema for each object in it, and the rules that a schema cannot state."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct

from lerobot_openspm.errors import LayoutError, MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import MAX_JOINTS, Arm
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.geometry.vector_layout import RotationKind, parse_layout
from lerobot_openspm.memory.entry import AxisKind, MemoryEntry, Phase
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.types import OWN_WORDS, SubTask

VERSION = 10
AGAIN = "train or pull it again"
# More than any robot, unit or count needs; sums and products of such numbers stay finite and exact.
LIMIT = 1e9

# Control characters, which a terminal would obey, and lone surrogates, which no UTF-8 file can hold.
_CONTROL = r"\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff"
_LINE = rf"[^\t\n\r{_CONTROL}]"
Text = Annotated[str, Meta(pattern=rf"\A(?=[\s\S]*\S)[^{_CONTROL}]+\Z")]
Line = Annotated[str, Meta(pattern=rf"\A(?=.*\S){_LINE}+\Z")]
Name = Annotated[str, Meta(pattern=rf"\A(?=.*\S){_LINE}+\Z", max_length=1000)]
# Part of an instruction; may be empty.
Words = Annotated[str, Meta(pattern=rf"\A{_LINE}*\Z", max_length=10_000)]

Count = Annotated[int, Meta(ge=0, le=int(LIMIT))]
Share = Annotated[float, Meta(ge=0, le=1)]
Number = Annotated[float, Meta(ge=-LIMIT, le=LIMIT)]
NotNegative = Annotated[float, Meta(ge=0, le=LIMIT)]
Gain = Annotated[float, Meta(ge=-1000, le=1000)]
Speed = Annotated[float, Meta(ge=0, le=1000)]
Vector = Annotated[list[Number], Meta(min_length=3, max_length=3)]
Corners = Annotated[list[Vector], Meta(min_length=2, max_length=2)]
_Row4 = Annotated[list[Number], Meta(min_length=4, max_length=4)]
Transform = Annotated[list[_Row4], Meta(min_length=4, max_length=4)]
_Row6 = Annotated[list[Number], Meta(min_length=6, max_length=6)]
Covariance = Annotated[list[_Row6], Meta(min_length=6, max_length=6)]


class Record(Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A JSON object. Unknown fields are refused; fields at their default are not written."""


# Operations, relations and references are plain text here: only the language room knows their lists.
class _Reference(Record):
    relation: Name
    landmarks: list[Name] = []


class _SubTask(Record):
    operation: Name
    target: Words
    part: Words = ""
    relation: Words = ""
    landmark: Words = ""
    target_where: _Reference | None = None
    landmark_where: _Reference | None = None
    words: Words = ""


class _Key(Record):
    sub_tasks: Annotated[list[_SubTask], Meta(min_length=1)]
    phases: list[Phase]


class _Anchor(Record):
    place: Name
    axes: Name


class _Axis(Record):
    kind: AxisKind
    direction: Vector
    amount: Number


class _KeyPose(Record, kw_only=True):
    phase: Phase
    sub_task: Count = 0
    anchor: _Anchor
    closed: bool
    opening: Number
    n_steps: Count
    dwell: bool
    confidence: Share
    T_obj_ee: Transform
    axis: _Axis | None = None
    covariance: Covariance | None = None


class _Outcome(Record):
    sub_task: Count
    target: Name
    anchor: _Anchor
    position: Vector
    shown: Vector
    tolerance_m: NotNegative
    middle: tuple[Number, Number] = (0.0, 0.0)


class _Entry(Record, kw_only=True):
    source: Line
    language: Text
    version: Annotated[int, Meta(ge=1, le=int(LIMIT))]
    quality: Share
    trials: Count = 0
    successes: Count = 0
    key: _Key
    object_poses: dict[Name, Transform]
    key_poses: Annotated[list[_KeyPose], Meta(min_length=1)]
    outcomes: list[_Outcome] = []


class _Joint(Record):
    T_before_joint: Transform
    axis: Vector
    limits: Annotated[list[Number], Meta(min_length=2, max_length=2)]


class _Arm(Record):
    joints: Annotated[list[_Joint], Meta(min_length=1, max_length=MAX_JOINTS)]
    T_last_ee: Transform


class _Robot(Record):
    close_command: Number
    open_command: Number
    open_width: NotNegative
    metres_per_action: Gain
    radians_per_action: Gain
    metres_per_step: Speed
    workspace: Corners
    arm: _Arm | None = None


class _Vector(Record):
    names: list[Name]
    rotation: RotationKind


class _Layouts(Record):
    state: _Vector
    action: _Vector


class Origin(Record):
    """Where entries come from; the attributes of :class:`~lerobot_openspm.memory.memory.Memory`."""

    format: Name
    version: int
    perception: Name
    segmentation: Name
    shape: Name
    simulator_objects: list[Name]
    layouts: _Layouts | None
    robot: _Robot


def loads(text: bytes, where: str) -> Any:
    """Parse standard JSON.

    Args:
        text: The text, UTF-8.
        where: Names its origin in errors.

    Raises:
        MemoryFormatError: It is not JSON, holds NaN or an infinity, has a key twice, or is nested too deeply.
    """
    try:
        return _DECODER.decode(text.decode())
    except (ValueError, RecursionError) as error:
        raise MemoryFormatError(f"{where}: truncated, changed or not JSON ({error}); {AGAIN}") from error


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        ((key, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"key {key!r} twice")
    return fields


def _constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")


_DECODER = json.JSONDecoder(object_pairs_hook=_object, parse_constant=_constant)


def checked[T](fields: Any, schema: type[T], where: str) -> T:
    """Parsed JSON as a record. Raises MemoryFormatError naming file and field where it does not fit."""
    try:
        return msgspec.convert(fields, schema)
    except (msgspec.ValidationError, UnicodeEncodeError) as error:
        raise MemoryFormatError(f"{where}: malformed: {_told(error)}; {AGAIN}") from error


def record_of[T: Record](value: Any, schema: type[T], what: str) -> T:
    """A value that is to be written, as a record. Raises MemoryFormatError if it could not be read again."""
    try:
        return msgspec.convert(msgspec.to_builtins(value, enc_hook=_without_numpy), schema)
    except (msgspec.ValidationError, UnicodeEncodeError) as error:
        raise MemoryFormatError(
            f"{what} could never be loaded again, so nothing was saved: {_told(error)}; export it, correct "
            "that, and add it again"
        ) from error


def _built[T](fields: Any, kind: type[T]) -> T:
    """The dataclass of parsed JSON that fits its schema; lists become arrays."""
    return msgspec.convert(fields, kind, dec_hook=lambda _, value: np.array(value, np.float64))


def _without_numpy(value: Any) -> Any:
    return value.tolist()


def _told(error: Exception) -> str:
    """The text of a msgspec error, with the pattern of a text said in words."""
    return re.sub(r"matching regex '.*'", "of printable characters, not empty", str(error))


def entry_from_json(text: bytes, where: str) -> MemoryEntry:
    """Read one entry's JSON; `where` names it in errors.

    Raises:
        MemoryFormatError: It is not JSON, or a field is missing, unknown, of another type, or out of range.
    """
    return entry_from_fields(loads(text, where), where)


def entry_from_fields(fields: Any, where: str) -> MemoryEntry:
    """One entry of parsed JSON. Raises MemoryFormatError as :func:`entry_from_json` does."""
    checked(fields, _Entry, where)
    entry = _built(fields, MemoryEntry)
    if wrong := _wrong(entry):
        raise MemoryFormatError(f"{where}: malformed: {wrong}; {AGAIN}")
    return entry


def entry_to_json(entry: MemoryEntry) -> bytes:
    """One entry as JSON on one line. Raises MemoryFormatError where it could not be read again."""
    return msgspec.json.encode(record_of(entry, _Entry, f"the entry of {entry.source!r}"))


def _wrong(entry: MemoryEntry) -> str:
    """What a schema cannot state: fields that contradict each other, invalid matrices. "" if all is well."""
    poses, n_sub_tasks = entry.key_poses, len(entry.key.sub_tasks)
    needed = {name for one in (*poses, *entry.outcomes) for name in one.anchor.objects}
    needed |= {outcome.target for outcome in entry.outcomes}
    last = max(one.sub_task for one in (*poses, *entry.outcomes))
    if entry.key.phases != tuple(pose.phase for pose in poses):
        return f"'phases' are {entry.key.phases}, but its 'key_poses' have others"
    if unknown := sorted(needed - entry.object_poses.keys()):
        return f"anchors {unknown} are not in its 'object_poses' {sorted(entry.object_poses)}"
    if last >= n_sub_tasks:
        return f"'sub_task' is {last}, but the entry has {n_sub_tasks} sub-tasks from 0 on"
    if entry.successes > entry.trials:
        return f"'successes' is {entry.successes}, more than the {entry.trials} 'trials'"
    if not se3.is_rigid(np.stack([pose.T_obj_ee for pose in poses])):
        return "'T_obj_ee' of its 'key_poses' are not rigid transforms"
    if entry.object_poses and not se3.is_rigid(np.stack(list(entry.object_poses.values()))):
        return "'object_poses' holds other than rigid transforms"
    directions = [pose.axis.direction for pose in poses if pose.axis is not None]
    if directions and not (np.abs(np.linalg.norm(directions, axis=1) - 1) < 1e-6).all():
        return f"'direction' of an 'axis' is {np.array(directions).tolist()}, expected unit vectors"
    spreads = (_wrong_covariance(pose.covariance) for pose in poses if pose.covariance is not None)
    return next((wrong for wrong in (*spreads, _wrong_words(entry.key.sub_tasks)) if wrong), "")


def _wrong_words(sub_tasks: Sequence[SubTask]) -> str:
    for sub_task in sub_tasks:
        if (sub_task.operation == OWN_WORDS) != bool(sub_task.words):
            return (
                f"a sub-task of 'operation' {sub_task.operation!r} has the 'words' {sub_task.words!r}, "
                f"expected words where the operation is {OWN_WORDS!r}, and only there"
            )
    return ""


def _wrong_covariance(covariance: Array) -> str:
    scale = float(np.abs(covariance).max())
    if not np.allclose(covariance, covariance.T, rtol=0, atol=1e-9 * scale):
        return "'covariance' is not symmetric"
    if np.linalg.eigvalsh(covariance)[0] < -1e-9 * scale:
        return "'covariance' is not positive semi-definite"
    return ""


def _wrong_arm(arm: Arm) -> str:
    if not se3.is_rigid(np.stack([*(joint.T_before_joint for joint in arm.joints), arm.T_last_ee])):
        return "the 'arm' of the 'robot' has transforms that are not rigid"
    for one in arm.joints:
        if not one.limits[0] < one.limits[1] or abs(np.linalg.norm(one.axis) - 1) > 1e-6:
            told = f"a joint of the 'arm' has 'limits' {one.limits.tolist()} and 'axis' {one.axis.tolist()}"
            return f"{told}, expected the lower limit first and a unit vector"
    return ""


def origin_of(memory: Memory, file_format: str) -> dict[str, Any]:
    """The fields of a memory's :class:`Origin`."""
    layouts = None
    if memory.layouts is not None:
        state, action = ({"names": v.names, "rotation": v.rotation_kind} for v in memory.layouts)
        layouts = {"state": state, "action": action}
    names = "perception", "segmentation", "shape", "simulator_objects", "robot"
    own = {name: getattr(memory, name) for name in names}
    return {"format": file_format, "version": VERSION, **own, "layouts": layouts}


def memory_from(origin: Origin, where: str, **others: Any) -> Memory:
    """A memory of this origin, its other attributes as given. Raises MemoryFormatError."""
    robot = _built(msgspec.to_builtins(origin.robot), RobotModel)
    if not (robot.workspace[0] <= robot.workspace[1]).all():
        raise MemoryFormatError(
            f"{where}: 'workspace' of the 'robot' is {robot.workspace.tolist()}, expected the lowest, then "
            f"the highest corner; {AGAIN}"
        )
    if robot.arm is not None and (wrong := _wrong_arm(robot.arm)):
        raise MemoryFormatError(f"{where}: {wrong}; {AGAIN}")
    layouts = None
    try:
        if (both := origin.layouts) is not None:
            vectors = (("state", both.state), ("action", both.action))
            state, action = (parse_layout(v.names, what, v.rotation) for what, v in vectors)
            layouts = state, action
    except LayoutError as error:
        raise MemoryFormatError(f"{where}: 'layouts': {error}") from error
    return Memory(
        robot=robot,
        perception=origin.perception,
        segmentation=origin.segmentation,
        shape=origin.shape,
        simulator_objects=tuple(origin.simulator_objects),
        layouts=layouts,
        **others,
    )
