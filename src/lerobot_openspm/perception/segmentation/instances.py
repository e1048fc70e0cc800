"""What every backend does alike: check what it is asked, and order what it found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import check_view
from lerobot_openspm.types import Segmentation, View

# Intersection over union from which on two masks of one phrase are the same instance.
DUPLICATE_OVERLAP = 0.7


def check_query(views: Mapping[str, View], phrases: Sequence[str]) -> tuple[str, ...]:
    """The phrases without repetitions.

    Raises:
        PerceptionError: A phrase is empty, or all phrases came as one text.
        ObservationError: A view is malformed.
    """
    if isinstance(phrases, str):
        raise PerceptionError(f"phrases are {phrases!r}, expected a list; pass [{phrases!r}]")
    for phrase in phrases:
        if not phrase.strip():
            raise PerceptionError(
                f"a phrase to look for is {phrase!r}, expected a noun such as 'bowl'; name every object"
            )
    for view in views.values():
        check_view(view)
    return tuple(dict.fromkeys(phrases))


def distinct_instances(masks: NDArray[np.bool_], confidences: Array) -> tuple[Segmentation, ...]:
    """The instances of one phrase in one view, the most confident first; of duplicates that one alone.

    Args:
        masks: ``(n, H, W)``; empty ones are left out.
        confidences: ``(n,)``, brought to [0, 1].
    """
    kept: list[Segmentation] = []
    for i in np.argsort(-confidences, kind="stable"):
        if masks[i].any() and all(_overlap(masks[i], one.mask) < DUPLICATE_OVERLAP for one in kept):
            kept.append(Segmentation(masks[i], float(np.clip(confidences[i], 0.0, 1.0))))
    return tuple(kept)


def _overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float(np.count_nonzero(a & b)) / float(np.count_nonzero(a | b))
