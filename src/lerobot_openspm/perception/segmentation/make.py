"""Choosing a segmentation backend by its name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.objects.model import KnownObject
from lerobot_openspm.perception.segmentation.given import GivenSegmenter
from lerobot_openspm.perception.segmentation.grounded_sam2 import (
    DETECTOR_WEIGHTS,
    MASK_WEIGHTS,
    GroundedSam2Segmenter,
)
from lerobot_openspm.perception.segmentation.learned import LearnedSegmenter
from lerobot_openspm.perception.segmentation.sam3 import WEIGHTS, Sam3Segmenter
from lerobot_openspm.types import Segmenter

# What each backend loads if nothing else is asked for.
DEFAULT_WEIGHTS: dict[str, tuple[str, ...]] = {
    "demonstrations": (),
    "sam3": (WEIGHTS,),
    "grounded_sam2": (DETECTOR_WEIGHTS, MASK_WEIGHTS),
    "given": (),
}
SEGMENTERS = tuple(DEFAULT_WEIGHTS)


def make_segmenter(
    kind: str,
    objects: Mapping[str, KnownObject],
    labels: Mapping[str, int],
    weights: Sequence[str] = (),
    device: str = "cpu",
) -> Segmenter:
    """Make a segmentation backend.

    Args:
        kind: One of :data:`SEGMENTERS`.
        objects: What the demonstrations taught, by phrase; for ``"demonstrations"``.
        labels: Number of each phrase in the observation's masks; for ``"given"``.
        weights: Names on the Hugging Face Hub, or folders: one for ``"sam3"``; those of the detector and of
            the mask model for ``"grounded_sam2"``. None: :data:`DEFAULT_WEIGHTS`.
        device: As PyTorch names it, for the backends with weights.

    Raises:
        PerceptionError: There is no such backend, or it cannot be used: see their ``from_pretrained``.
    """
    if kind not in DEFAULT_WEIGHTS:
        raise PerceptionError(f"there is no segmenter {kind!r}; choose one of {', '.join(SEGMENTERS)}")
    names = tuple(weights) or DEFAULT_WEIGHTS[kind]
    if len(names) != len(DEFAULT_WEIGHTS[kind]):
        usual = ", ".join(DEFAULT_WEIGHTS[kind]) or "none"
        raise PerceptionError(
            f"the segmenter {kind!r} takes {len(DEFAULT_WEIGHTS[kind])} names of weights, got {len(names)}: "
            f"{', '.join(names)}; give as many as by default: {usual}"
        )
    if kind == "sam3":
        return Sam3Segmenter.from_pretrained(names[0], device)
    if kind == "grounded_sam2":
        return GroundedSam2Segmenter.from_pretrained(*names, device=device)
    return LearnedSegmenter(objects) if kind == "demonstrations" else GivenSegmenter(labels)
