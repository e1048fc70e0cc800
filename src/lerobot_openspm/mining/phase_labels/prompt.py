"""What a multimodal model is told, and how its answer is read."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from lerobot_openspm.errors import JudgementError
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.mining.phase_labels.types import Answers, PhaseAnswer, PhaseQuestion, Picture

# Part of every cached answer's key: another wording may be answered otherwise.
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

# What may be written next, given the pieces written so far; nothing: the end.
Grammar = Callable[[tuple[str, ...]], tuple[str, ...]]


@dataclass(frozen=True)
class Prompt:
    """A question to a multimodal model.

    Attributes:
        text: What is asked.
        pictures: What it is asked about, RGB, each after its caption.
        schema: JSON schema of the answer, for servers that hold their model to one.
    """

    text: str
    pictures: Sequence[tuple[str, Picture]] = ()
    schema: Mapping[str, Any] = field(default_factory=dict[str, Any])


def phase_prompt(question: PhaseQuestion, ending: str) -> Prompt:
    """The question as text and pictures; `ending` is :data:`AS_JSON` or :data:`AS_LINES`."""
    n = len(question.candidates)
    introduction = INTRODUCTION.format(
        # A quotation mark in the instruction ends nothing.
        instruction=question.instruction.replace('"', "'"),
        n=n,
        trajectory=question.trajectory_json(),
        phases="\n".join(f"- {phase}: {meaning}" for phase, meaning in MEANINGS.items()),
    )
    pictures = [
        (f"Camera {camera.rpartition('.')[2]}:", sheet)
        for camera, sheets in question.sheets.items()
        for sheet in sheets
    ]
    return Prompt(introduction + ending.format(n=n), pictures, phase_schema(n))


def phase_schema(n: int) -> dict[str, Any]:
    """JSON schema of an answer for `n` candidates."""
    item = {
        "type": "object",
        "properties": {
            "candidate": {"type": "integer"},
            "phase": {"type": "string", "enum": list(PHASES)},
            "confidence": {"type": "number", "minimum": 0, "maximum": 1},
        },
        "required": ["candidate", "phase", "confidence"],
        "additionalProperties": False,
    }
    phases = {"type": "array", "items": item, "minItems": n, "maxItems": n}
    return {
        "type": "object",
        "properties": {"phases": phases},
        "required": ["phases"],
        "additionalProperties": False,
    }


def phase_lines(n: int) -> Grammar:
    """One line for each of `n` candidates, with one of the phases and nothing else."""

    def grammar(written: tuple[str, ...]) -> tuple[str, ...]:
        number = len(written) + 1
        return () if number > n else tuple(f"{number}: {phase}\n" for phase in PHASES)

    return grammar


def phase_in(line: str) -> str:
    """The phase in a line that :func:`phase_lines` allows."""
    return line.strip().partition(": ")[2]


def read_phases(text: str, n: int) -> Answers:
    """The answers in a model's JSON. An item that makes no sense, or comes twice, is no answer.

    Raises:
        JudgementError: It is no such JSON, or none of its items makes sense.
    """
    items = read_object(text).get("phases")
    if not isinstance(items, list):
        raise JudgementError(f"the answer's 'phases' is {_short(items)}, expected a list")
    answers: dict[int, PhaseAnswer | None] = {}
    for item in items:
        number = cast(dict[str, Any], item).get("candidate") if isinstance(item, dict) else None
        if isinstance(number, int) and not isinstance(number, bool) and 1 <= number <= n:
            answers[number] = None if number in answers else _answer(item)
    read = tuple(answers.get(number) for number in range(1, n + 1))
    if not any(read):
        raise JudgementError(f"none of the {len(items)} items in the answer makes sense: {_short(items)}")
    return read


def _answer(item: Mapping[str, Any]) -> PhaseAnswer | None:
    phase, confidence = item.get("phase"), item.get("confidence")
    if not isinstance(phase, str) or not isinstance(confidence, int | float) or isinstance(confidence, bool):
        return None
    try:
        return PhaseAnswer(phase, float(confidence))
    except (JudgementError, OverflowError):  # a whole number of more digits than a float has
        return None


def read_object(text: str) -> dict[str, Any]:
    """The JSON object in what a model wrote, without its thoughts and the fences around it.

    Raises:
        JudgementError: There is none.
    """
    spoken = re.sub(r"<think>.*?</think>", "", text, flags=re.DOTALL)
    begin = spoken.find("{")
    try:
        if begin < 0:
            raise ValueError("there is no '{'")
        found, _ = json.JSONDecoder(parse_constant=_refuse).raw_decode(spoken, begin)
    except (ValueError, RecursionError) as error:
        raise JudgementError(f"the answer is no JSON ({error}): {_short(text)}") from error
    return found


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 120 else f"{text[:120]} ..."
