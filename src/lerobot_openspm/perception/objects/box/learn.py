"""Learning the boxes around objects from their masks in the demonstrations' first frames."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.box.box import Box, oriented_box
from lerobot_openspm.perception.objects.box.localise import place
from lerobot_openspm.perception.objects.box.outline import OutlineFit, fit_outlines, outline
from lerobot_openspm.perception.objects.lifting import Lifted, lift, support_height
from lerobot_openspm.perception.objects.mask_association import (
    Instances,
    Sighting,
    segmented,
    touched,
    whole_mask,
)
from lerobot_openspm.perception.objects.model import BoxModel, box_period
from lerobot_openspm.perception.objects.object_shape import ShapeBackend
from lerobot_openspm.perception.objects.yaw import yaw_range
from lerobot_openspm.types import Scene, Segmentation, Segmenter, View

log = logging.getLogger(__name__)

# Rays through the centres of one object's masks miss each other by less than this, metres.
MAX_RAY_GAP = 0.05
# Fingers close above the plane that objects stand on; where nothing else tells it, it is taken to lie this
# far below the lowest point that they ever went to, metres.
BELOW_HINTS_M = 0.02


@dataclass(frozen=True)
class Seen:
    """One demonstration's masks of an object, and what was lifted from them.

    Attributes:
        views: The first frame's views.
        sighting: The mask that the hand touched, by camera.
        lifted: Its points.
    """

    views: Mapping[str, View]
    sighting: Sighting
    lifted: Lifted

    @property
    def shows_plane(self) -> bool:
        """Whether the masks tell at which height the object stands: rays from several places do."""
        return len(self.sighting) >= 2

    def plane(self, floor: float) -> float:
        """World height to look for the object at, metres: as the depths around it show, else the floor."""
        found = [
            support_height(self.views[camera], one.mask)
            for camera, one in self.sighting.items()
            if self.views[camera].depth is not None
        ]
        heights = [height for height in found if height is not None]
        return float(np.median(heights)) if heights else floor


def learn_boxes(
    phrases: Sequence[str],
    scenes: Sequence[Scene],
    segmenter: Segmenter,
    shapes: ShapeBackend | None = None,
) -> dict[str, BoxModel]:
    """Learn the boxes of objects from where their demonstrations' first frames show them.

    Args:
        phrases: Names of the objects.
        scenes: First frames and hints of the demonstrations of all tasks.
        segmenter: Finds the instances of a phrase; of several, the one that the hand touched is meant.
        shapes: Tells the size of each object, once, from the view that shows it largest; by default the
            outlines of all its masks do.

    Returns:
        Models by phrase. One that is seen in no demonstration is left out, and the log says so.

    Raises:
        DatasetError: There are no phrases.
        PerceptionError: The segmenter cannot know a phrase, a view lacks what it needs, or the shape backend
            cannot be used.
    """
    if not phrases:
        raise DatasetError(
            "no object to learn the box of; give the phrases that the demonstrations' hints name"
        )
    floor = floor_of(scenes)
    models = {}
    for phrase, pairs in segmented(phrases, scenes, segmenter).items():
        seen = [_see(scene, phrase, found, floor) for scene, found in pairs]
        ones = [one for one in seen if one is not None]
        if ones:
            models[phrase] = _learn(phrase, ones, floor, shapes)
        else:
            log.warning("perception: no mask of %r near where the hand touched it", phrase)
    return models


def floor_of(scenes: Sequence[Scene]) -> float:
    """World height, metres, below which nothing that the hand touched can stand."""
    heights = [float(hint.point_world[2]) for scene in scenes for hint in scene.hints]
    return min(heights, default=0.0) - BELOW_HINTS_M


def _see(scene: Scene, name: str, instances: Instances, floor: float) -> Seen | None:
    hints = [hint for hint in scene.hints if hint.name == name]
    sighting = {
        camera: Segmentation(blob.mask, one.confidence)
        for camera, one in touched(scene.views, instances, hints, floor).items()
        if (blob := whole_mask(one.mask)) is not None
    }
    lifted = lift(scene.views, {camera: one.mask for camera, one in sighting.items()}, floor)
    if lifted is None or lifted.ray_gap_m > MAX_RAY_GAP:
        return None
    return Seen(scene.views, sighting, lifted)


def _learn(name: str, seen: Sequence[Seen], floor: float, shapes: ShapeBackend | None) -> BoxModel:
    trial = _from_outlines(name, seen, floor) if shapes is None else _described(name, seen, shapes)
    size, height, period = trial.size, trial.height, trial.yaw_period
    placed = [place(one.views, one.sighting, trial) for one in seen]
    yaws = np.array([float(se3.yaw_of(one.fit.body.T_world_obj)) for one in placed])
    centre, halfwidth = yaw_range(yaws, period)
    # Where the yaws keep to a part of the circle nothing shows a symmetry, and nothing needs it.
    shown = period if halfwidth >= period / 2 else 2 * np.pi
    overlap = float(np.median([one.score for one in placed]))
    return BoxModel(name, size, height, float(shown), centre, overlap)


def _from_outlines(name: str, seen: Sequence[Seen], floor: float) -> BoxModel:
    """A first model, of the size that fills the masks of all demonstrations."""
    # One view alone tells a small body nearby from a large one further off only by the plane below it.
    telling = [one for one in seen if one.shows_plane] or list(seen)
    boxes = [_free_fit(one, floor, is_round=False) for one in telling]
    rounds = [_free_fit(one, floor, is_round=True) for one in telling]
    is_round = bool(_residual(rounds) <= _residual(boxes))
    bodies = [fit.body for fit in (rounds if is_round else boxes)]
    size = np.median([_long_first(body).size for body in bodies], axis=0)
    height = float(np.median([body.T_world_obj[2, 3] for body in bodies]))
    return BoxModel(name, size, height, 0.0 if is_round else box_period(size), 0.0, 1.0)


def _described(name: str, seen: Sequence[Seen], shapes: ShapeBackend) -> BoxModel:
    """A first model, of the size that a shape backend tells from the view that shows the object largest."""
    one, camera = max(
        ((one, camera) for one in seen for camera in one.sighting),
        key=lambda pair: int(pair[0].sighting[pair[1]].mask.sum()),
    )
    shape = shapes.describe(one.views[camera], one.sighting[camera], one.lifted.points_world)
    log.info("perception: %r is %s m, quality %.2f", name, np.round(shape.extents, 3), shape.quality)
    height = float(shape.T_world_obj[2, 3])
    trials = [
        BoxModel(name, shape.extents, height, period, 0.0, 1.0) for period in (0.0, box_period(shape.extents))
    ]
    return min(trials, key=lambda trial: _residual([place(s.views, s.sighting, trial).fit for s in seen]))


def _free_fit(seen: Seen, floor: float, is_round: bool) -> OutlineFit:
    """The body of any size that fills one demonstration's masks."""
    height = seen.plane(floor)
    start = oriented_box(seen.lifted.points_world, height)
    size = np.maximum(start.size, 2 * seen.lifted.spacing)
    outlines = [
        outline(seen.views[camera], one.mask, one.confidence) for camera, one in seen.sighting.items()
    ]
    turns = [0.0] if is_round else [0.0, np.pi / 4]
    fits = [
        fit_outlines(
            outlines, Box(start.T_world_obj @ se3.from_yaw(np.zeros(3), np.asarray(turn)), size, is_round),
            free_height=seen.shows_plane, free_size=True,
        )
        for turn in turns
    ]  # fmt: skip
    return min(fits, key=lambda fit: fit.residual_px)


def _residual(fits: Sequence[OutlineFit]) -> float:
    return float(np.median([fit.residual_px for fit in fits]))


def _long_first(body: Box) -> Box:
    if body.size[0] >= body.size[1]:
        return body
    quarter = se3.from_yaw(np.zeros(3), np.asarray(np.pi / 2))
    return Box(body.T_world_obj @ quarter, body.size[[1, 0, 2]], body.is_round)
