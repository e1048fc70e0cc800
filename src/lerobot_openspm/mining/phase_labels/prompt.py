"""What a multimodal model is told, and how its answer is read."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.mining.phase_labels.base import PhaseLabel, PhaseLabels, PhaseQuestion, Picture

# Version of the texts below. It is part of every cached label's key, because another text may be answered
# otherwise.
WORDING = 1

MEANINGS = {
    "approach": "the empty hand has come nearer to what it will touch next",
    "grasp": "the fingers have closed around something",
    "lift": "the hand has raised what it holds from where it was",
    "pre-place": "the hand has brought what it holds above or before the place where it goes",
    "place": "what the hand holds has arrived where it goes, the fingers are still closed",
    "release": "the fingers have opened and let go",
    "retreat": "the empty hand has moved away from what it let go or pushed",
    "push": "the hand has pushed something along without holding it",
    "open": "the hand has pulled or slid a held part, such as a drawer, open or shut",
    "turn": "the hand has turned a held part, such as a knob",
}
MEANINGS_TEXT = "\n".join(f"- {phase}: {meaning}" for phase, meaning in MEANINGS.items())
INTRODUCTION = """A robot hand was guided through this task: "{instruction}".
Each image is a contact sheet of one camera. Its tiles, row by row, show {n} candidate moments, with their \
numbers in the corner; tiles of the same number in different images show the same moment.
The trajectory as JSON (seconds; metres and rotation vectors in the world, z up; opening 0 shut to 1 wide):
{trajectory}
Which phase ends at each candidate moment? The phases are:
{phases}
"""
AS_JSON = """Answer with JSON alone, one item for each of the {n} candidates, in order: \
{{"phases": [{{"candidate": 1, "phase": "approach", "confidence": 0.9}}, ...]}}. \
The confidence is the probability, 0 to 1, that your phase is right."""
AS_LINES = "Answer with one line for each of the {n} candidates, in order: its number, a colon and its phase."


@dataclass(frozen=True)
class Prompt:
    """A question to a multimodal model.

    Attributes:
        text: The question.
        pictures: The pictures that it is about, RGB, each after its caption.
        schema: JSON schema of the answer, for servers that can enforce one.
    """

    text: str
    pictures: Sequence[tuple[str, Picture]]
    schema: Mapping[str, Any]


def phase_prompt(question: PhaseQuestion, ending: str) -> Prompt:
    """The question as text and pictures; `ending` is :data:`AS_JSON` or :data:`AS_LINES`."""
    n = len(question.candidates)
    introduction = INTRODUCTION.format(
        instruction=question.instruction.replace('"', "'"),
        n=n,
        trajectory=question.trajectory_json(),
        phases=MEANINGS_TEXT,
    )
    pictures = [
        (f"Camera {camera.rpartition('.')[2]}:", sheet)
        for camera, sheets in question.sheets.items()
        for sheet in sheets
    ]
    label = {
        "candidate": {"type": "integer"},
        "phase": {"type": "string", "enum": list(PHASES)},
        "confidence": {"type": "number", "minimum": 0, "maximum": 1},
    }
    return Prompt(introduction + ending.format(n=n), pictures, list_schema("phases", label, n, n))


def list_schema(name: str, fields: Mapping[str, Any], least: int, most: int) -> dict[str, Any]:
    """JSON schema of an object with one list of `least` to `most` objects with these fields."""

    def only(properties: Mapping[str, Any]) -> dict[str, Any]:
        return {
            "type": "object",
            "properties": properties,
            "required": list(properties),
            "additionalProperties": False,
        }

    return only({name: {"type": "array", "items": only(fields), "minItems": least, "maxItems": most}})


def read_phases(text: str, n: int) -> PhaseLabels:
    """The labels in a model's JSON. An item that is malformed, or comes twice, is no label.

    Raises:
        PhaseLabelError: It is no such JSON, or all of its items are malformed.
    """
    items = read_object(text).get("phases")
    if not isinstance(items, list):
        raise PhaseLabelError(f"the answer's 'phases' is {_short(items)}, expected a list")
    labels: dict[int, PhaseLabel | None] = {}
    for item in items:
        number = item.get("candidate") if isinstance(item, dict) else None
        if type(number) is int and 1 <= number <= n:
            labels[number] = None if number in labels else _label(item)
    read = tuple(labels.get(number) for number in range(1, n + 1))
    if not any(read):
        raise PhaseLabelError(f"none of the {len(items)} items in the answer makes sense: {_short(items)}")
    return read


def _label(item: Any) -> PhaseLabel | None:
    try:
        return PhaseLabel.from_json(item)
    except PhaseLabelError:
        return None


def read_object(text: str) -> dict[str, Any]:
    """The JSON object in a model's answer, without its thoughts and the fences around it.

    Raises:
        PhaseLabelError: There is none.
    """
    spoken = re.sub(r"<think>.*?</think>", "", text, flags=re.DOTALL)
    begin = spoken.find("{")
    try:
        if begin < 0:
            raise ValueError("there is no '{'")
        found, _ = json.JSONDecoder(parse_constant=_refuse).raw_decode(spoken, begin)
    except (ValueError, RecursionError) as error:
        raise PhaseLabelError(f"the answer is no JSON ({error}): {_short(text)}") from error
    return found


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 120 else f"{text[:120]} ..."
