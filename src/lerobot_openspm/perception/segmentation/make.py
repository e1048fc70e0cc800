"""Choosing a segmentation backend by its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation import grounded_sam2, sam3
from lerobot_openspm.perception.segmentation.given import GivenSegmenter
from lerobot_openspm.types import Segmenter


@dataclass(frozen=True)
class Backend:
    """One way to find the masks of phrases.

    Attributes:
        make: Makes it from names of weights, the numbers of phrases in given masks, and a device.
        weights: What it loads if nothing else is asked for: names on the Hugging Face Hub, or folders.
    """

    make: Callable[[Sequence[str], Mapping[str, int], str], Segmenter]
    weights: tuple[str, ...] = ()


BACKENDS = {
    "sam3": Backend(
        lambda names, _, device: sam3.Sam3Segmenter.from_pretrained(*names, device=device), (sam3.WEIGHTS,)
    ),
    "grounded_sam2": Backend(
        lambda names, _, device: grounded_sam2.GroundedSam2Segmenter.from_pretrained(*names, device=device),
        (grounded_sam2.DETECTOR_WEIGHTS, grounded_sam2.MASK_WEIGHTS),
    ),
    "given": Backend(lambda _, labels, __: GivenSegmenter(labels)),
}


def make_segmenter(
    name: str, labels: Mapping[str, int], weights: Sequence[str] = (), device: str = "cpu"
) -> Segmenter:
    """Make a segmentation backend.

    Args:
        name: One of :data:`BACKENDS`.
        labels: Number of each phrase in the observation's masks; for ``"given"``.
        weights: Names on the Hugging Face Hub, or folders; none for the backend's own.
        device: As PyTorch names it, for the backends with weights.

    Raises:
        PerceptionError: There is no such backend, or it cannot be used: see their ``from_pretrained``.
    """
    if name not in BACKENDS:
        raise PerceptionError(f"there is no segmenter {name!r}; choose one of {', '.join(BACKENDS)}")
    backend = BACKENDS[name]
    if weights and len(weights) != len(backend.weights):
        usual = ", ".join(backend.weights) or "none"
        raise PerceptionError(
            f"the segmenter {name!r} takes {len(backend.weights)} names of weights, got {len(weights)}: "
            f"{', '.join(weights)}; give as many as by default: {usual}"
        )
    return backend.make(tuple(weights) or backend.weights, labels, device)
