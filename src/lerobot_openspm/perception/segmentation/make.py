"""Choosing a segmentation backend by its name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation import grounded_sam2, sam3
from lerobot_openspm.perception.segmentation.given import GivenSegmenter
from lerobot_openspm.types import Segmenter

# What each backend loads if nothing else is asked for: names on the Hugging Face Hub, or folders.
WEIGHTS: dict[str, tuple[str, ...]] = {
    "sam3": (sam3.WEIGHTS,),
    "grounded_sam2": (grounded_sam2.DETECTOR_WEIGHTS, grounded_sam2.MASK_WEIGHTS),
    "given": (),
}


def make_segmenter(
    name: str, labels: Mapping[str, int], weights: Sequence[str] = (), device: str = "cpu"
) -> Segmenter:
    """Make a segmentation backend.

    Args:
        name: One of :data:`WEIGHTS`.
        labels: Number of each phrase in the observation's masks; for ``"given"``.
        weights: Names on the Hugging Face Hub, or folders; none for the backend's own.
        device: As PyTorch names it, for the backends with weights.

    Raises:
        PerceptionError: There is no such backend, or it cannot be used: see their ``from_pretrained``.
    """
    if name not in WEIGHTS:
        raise PerceptionError(f"there is no segmenter {name!r}; choose one of {', '.join(WEIGHTS)}")
    usual = WEIGHTS[name]
    if weights and len(weights) != len(usual):
        raise PerceptionError(
            f"the segmenter {name!r} takes {len(usual)} names of weights, got {len(weights)}: "
            f"{', '.join(weights)}; give as many as by default: {', '.join(usual) or 'none'}"
        )
    names = tuple(weights) or usual
    if name == "sam3":
        return sam3.Sam3Segmenter.from_pretrained(*names, device=device)
    if name == "grounded_sam2":
        return grounded_sam2.GroundedSam2Segmenter.from_pretrained(*names, device=device)
    assert name == "given"
    return GivenSegmenter(labels)
