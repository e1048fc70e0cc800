"""Segmentation by what the demonstrations taught of their objects: the default, without any download."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.perception import colour
from lerobot_openspm.perception.blobs import disc, find_blobs
from lerobot_openspm.perception.localise import Prepared
from lerobot_openspm.perception.model import KnownObject, ObjectModel, PatchModel, Probe
from lerobot_openspm.perception.patches import as_seen, localise_patches
from lerobot_openspm.perception.segmentation.instances import check_query, distinct_instances
from lerobot_openspm.perception.types import Segmentation, View

# Smaller patches of an object's colours are noise.
MIN_BLOB_PX = 12
MAX_BLOBS = 3


class LearnedSegmenter:
    """Finds the objects of the demonstrations by their learned colours, or by their learned patches.

    An object known by its shape: connected blobs of its colours. The confidence of a blob is the mean
    probability of its pixels, times its share of all the pixels that were found, so that a few pixels of just
    the right colour are not surer than the object.

    An object known by patches of the images: nothing is known of its outline, but where the patch is found is
    known to a millimetre or two. The mask is a disc of the patch's size there. Its centre is the point that
    the pose stands for, and the disc is what was recognised; its rim is not the object's. Refusing instead
    would leave those objects that hardly moved in the demonstrations without any mask. It is given in the
    cameras that the patches were looked for in.

    Args:
        objects: What was learned, by phrase.
    """

    def __init__(self, objects: Mapping[str, KnownObject]) -> None:
        self._objects = dict(objects)

    def segment(
        self, views: Mapping[str, View], phrases: Sequence[str]
    ) -> dict[str, dict[str, tuple[Segmentation, ...]]]:
        """See :class:`lerobot_openspm.perception.types.Segmenter`.

        Raises:
            PerceptionError: A phrase that no demonstration has taught.
            ObservationError: A view is malformed.
        """
        prepared, wanted = check_query(views, phrases)
        for phrase in wanted:
            if phrase not in self._objects:
                raise PerceptionError(
                    f"the demonstrations taught no {phrase!r}; they taught "
                    f"{', '.join(self._objects) or 'nothing'}. Add demonstrations that touch it and train "
                    "again (lerobot-train --policy.type=openspm), or choose the segmenter sam3 or "
                    "grounded_sam2, which take any phrase"
                )
        return {phrase: _find(prepared, self._objects[phrase]) for phrase in wanted}


def _find(views: Mapping[str, Prepared], model: KnownObject) -> dict[str, tuple[Segmentation, ...]]:
    if isinstance(model, PatchModel):
        return _discs({camera: one.view for camera, one in views.items()}, model)
    if not isinstance(model, ObjectModel) or model.log_odds is None:
        raise PerceptionError(
            f"{model.name!r} was learned from another segmenter's masks, and its colours are not known; use "
            "that segmenter, or train again with --policy.segmentation=demonstrations"
        )
    log_odds = model.log_odds
    return {camera: _blobs(one, log_odds) for camera, one in views.items()}


def _blobs(view: Prepared, log_odds: NDArray[np.float32]) -> tuple[Segmentation, ...]:
    probability = colour.foreground(view.bins, log_odds)
    blobs = find_blobs(probability, MIN_BLOB_PX, MAX_BLOBS)
    if not blobs:
        return ()
    total = sum(blob.area for blob in blobs)
    confidences = [float(probability[blob.mask].mean()) * blob.area / total for blob in blobs]
    return distinct_instances(np.stack([blob.mask for blob in blobs]), np.array(confidences))


def _discs(views: Mapping[str, View], model: PatchModel) -> dict[str, tuple[Segmentation, ...]]:
    estimate = localise_patches(views, model)
    found: dict[str, tuple[Segmentation, ...]] = dict.fromkeys(views, ())
    if estimate.status != "found":
        return found
    # The best probes come first, so a camera's first probe says how large the patch is.
    for probe in reversed(model.probes):
        if as_seen(views.get(probe.camera), probe) is not None:
            mask = disc(views[probe.camera], estimate.T_world_obj[:3, 3], _radius(probe))
            found[probe.camera] = (Segmentation(mask, estimate.confidence),) if mask.any() else ()
    return found


def _radius(probe: Probe) -> float:
    """Half the patch's size in metres at its point's depth; the largest, for the border cuts some of them."""
    radii = []
    for patch in probe.patches:
        _, depth = project(probe.calibration, probe.T_world_cam, patch.point_world)
        radii.append(max(patch.image.shape[:2]) / 2 * float(depth) / probe.calibration.focal_px)
    return max(radii)
