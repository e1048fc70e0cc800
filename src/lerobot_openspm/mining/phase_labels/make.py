"""Choosing a judge of phases by its name."""

from __future__ import annotations

from lerobot_openspm.errors import JudgementError
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.phase_labels.annotations import AnnotationJudge
from lerobot_openspm.mining.phase_labels.endpoint import API_BASE, ChatEndpoint, Patience
from lerobot_openspm.mining.phase_labels.judges import EndpointJudge, Qwen3VLJudge
from lerobot_openspm.mining.phase_labels.qwen3vl import WEIGHTS, Qwen3VL
from lerobot_openspm.mining.phase_labels.types import PhaseJudge

JUDGES = ("openai", "qwen3vl", "annotations")


def make_judge(
    kind: str,
    demonstrations: Demonstrations,
    model_id: str | None = None,
    api_base: str | None = None,
    timeout_s: float = Patience.timeout_s,
    device: str = "cpu",
) -> PhaseJudge:
    """Make a judge of phases.

    Args:
        kind: One of :data:`JUDGES`.
        demonstrations: The dataset, for ``"annotations"``.
        model_id: Of the server's models for ``"openai"``; a name on the Hub or a folder for ``"qwen3vl"``.
        api_base: Where the server is, for ``"openai"``.
        timeout_s: How long to wait for one answer of the server.
        device: Where ``"qwen3vl"`` runs, as PyTorch names it.

    Raises:
        JudgementError: There is no such judge, or the server's model has no name.
        DatasetError: The dataset was never annotated.
        PerceptionError: Qwen3-VL cannot be loaded.
    """
    if kind == "openai":
        if not model_id:
            raise JudgementError(
                f"no model to ask at {api_base or API_BASE}; pass --policy.judge.model_id=NAME, one of those "
                "that its /models lists"
            )
        return EndpointJudge(ChatEndpoint(api_base or API_BASE, model_id, Patience(timeout_s)))
    if kind == "qwen3vl":
        return Qwen3VLJudge(Qwen3VL.from_pretrained(model_id or WEIGHTS, device))
    if kind == "annotations":
        return AnnotationJudge(demonstrations.subtask_rows)
    raise JudgementError(f"there is no judge {kind!r}, expected one of {', '.join(JUDGES)}")
