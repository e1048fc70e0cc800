"""Segmentation by what the demonstrations taught of their objects: the default, without any download."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception import colour
from lerobot_openspm.perception.blobs import find_blobs
from lerobot_openspm.perception.objects.localise import Prepared
from lerobot_openspm.perception.objects.model import KnownObject, ObjectModel, PatchModel
from lerobot_openspm.perception.segmentation.instances import check_query, distinct_instances
from lerobot_openspm.types import Segmentation, View

# Smaller blobs of an object's colours are noise.
MIN_BLOB_PX = 12
MAX_BLOBS = 3


class LearnedSegmenter:
    """Finds the objects of the demonstrations: connected blobs of their learned colours.

    The confidence of a blob is the mean probability of its pixels, times its share of all the pixels that
    were found, so that a few pixels of just the right colour are not surer than the object.

    An object known by patches of the images has a pose but no mask, and is refused: a patch lies around the
    point that the hand touched or let go over, takes in whatever was seen there in all demonstrations, and is
    found by that. Lifted as if it were the object's mask it would be somewhere else.

    Args:
        objects: What was learned, by phrase.
    """

    def __init__(self, objects: Mapping[str, KnownObject]) -> None:
        self._objects = dict(objects)

    def segment(
        self, views: Mapping[str, View], phrases: Sequence[str]
    ) -> dict[str, dict[str, tuple[Segmentation, ...]]]:
        """See :class:`lerobot_openspm.types.Segmenter`.

        Raises:
            PerceptionError: A phrase that no demonstration has taught, or of an object without a mask.
            ObservationError: A view is malformed.
        """
        prepared, wanted = check_query(views, phrases)
        colours = {phrase: self._colours(phrase) for phrase in wanted}
        return {
            phrase: {camera: _find(view, log_odds) for camera, view in prepared.items()}
            for phrase, log_odds in colours.items()
        }

    def _colours(self, phrase: str) -> NDArray[np.float32]:
        model = self._objects.get(phrase)
        if isinstance(model, ObjectModel) and model.log_odds is not None:
            return model.log_odds
        masked = [
            name
            for name, one in self._objects.items()
            if isinstance(one, ObjectModel) and one.log_odds is not None
        ]
        if model is None:
            what, how = f"the demonstrations taught no {phrase!r}", "that touch it"
        elif not isinstance(model, PatchModel):
            what, how = f"{phrase!r} was learned from another segmenter's masks, not by its colours", "of it"
        else:
            what = f"{phrase!r} is known by patches of the images, which have a pose but are no mask of it"
            how = "in which it stands in places more than 3 cm apart"
        raise PerceptionError(
            f"{what}; there are masks of {', '.join(masked) or 'nothing'}. Record demonstrations {how} "
            "and train again (lerobot-train --policy.type=openspm), or choose the segmenter sam3 or "
            "grounded_sam2, which take any phrase"
        )


def _find(view: Prepared, log_odds: NDArray[np.float32]) -> tuple[Segmentation, ...]:
    probability = colour.foreground(view.bins, log_odds)
    blobs = find_blobs(probability, MIN_BLOB_PX, MAX_BLOBS)
    if not blobs:
        return ()
    total = sum(blob.area for blob in blobs)
    confidences = [float(probability[blob.mask].mean()) * blob.area / total for blob in blobs]
    return distinct_instances(np.stack([blob.mask for blob in blobs]), np.array(confidences))
