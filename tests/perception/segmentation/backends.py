"""Every segmentation backend with a scene to look at, each made once a process."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from tests.perception.drawn_world import SHAPES, TABLE, draw_poses, render, views_of
from tests.perception.segmentation import tiny_models

from lerobot_openspm.perception.segmentation.given import GivenSegmenter
from lerobot_openspm.perception.segmentation.grounded_sam2 import GroundedSam2Segmenter
from lerobot_openspm.perception.segmentation.sam3 import Sam3Segmenter
from lerobot_openspm.types import Segmenter, View

Views = dict[str, View]
PHRASES = ("block", "cup")
LABELS = {"block": 3, "cup": 1}


@dataclass(frozen=True)
class Backend:
    """A segmenter, views that show a block and a cup, and the same segmenter or views with nothing to see."""

    segmenter: Segmenter
    views: Views
    blind: Segmenter
    empty: Views


def labelled(poses: dict[str, np.ndarray]) -> Views:
    """The drawn scene with the label of what each pixel shows; nothing hides anything there."""
    views = views_of(poses)
    for name, number in LABELS.items():
        alone = render([(SHAPES[name], poses[name])]) if name in poses else {}
        for camera, view in alone.items():
            before = views[camera].labels
            labels = np.zeros(view.image.shape[:2], np.int32) if before is None else before
            shown = (view.image != TABLE).any(axis=2)
            views[camera] = replace(views[camera], labels=np.where(shown, number, labels).astype(np.int32))
    return views


def without_objects() -> Views:
    """The bare table."""
    views = render([])
    size = next(iter(views.values())).image.shape[:2]
    return {camera: replace(view, labels=np.zeros(size, np.int32)) for camera, view in views.items()}


def scene() -> Views:
    """Block, cup and something else, each at a place of its own."""
    return labelled(draw_poses(np.random.default_rng(7)))


@cache
def sam3() -> Backend:
    """SAM 3 with random weights; it sees something everywhere, unless it asks for certainty."""
    tiny = tiny_models.sam3()
    seeing = Sam3Segmenter(tiny.model, tiny.processor, min_confidence=0.0)
    return Backend(seeing, scene(), Sam3Segmenter(tiny.model, tiny.processor, 1.0), without_objects())


@cache
def grounded_sam2() -> Backend:
    """Grounding DINO and SAM 2.1 with random weights, likewise."""
    detector, masks = tiny_models.grounding_dino(), tiny_models.sam2()
    parts = (detector.model, detector.processor, masks.model, masks.processor)
    seeing = GroundedSam2Segmenter(*parts, min_confidence=0.0)
    return Backend(seeing, scene(), GroundedSam2Segmenter(*parts, min_confidence=1.0), without_objects())


@cache
def given() -> Backend:
    """Masks in the views."""
    segmenter = GivenSegmenter(LABELS)
    return Backend(segmenter, scene(), segmenter, without_objects())


BACKENDS: dict[str, Callable[[], Backend]] = {
    "sam3": sam3,
    "grounded_sam2": grounded_sam2,
    "given": given,
}
