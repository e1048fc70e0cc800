"""What a judge of phases is asked about an episode, and the phase labels that it answers with."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.memory.entry import PHASES

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Moment:
    """State of the hand at one frame of a demonstration.

    Attributes:
        time_s: Seconds since the start of the episode.
        position: Of the hand in the world, metres.
        rotation: Of the hand in the world, rotation vector, radians.
        opening: Of the gripper, 0 for closed to 1 for fully open.
        closing: Whether the gripper is commanded to close.
    """

    time_s: float
    position: tuple[float, ...]
    rotation: tuple[float, ...]
    opening: float
    closing: bool


@dataclass(frozen=True)
class PhaseQuestion:
    """Which phase ends at each candidate key pose of an episode?

    There is one question per episode: a model tells a lift from an approach by what comes before and after,
    and asking per candidate would cost ten times as much. The boundaries themselves are not in question,
    because gripper and path give them to a frame or two, and pictures half a second apart do not.

    Attributes:
        dataset: Name of the dataset.
        episode: Index of the episode in it.
        instruction: The task of the demonstration.
        candidates: The moments at which a phase may end, in order.
        trajectory: Moments spread evenly over the episode.
        sheets: By camera, up to three: contact sheets ``(height, width, 3)`` RGB with one numbered tile per
            candidate. Empty for a judge that looks at no pictures.
        kinematic: The phase that motion and gripper give each candidate. Models are not told, so that their
            evidence stays independent.
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
    """A moment as JSON, to a tenth of a millimetre and to a millisecond."""
    return {
        "time_s": round(moment.time_s, 3),
        "position": [round(x, 4) for x in moment.position],
        "rotation": [round(x, 4) for x in moment.rotation],
        "opening": round(moment.opening, 3),
        "closing": moment.closing,
    }


@dataclass(frozen=True)
class PhaseLabel:
    """The phase that ends at one candidate, and how sure that is.

    Attributes:
        phase: One of :data:`lerobot_openspm.memory.entry.PHASES`.
        confidence: The paper's ``gamma``, 0 to 1.

    Raises:
        PhaseLabelError: The phase is unknown, or the confidence is not from 0 to 1.
    """

    phase: str
    confidence: float

    def __post_init__(self) -> None:
        if self.phase not in PHASES:
            raise PhaseLabelError(f"phase is {self.phase!r}, expected one of {', '.join(PHASES)}")
        if not 0 <= self.confidence <= 1:
            raise PhaseLabelError(f"confidence is {self.confidence}, expected 0 to 1")

    @classmethod
    def from_json(cls, data: Any) -> PhaseLabel:
        """Read a label from JSON that may hold anything. Raises PhaseLabelError where it is no label."""
        fields: dict[str, Any] = data if isinstance(data, dict) else {}
        phase, confidence = fields.get("phase"), fields.get("confidence")
        if (
            not isinstance(phase, str)
            or not isinstance(confidence, int | float)
            or isinstance(confidence, bool)
        ):
            raise PhaseLabelError(f"got {str(data)[:80]}, expected an object with a phase and a confidence")
        return cls(phase, confidence)


# One per candidate; None where the judge says nothing about it.
PhaseLabels = tuple[PhaseLabel | None, ...]


@dataclass(frozen=True)
class PhaseJudge:
    """A source of phase labels.

    Attributes:
        name: Kind, model and prompt version. Cached labels of different names are never mixed.
        judge: Labels each candidate of an episode; raises PhaseLabelError where there is no usable answer.
        looks: Whether it needs pictures.
    """

    name: str
    judge: Callable[[PhaseQuestion], PhaseLabels]
    looks: bool = True
