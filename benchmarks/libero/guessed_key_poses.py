"""Key poses from a multimodal model alone, without demonstrations: the paper's memory ablation.

The model is told the instruction, the views, and where the objects are and how large. It answers with the
hand's key poses, which are checked as strictly as a file from a stranger, and refused as a whole.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.mining.phase_labels.base import Picture
from lerobot_openspm.mining.phase_labels.endpoint import ChatEndpoint
from lerobot_openspm.mining.phase_labels.merge import FIRST, LAST, SUCCESSORS
from lerobot_openspm.mining.phase_labels.prompt import MEANINGS_TEXT, Prompt, list_schema, read_object
from lerobot_openspm.mining.phase_labels.qwen3vl import Qwen3VL

MAX_KEY_POSES = 32
# No table is larger, and half a turn is as far as a hand can be turned.
MAX_POSITION_M, MAX_ROTATION_RAD = 2.0, math.pi + 0.01
# Phases with closed fingers around something.
HOLDING = ("grasp", "lift", "pre-place", "place", "open", "turn")

TEXT = """A robot hand shall do this: "{instruction}". The images show the scene, one for each camera.
The scene as JSON (metres in the world, z up; an object's box is turned about z by its yaw in radians):
{scene}
Give the key poses of the hand: where it is when each phase ends, from first to last. The phases are:
{phases}
The position is that of the point between the fingertips, in metres in the world. The rotation is a rotation \
vector in radians about the world's axes, and turns the hand from pointing straight down with its fingers \
opening along the world's y; [0, 0, 0] leaves it so. closed says whether the gripper is closed on the way.
Answer with JSON alone: {{"key_poses": [{{"phase": "approach", "position": [0.1, 0.0, 0.2], \
"rotation": [0.0, 0.0, 0.0], "closed": false}}, ...]}}"""
_TRIPLE = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
FIELDS: dict[str, Any] = {
    "phase": {"type": "string", "enum": list(PHASES)},
    "position": _TRIPLE,
    "rotation": _TRIPLE,
    "closed": {"type": "boolean"},
}


@dataclass(frozen=True)
class SeenObject:
    """An object as a model is told it.

    Attributes:
        name: As in the instruction.
        centre: Of its box in the world ``(3,)``, metres.
        size: Of the box ``(3,)``, metres, along its own axes.
        yaw: Of the box about the world's z, radians.
    """

    name: str
    centre: Array
    size: Array
    yaw: float = 0.0


@dataclass(frozen=True)
class SceneQuestion:
    """Which key poses does an instruction need in a scene?

    Attributes:
        instruction: The task.
        objects: The objects it names.
        hand: Position of the hand ``(3,)``, metres.
        fingers_m: How wide the gripper opens.
        pictures: One picture ``(height, width, 3)`` RGB by camera.
    """

    instruction: str
    objects: tuple[SeenObject, ...]
    hand: Array
    fingers_m: float
    pictures: Mapping[str, Picture] = field(default_factory=dict[str, Picture])

    def prompt(self) -> Prompt:
        """The question as text and pictures."""
        scene = {
            "objects": [
                {"name": o.name, "centre": _rounded(o.centre), "size": _rounded(o.size), "yaw": o.yaw}
                for o in self.objects
            ],
            "hand": _rounded(self.hand),
            "gripper_opens": round(self.fingers_m, 4),
        }
        text = TEXT.format(
            instruction=self.instruction.replace('"', "'"),
            scene=json.dumps(scene, allow_nan=False),
            phases=MEANINGS_TEXT,
        )
        pictures = [(f"Camera {name.rpartition('.')[2]}:", one) for name, one in self.pictures.items()]
        return Prompt(text, pictures, list_schema("key_poses", FIELDS, 2, MAX_KEY_POSES))


def _rounded(values: Array) -> list[float]:
    return [round(float(value), 4) for value in values]


@dataclass(frozen=True)
class GuessedKeyPose:
    """A key pose that a model made up; :data:`TEXT` defines the fields."""

    phase: str
    position: Array
    rotation: Array
    closed: bool


def guess_by_endpoint(question: SceneQuestion, endpoint: ChatEndpoint) -> tuple[GuessedKeyPose, ...]:
    """Key poses from a model behind an endpoint. Raises PhaseLabelError where they cannot be followed."""
    return read_key_poses(endpoint.complete(question.prompt()))


def guess_by_qwen3vl(question: SceneQuestion, model: Qwen3VL) -> tuple[GuessedKeyPose, ...]:
    """Key poses from Qwen3-VL in this process, constrained to those that can be followed."""
    written = model.write(question.prompt(), key_pose_grammar)
    return read_key_poses("".join(piece.text for piece in written))


def read_key_poses(text: str) -> tuple[GuessedKeyPose, ...]:
    """The key poses in a model's JSON.

    Raises:
        PhaseLabelError: They are malformed, out of the world, or no hand can follow them.
    """
    answer = read_object(text)
    items = answer.get("key_poses")
    if set(answer) != {"key_poses"} or not isinstance(items, list) or not 2 <= len(items) <= MAX_KEY_POSES:
        raise PhaseLabelError(f"expected an object with 2 to {MAX_KEY_POSES} 'key_poses' and nothing else")
    poses = tuple(_key_pose(item, f"key_poses[{i}]") for i, item in enumerate(items))
    check_sequence([pose.phase for pose in poses])
    return poses


def check_sequence(phases: Sequence[str]) -> None:
    """Raise PhaseLabelError on phases that no hand can follow, such as a release before a grasp."""
    if phases[0] not in FIRST:
        raise PhaseLabelError(f"the first phase is {phases[0]!r}, expected {' or '.join(FIRST)}")
    for i, (before, after) in enumerate(pairwise(phases), start=2):
        if after not in SUCCESSORS[before]:
            raise PhaseLabelError(
                f"phase {i} is {after!r} after {before!r}, expected {' or '.join(SUCCESSORS[before])}"
            )
    if phases[-1] not in LAST:
        raise PhaseLabelError(f"the last phase is {phases[-1]!r}, expected {' or '.join(LAST)}")


def _key_pose(item: Any, where: str) -> GuessedKeyPose:
    if not isinstance(item, dict) or set(item) != set(FIELDS):
        raise PhaseLabelError(f"{where} is no object with {', '.join(FIELDS)} and nothing else")
    phase, closed = item["phase"], item["closed"]
    if phase not in PHASES:
        raise PhaseLabelError(f"{where}: phase is {str(phase)[:40]!r}, expected one of {', '.join(PHASES)}")
    if not isinstance(closed, bool) or closed not in _grips(phase):
        raise PhaseLabelError(f"{where}: closed is {str(closed)[:40]!r}, which does not go with {phase!r}")
    position, rotation = (_triple(item[name], f"{where}: {name}") for name in ("position", "rotation"))
    if np.abs(position).max() > MAX_POSITION_M:
        raise PhaseLabelError(f"{where}: position is {position}, expected within {MAX_POSITION_M} m")
    if np.linalg.norm(rotation) > MAX_ROTATION_RAD:
        raise PhaseLabelError(f"{where}: rotation is {rotation}, expected up to half a turn")
    return GuessedKeyPose(phase, position, rotation, closed)


def _triple(values: Any, where: str) -> Array:
    if not isinstance(values, list) or [type(v) in (int, float) for v in values] != [True] * 3:
        raise PhaseLabelError(f"{where} is {str(values)[:60]}, expected three numbers")
    try:
        return np.array([float(v) for v in values])
    except OverflowError as error:
        raise PhaseLabelError(f"{where} has a number that is too large") from error


def _grips(phase: str) -> tuple[bool, ...]:
    """Whether the gripper may be closed on the way to a key pose; an empty hand may be closed too."""
    return (True,) if phase in HOLDING else (False,) if phase == "release" else (False, True)


# How `key_pose_grammar` writes a pose: the phase, six numbers of four pieces each, the gripper, what follows.
_BEGIN, _END, _NUMBER = '{"key_poses": [', "]}", 4
_PIECES = 1 + 6 * _NUMBER + 1 + 1
# After this many key poses only the shortest way to an end is left.
_ENOUGH = 16


def key_pose_grammar(written: tuple[str, ...]) -> tuple[str, ...]:
    """JSON of key poses that :func:`read_key_poses` accepts, with three decimals.

    See :data:`lerobot_openspm.mining.phase_labels.qwen3vl.Grammar`.
    """
    if not written:
        return (_BEGIN,)
    if written[-1] == _END:
        return ()
    number, at = divmod(len(written) - 1, _PIECES)
    phases = [piece.split('"')[3] for piece in written[1::_PIECES]]
    if at == 0:
        return tuple(f'{{"phase": "{phase}", "position": [' for phase in _next(phases))
    if at <= 6 * _NUMBER:
        return _digits(*divmod(at - 1, _NUMBER))
    if at == 6 * _NUMBER + 1:
        return tuple(f'], "closed": {json.dumps(closed)}}}' for closed in _grips(phases[-1]))
    if phases[-1] not in LAST:
        return (", ",)
    return (_END,) if number + 1 >= _ENOUGH else (", ", _END)


def _next(phases: list[str]) -> tuple[str, ...]:
    """The phases that may come next; none more than twice in a row."""
    if not phases:
        return FIRST
    following = SUCCESSORS[phases[-1]]
    if phases[-2:] == [phases[-1]] * 2 or len(phases) >= _ENOUGH:
        following = tuple(phase for phase in following if phase != phases[-1])
    return following


def _digits(number: int, place: int) -> tuple[str, ...]:
    """One of four pieces of one of six numbers: the integer part, or a digit after the point."""
    if place:
        return tuple("0123456789")
    before = '], "rotation": [' if number == 3 else "" if number == 0 else ", "
    # Tilts below 1 and yaws below 2 radians stay below half a turn; a hand that points down needs no more.
    wholes = ("0.", "1.") if number < 3 or number == 5 else ("0.",)
    return tuple(f"{before}{sign}{whole}" for sign in ("", "-") for whole in wholes)
