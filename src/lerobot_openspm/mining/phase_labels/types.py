"""What a judge of phases is asked, and what it answers."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import JudgementError
from lerobot_openspm.memory.entry import PHASES

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Moment:
    """What the hand did at one frame of a demonstration.

    Attributes:
        time_s: Seconds since the start of the episode.
        position: Of the hand in the world, metres.
        rotation: Of the hand in the world, rotation vector, radians.
        opening: Of the gripper, 0 for shut to 1 for as wide as it goes.
        closing: Whether the gripper is commanded to close.
    """

    time_s: float
    position: tuple[float, float, float]
    rotation: tuple[float, float, float]
    opening: float
    closing: bool


@dataclass(frozen=True)
class PhaseQuestion:
    """Which phase ends at each candidate key pose of an episode? All of an episode's are one question.

    A model tells a lift from an approach by what comes before and after, and an episode of three contact
    sheets costs it about as much as one high-resolution photograph: asking for each candidate alone would
    cost ten times as much and say less. It is not asked where the boundaries are: the gripper and the hand's
    path tell that to a frame or two, and pictures half a second apart do not.

    Attributes:
        dataset: Name of the dataset.
        episode: Index of the episode in it.
        instruction: What the demonstration was asked to do.
        candidates: The moments at which a phase may end, in order.
        trajectory: Moments in between, evenly spread over the episode.
        sheets: By camera, up to three: contact sheets ``(height, width, 3)`` RGB with one numbered tile per
            candidate. None for a judge that looks at no pictures.
        kinematic: The phase that motion and gripper say ends at each candidate. No model is told: its
            evidence would not be its own.
    """

    dataset: str
    episode: int
    instruction: str
    candidates: tuple[Moment, ...]
    trajectory: tuple[Moment, ...] = ()
    sheets: Mapping[str, tuple[Picture, ...]] = field(default_factory=dict[str, tuple[Picture, ...]])
    kinematic: tuple[str, ...] = ()

    def trajectory_json(self) -> str:
        """The paper's trajectory JSON: candidates, numbered from 1, and the moments between them."""
        candidates = [{"candidate": i, **_rounded(m)} for i, m in enumerate(self.candidates, start=1)]
        between = [_rounded(moment) for moment in self.trajectory]
        return json.dumps({"candidates": candidates, "trajectory": between}, allow_nan=False)

    def digest(self) -> str:
        """SHA-256 of everything that a judge is told."""
        told = hashlib.sha256(json.dumps([self.instruction, self.trajectory_json()]).encode())
        for camera, sheets in self.sheets.items():
            for sheet in sheets:
                told.update(f"{camera} {sheet.shape}".encode())
                told.update(np.ascontiguousarray(sheet).tobytes())
        return told.hexdigest()


def _rounded(moment: Moment) -> dict[str, object]:
    """A moment as a model is told it: a tenth of a millimetre and of a degree are more than it can use."""
    fields = asdict(moment)
    for name in ("position", "rotation"):
        fields[name] = [round(float(x), 4) for x in fields[name]]
    return {**fields, "time_s": round(moment.time_s, 3), "opening": round(moment.opening, 3)}


@dataclass(frozen=True)
class PhaseAnswer:
    """What a judge says of one candidate.

    Attributes:
        phase: The phase that ends there, one of :data:`lerobot_openspm.memory.entry.PHASES`.
        confidence: The paper's ``gamma``, 0 to 1.

    Raises:
        JudgementError: There is no such phase, or the confidence is none.
    """

    phase: str
    confidence: float

    def __post_init__(self) -> None:
        if self.phase not in PHASES:
            raise JudgementError(f"phase is {self.phase!r}, expected one of {', '.join(PHASES)}")
        if not (math.isfinite(self.confidence) and 0 <= self.confidence <= 1):
            raise JudgementError(f"confidence is {self.confidence}, expected 0 to 1")


# One for each candidate; None where the judge says nothing of it.
Answers = tuple[PhaseAnswer | None, ...]


class PhaseJudge(Protocol):
    """Something that tells phases."""

    @property
    def name(self) -> str:
        """What it is, with the model's name: answers of different names are never mixed."""
        ...

    @property
    def looks(self) -> bool:
        """Whether it looks at pictures."""
        ...

    def judge(self, question: PhaseQuestion) -> Answers:
        """Say which phase ends at each candidate.

        Raises:
            JudgementError: There is no answer, or none that makes sense.
        """
        ...
