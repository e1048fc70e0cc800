"""Learning the boxes around objects from their masks in the demonstrations' first frames."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.base import (
    Appearance,
    Examples,
    Instances,
    Kind,
    ObjectShape,
    ShapeBackend,
)
from lerobot_openspm.perception.objects.box.box import Box, oriented_box
from lerobot_openspm.perception.objects.box.lifting import Lifted, lift, support_height
from lerobot_openspm.perception.objects.box.model import BoxModel, box_period, from_record, place
from lerobot_openspm.perception.objects.box.outline import OutlineFit, fit_outlines, outline
from lerobot_openspm.perception.objects.mask_association import ObjectMasks, segmented, touched, whole_mask
from lerobot_openspm.perception.objects.yaw import yaw_range
from lerobot_openspm.types import DemonstrationScene, Segmentation, View

log = logging.getLogger(__name__)

# Rays through the centres of one object's masks miss each other by less than this, metres.
MAX_RAY_GAP = 0.05


@dataclass(frozen=True)
class Seen:
    """One demonstration's masks of an object, and what was lifted from them.

    Attributes:
        views: The first frame's views.
        masks: The mask that the hand touched, by camera.
        lifted: Its points.
    """

    views: Mapping[str, View]
    masks: ObjectMasks
    lifted: Lifted

    def appearances(self) -> list[Appearance]:
        """The object in every view that shows it."""
        points = self.lifted.points_world
        return [Appearance(self.views[camera], one, points) for camera, one in self.masks.items()]

    @property
    def shows_plane(self) -> bool:
        """Whether the masks tell at which height the object stands: rays from several places do."""
        return len(self.masks) >= 2

    def plane(self, floor: float) -> float:
        """World height to look for the object at, metres: as the depths around it show, else the floor."""
        found = [
            support_height(self.views[camera], one.mask)
            for camera, one in self.masks.items()
            if self.views[camera].depth is not None
        ]
        heights = [height for height in found if height is not None]
        return float(np.median(heights)) if heights else floor


def learn_boxes(examples: Examples) -> dict[str, BoxModel]:
    """Learn the boxes of objects from where their demonstrations' first frames show them.

    The outlines of all an object's masks tell its size; for source "sam3d" the shape backend does, from the
    view that shows the object largest. One that is seen in no demonstration is left out.
    """
    if examples.segmenter is None or examples.source == "demonstrations":
        return {}
    floor, seen = examples.floor, dict[str, list[Seen]]()
    for name, pairs in segmented(examples.names, examples.scenes, examples.segmenter).items():
        ones = [_see(scene, name, found, floor) for scene, found in pairs]
        if kept := [one for one in ones if one is not None]:
            seen[name] = kept
        else:
            examples.leave_out(name, "the segmenter shows it in no picture where the hand touched it")
    if examples.shapes is None:
        trials = {name: _from_outlines(name, ones, floor) for name, ones in seen.items()}
    else:
        trials = _described(seen, examples.shapes)
    return {name: _learn(trial, seen[name]) for name, trial in trials.items()}


BOX = Kind(BoxModel.kind, learn_boxes, from_record)


def _see(scene: DemonstrationScene, name: str, instances: Instances, floor: float) -> Seen | None:
    cues = [cue for cue in scene.cues if cue.name == name]
    masks = {
        camera: Segmentation(blob.mask, one.confidence)
        for camera, one in touched(scene.views, instances, cues, floor).items()
        if (blob := whole_mask(one.mask)) is not None
    }
    lifted = lift(scene.views, {camera: one.mask for camera, one in masks.items()}, floor)
    if lifted is None or lifted.ray_gap_m > MAX_RAY_GAP:
        return None
    return Seen(scene.views, masks, lifted)


def _learn(trial: BoxModel, seen: Sequence[Seen]) -> BoxModel:
    """A first model with the yaws and the overlap of its demonstrations."""
    period = trial.yaw_period
    placed = [place(one.views, one.masks, trial) for one in seen]
    yaws = np.array([float(se3.yaw_of(one.fit.body.T_world_obj)) for one in placed])
    centre, halfwidth = yaw_range(yaws, period)
    # Where the yaws keep to a part of the circle nothing shows a symmetry, and nothing needs it.
    shown = period if halfwidth >= period / 2 else 2 * np.pi
    overlap = float(np.median([one.score for one in placed]))
    return replace(trial, yaw_period=float(shown), yaw_centre=centre, typical_overlap=overlap)


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


def _described(seen: Mapping[str, Sequence[Seen]], shapes: ShapeBackend) -> dict[str, BoxModel]:
    """First models, of the sizes that a shape backend tells from the views that show the objects largest."""
    best = [max((view for one in ones for view in one.appearances()), key=_area) for ones in seen.values()]
    return {
        name: _sized(name, ones, shape)
        for (name, ones), shape in zip(seen.items(), shapes.describe(best), strict=True)
    }


def _area(appearance: Appearance) -> int:
    return int(appearance.segmentation.mask.sum())


def _sized(name: str, seen: Sequence[Seen], shape: ObjectShape) -> BoxModel:
    """A first model of a known size: round or not, whichever fits the masks better."""
    log.info("perception: %r is %s m, quality %.2f", name, np.round(shape.extents, 3), shape.quality)
    height = float(shape.T_world_obj[2, 3])
    trials = [
        BoxModel(name, shape.extents, height, period, 0.0, 1.0) for period in (0.0, box_period(shape.extents))
    ]
    return min(trials, key=lambda trial: _residual([place(s.views, s.masks, trial).fit for s in seen]))


def _free_fit(seen: Seen, floor: float, is_round: bool) -> OutlineFit:
    """The body of any size that fills one demonstration's masks."""
    height = seen.plane(floor)
    start = oriented_box(seen.lifted.points_world, height)
    size = np.maximum(start.size, 2 * seen.lifted.spacing)
    outlines = [outline(seen.views[camera], one.mask, one.confidence) for camera, one in seen.masks.items()]
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
