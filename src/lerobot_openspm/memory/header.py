"""What ``memory.json`` says besides naming the other files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry.vector_layout import ROTATION_KINDS, VectorLayout, parse_layout
from lerobot_openspm.memory.fields import MALFORMED, integer, known, readable, text, texts
from lerobot_openspm.memory.files import FORMAT, VERSION, Fields
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.memory.store import robot_from_dict, robot_to_dict
from lerobot_openspm.perception.objects.kinds import SHAPES
from lerobot_openspm.perception.segmentation.make import SEGMENTERS

PERCEPTIONS = ("demonstrations", "oracle")
NAMES = frozenset(
    (
        "format", "version", "sha256", "perception", "segmentation", "shape", "simulator_objects", "layouts",
        "robot", "objects", "n_entries", "anchored", "files",
    )
)  # fmt: skip

FILES = frozenset(("entries", "arrays", "cameras"))

Layouts = tuple[VectorLayout, VectorLayout]


@dataclass(frozen=True)
class Header:
    """The header of a memory.

    Attributes:
        perception: As in a memory, like the four that follow.
        segmentation: What found the objects' pixels.
        shape: What was learned of the objects.
        simulator_objects: Objects in the order of the simulator's pose vector.
        layouts: Of the robot's state and action vectors; None where it is not known.
        robot: The robot.
        objects: Fields of the objects' models.
        n_entries: How many of the entries are in use; those after them are superseded.
        anchored: Names of all objects that entries have key poses at.
    """

    perception: str
    segmentation: str
    shape: str
    simulator_objects: tuple[str, ...]
    layouts: Layouts | None
    robot: RobotModel
    objects: list[Fields]
    n_entries: int
    anchored: tuple[str, ...]


def header_to_fields(header: Header) -> Fields:
    """The JSON form of a header."""
    layouts = None
    if header.layouts is not None:
        state, action = ({"names": list(v.names), "rotation": v.rotation_kind} for v in header.layouts)
        layouts = {"state": state, "action": action}
    return {
        "format": FORMAT,
        "version": VERSION,
        "n_entries": header.n_entries,
        "perception": header.perception,
        "segmentation": header.segmentation,
        "shape": header.shape,
        "simulator_objects": list(header.simulator_objects),
        "layouts": layouts,
        "robot": robot_to_dict(header.robot),
        "objects": header.objects,
        "anchored": list(header.anchored),
    }


def header_from_fields(fields: Fields, where: str) -> Header:
    """Inverse of :func:`header_to_fields`, for all versions.

    Args:
        fields: Of a format and version that is known.
        where: Names the file in errors.

    Raises:
        MemoryFormatError: A field is missing, unknown, or of another type. Names file and field.
    """
    is_old = fields["version"] < 5
    try:
        if not is_old:
            known(fields, NAMES, "the header")
            known(fields["files"], FILES, "'files'")
        _ = fields["arrays"]["sha256"] if is_old else fields["files"]
        objects, rows = fields["objects"], fields["entries"] if is_old else []
        if not isinstance(rows, list) or not isinstance(objects, list):
            raise MemoryFormatError(f"{where}: 'entries' and 'objects' must be lists")
        for model in objects:
            if not isinstance(model, dict):
                raise MemoryFormatError(
                    f"{where}: 'objects' must hold JSON objects, got {type(model).__name__}"
                )
        _check_names(objects)
        return Header(
            _choice(fields, "perception", PERCEPTIONS, where),
            # Until version 3 nothing else was known.
            _choice({"segmentation": "demonstrations"} | fields, "segmentation", SEGMENTERS, where),
            _choice({"shape": "demonstrations"} | fields, "shape", SHAPES, where),
            texts(fields, "simulator_objects"),
            None if is_old else _layouts(fields["layouts"]),
            robot_from_dict(fields["robot"], where),
            objects,
            len(rows) if is_old else integer(fields, "n_entries"),
            () if is_old else texts(fields, "anchored"),
        )
    except MemoryFormatError:
        raise
    except MALFORMED as error:
        reason = f"field {error} is missing" if isinstance(error, KeyError) else f"malformed: {error}"
        raise MemoryFormatError(f"{where}: {reason}; train or pull it again") from error


def _check_names(objects: list[Fields]) -> None:
    names: set[str] = set()
    for model in objects:
        name = readable(model["name"], "the name of one of the 'objects'", line=True)
        if name in names:
            raise ValueError(f"'objects' has {name!r} twice, expected each name once")
        names.add(name)


def _choice(fields: Fields, name: str, choices: tuple[str, ...], where: str) -> str:
    if fields[name] not in choices:
        raise MemoryFormatError(f"{where}: {name} is {fields[name]!r}, expected one of {', '.join(choices)}")
    return fields[name]


def _layouts(fields: Any) -> Layouts | None:
    if fields is None:
        return None
    fields = known(fields, frozenset(("state", "action")), "'layouts'")
    return _layout(fields["state"], "state"), _layout(fields["action"], "action")


def _layout(fields: Any, what: str) -> VectorLayout:
    fields = known(fields, frozenset(("names", "rotation")), f"the {what}'s layout")
    kind = text(fields, "rotation")
    if kind not in ROTATION_KINDS:
        raise ValueError(f"the {what}'s rotation is {kind!r}, expected one of {', '.join(ROTATION_KINDS)}")
    return parse_layout(texts(fields, "names"), what, kind)


def check_layouts(ours: Layouts | None, theirs: Layouts | None, whose: str, where: str) -> None:
    """Two layouts have to mean the same by the same numbers, whatever those are called.

    Args:
        ours: Layouts of state and action that the memory was mined with; None where it is not known.
        theirs: Those of something that is to go with it.
        whose: Names the latter in errors: "the checkpoint's".
        where: Names the memory in errors.

    Raises:
        MemoryFormatError: They are of different robots.
    """
    if ours is None or theirs is None:
        return
    for what, own, other in zip(("state", "action"), ours, theirs, strict=True):
        if _meaning(own) != _meaning(other):
            raise MemoryFormatError(
                f"{where}: 'layouts': the memory's {what} is {list(own.names)} with rotation "
                f"{own.rotation_kind}, {whose} {list(other.names)} with rotation {other.rotation_kind}: they "
                "are of different robots or controllers and cannot go together"
            )


def _meaning(layout: VectorLayout) -> tuple[Any, ...]:
    return (layout.size, layout.position, layout.rotation, layout.rotation_kind, layout.gripper)
