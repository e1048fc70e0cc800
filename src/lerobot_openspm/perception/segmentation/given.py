"""Segmentation that the observation brings itself: a simulator's, or that of a camera with its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation.instances import check_query
from lerobot_openspm.types import Segmentation, View


class GivenSegmenter:
    """Reads masks off the views' label images; an object's confidence is 1 wherever it shows.

    Args:
        labels: Number of each phrase in the label images, from 1 on.
    """

    def __init__(self, labels: Mapping[str, int]) -> None:
        self._labels = dict(labels)

    def segment(
        self, views: Mapping[str, View], phrases: Sequence[str]
    ) -> dict[str, dict[str, tuple[Segmentation, ...]]]:
        """See :class:`lerobot_openspm.types.Segmenter`.

        Raises:
            PerceptionError: A phrase without a number, or a view without labels of the image's size.
            ObservationError: A view is malformed.
        """
        wanted = check_query(views, phrases)
        for phrase in wanted:
            if phrase not in self._labels:
                raise PerceptionError(
                    f"no label is given for {phrase!r}; there are labels for "
                    f"{', '.join(self._labels) or 'nothing'}. Add its number in the masks to the labels"
                )
        for camera, view in views.items():
            _check_labels(camera, view)
        return {
            phrase: {camera: self._read(view, phrase) for camera, view in views.items()} for phrase in wanted
        }

    def _read(self, view: View, phrase: str) -> tuple[Segmentation, ...]:
        mask = view.labels == self._labels[phrase]
        return (Segmentation(mask, 1.0),) if mask.any() else ()


def _check_labels(camera: str, view: View) -> None:
    field = "observation.masks." + camera.removeprefix("observation.images.")
    if view.labels is None:
        raise PerceptionError(
            f"the observation has no {field!r}, from which the segmenter 'given' takes its masks; pass "
            "--env.masks=true on the tabletop, or choose another segmenter"
        )
    if view.labels.shape != view.image.shape[:2]:
        raise PerceptionError(
            f"{field!r} has shape {view.labels.shape}, expected {view.image.shape[:2]} like the image of "
            f"{camera!r}; give the masks at the image's size"
        )
