"""The two judges that ask a multimodal model."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_openspm.mining.phase_labels.endpoint import ChatEndpoint
from lerobot_openspm.mining.phase_labels.prompt import (
    AS_JSON,
    AS_LINES,
    WORDING,
    phase_in,
    phase_lines,
    phase_prompt,
    read_phases,
)
from lerobot_openspm.mining.phase_labels.qwen3vl import Qwen3VL
from lerobot_openspm.mining.phase_labels.types import Answers, PhaseAnswer, PhaseQuestion


@dataclass(frozen=True)
class EndpointJudge:
    """Asks an OpenAI-compatible endpoint; the confidences are those that the model writes down."""

    endpoint: ChatEndpoint
    looks: bool = True

    @property
    def name(self) -> str:
        """See :class:`lerobot_openspm.mining.phase_labels.types.PhaseJudge`."""
        return f"openai {self.endpoint.model_id} v{WORDING}"

    def judge(self, question: PhaseQuestion) -> Answers:
        """See :class:`lerobot_openspm.mining.phase_labels.types.PhaseJudge`."""
        text = self.endpoint.complete(phase_prompt(question, AS_JSON))
        return read_phases(text, len(question.candidates))


@dataclass(frozen=True)
class Qwen3VLJudge:
    """Asks Qwen3-VL in this process; the confidences are the probabilities it gives the phases it writes."""

    model: Qwen3VL
    looks: bool = True

    @property
    def name(self) -> str:
        """See :class:`lerobot_openspm.mining.phase_labels.types.PhaseJudge`."""
        return f"qwen3vl {self.model.model_id} v{WORDING}"

    def judge(self, question: PhaseQuestion) -> Answers:
        """See :class:`lerobot_openspm.mining.phase_labels.types.PhaseJudge`."""
        written = self.model.write(phase_prompt(question, AS_LINES), phase_lines(len(question.candidates)))
        return tuple(PhaseAnswer(phase_in(piece.text), piece.probability) for piece in written)
