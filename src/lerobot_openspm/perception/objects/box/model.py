"""An object known by the upright box around it, and how it is found in a segmenter's masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import intersect_plane
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects import records
from lerobot_openspm.perception.objects.base import Look, Record
from lerobot_openspm.perception.objects.box.box import CORNERS, GRID, Box
from lerobot_openspm.perception.objects.box.outline import SIZES_M, OutlineFit, fit_outlines, outline, overlap
from lerobot_openspm.perception.objects.mask_association import ObjectMasks, associate, whole_mask
from lerobot_openspm.perception.objects.shape import fitting
from lerobot_openspm.perception.objects.yaw import canonical
from lerobot_openspm.types import UNKNOWN_YAW_STD, PoseEstimate, Symmetry, View

# A box turned by more than this from where a fit begins may slip into a turn by a quarter.
START_YAWS = np.arange(4) * np.pi / 4
# A footprint whose sides differ by less than this share is a square: which is the longer cannot be seen.
SQUARE_SHARE = 0.06
# Records: the numbers of an object.
NUMBERS = ("height", "yaw_period", "yaw_centre", "typical_overlap")


@dataclass(frozen=True)
class Placed:
    """A body fitted to one object's masks, and how well it covers them in all views."""

    fit: OutlineFit
    score: float


@dataclass(frozen=True)
class BoxModel:
    """An object known by the upright box around it; a segmenter gives its masks.

    Attributes:
        name: The noun phrase.
        size: Long side, short side and height ``(3,)``, metres.
        height: World z of the support plane the object stood on, metres.
        yaw_period: Turning by this angle (radians) leaves the object unchanged, as far as one can know: 0 for
            round footprints, else that of the box where its demonstrations showed it at all yaws, and a full
            turn where they did not, because nothing showed that it looks alike from the other sides.
        yaw_centre: Middle of the yaws seen in the demonstrations, radians.
        typical_overlap: Intersection over union of box and masks, median over the demonstrations.
    """

    kind: ClassVar[str] = "box"
    sought_again: ClassVar[bool] = False

    name: str
    size: Array
    height: float
    yaw_period: float
    yaw_centre: float
    typical_overlap: float

    @property
    def is_round(self) -> bool:
        """Whether the body is the cylinder inscribed in the box."""
        return self.yaw_period == 0

    @property
    def box_period(self) -> float:
        """Angle in radians that turns the box, if not the object, into itself: all it shows of the yaw."""
        return 0.0 if self.is_round else box_period(self.size)

    @property
    def points(self) -> Array:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        return self.size * GRID

    @property
    def patches(self) -> None:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        return None

    @property
    def symmetry(self) -> Symmetry:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        return Symmetry(np.zeros(2), 0.0 if self.yaw_period == 0 else np.pi)

    def localise(self, look: Look) -> PoseEstimate:
        """Find the object in a segmenter's masks; an expected pose only tells its visibility.

        The covariance follows from how the pixels of the outlines bind the pose, in the views that show the
        object, from what remains of their residuals, and from the segmenter's confidence.
        """
        radius = float(np.hypot(self.size[0], self.size[1])) / 2
        middle = self.height + self.size[2] / 2
        found = associate(look.views, look.instances_of(self.name), middle, radius)
        placed = [place(look.views, masks, self) for masks in found]
        placed.sort(key=lambda one: -one.score)
        placed = [placed[i] for i in fitting.distinct([one.fit.body.T_world_obj for one in placed], radius)]
        T_expected, corners = look.expected.get(self.name), self.size * CORNERS
        if not placed:
            unknown = np.diag([1.0, 1.0, 1.0, UNKNOWN_YAW_STD**2])
            T = np.eye(4) if T_expected is None else T_expected
            return PoseEstimate("not_found", np.eye(4), unknown, 0.0, look.seen_share(se3.apply(T, corners)))
        scores = [one.score for one in placed]
        status, confidence = fitting.verdict(scores, self.typical_overlap)
        poses = [canonical(one.fit.body.T_world_obj, self.box_period, self.yaw_centre) for one in placed]
        T = poses[0] if status == "found" or T_expected is None else T_expected
        visible = look.seen_share(se3.apply(T, corners))
        alike = tuple(poses[1 : 1 + fitting.others(scores, self.typical_overlap)])
        return PoseEstimate(status, poses[0], placed[0].fit.covariance, confidence, visible, others=alike)

    def to_record(self) -> Record:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        numbers = {name: float(getattr(self, name)) for name in NUMBERS}
        return {
            "kind": self.kind,
            "name": self.name,
            "size": [float(side) for side in self.size],
            **numbers,
        }, {}


def from_record(fields: Mapping[str, Any], _: Mapping[str, NDArray[Any]], where: str) -> BoxModel:
    """Inverse of :meth:`BoxModel.to_record`. Raises MemoryFormatError, which names ``where``."""
    name, sides = fields["name"], fields.get("size")
    numbers = records.numbers(fields, NUMBERS, where)
    if not isinstance(sides, list) or len(sides) != 3:
        raise MemoryFormatError(f"{where}: 'size' of {name!r} is {sides!r}, expected a list of 3 lengths")
    size = [records.number({"size": side}, "size", *SIZES_M, where) for side in sides]
    if size[0] < size[1] or (numbers["yaw_period"] == 0 and size[0] != size[1]):
        raise MemoryFormatError(
            f"{where}: 'size' of {name!r} is {sides}, expected the long side first, and both alike for a yaw "
            "period of 0; learn it again"
        )
    return BoxModel(name=name, size=np.array(size), **numbers)


def box_period(size: Array) -> float:
    """Angle in radians that turns a box of ``size (3,)``, the long side first, into itself."""
    return float(np.pi / 2 if size[0] - size[1] < SQUARE_SHARE * size[0] else np.pi)


def place(views: Mapping[str, View], masks: ObjectMasks, model: BoxModel) -> Placed:
    """Fit the model's body, on its support plane, to one object's masks."""
    outlines = [outline(views[camera], one.mask, one.confidence) for camera, one in masks.items()]
    start = _start(views, masks, model)
    yaws = np.zeros(1) if model.is_round else START_YAWS
    fits = [fit_outlines(outlines, Box(se3.from_yaw(start, yaw), model.size, model.is_round)) for yaw in yaws]
    best = min(fits, key=lambda one: one.residual_px)
    return Placed(best, coverage(views, masks, best.body))


def coverage(views: Mapping[str, View], masks: ObjectMasks, body: Box) -> float:
    """How well a body covers the masks, from 0 to 1; a view that should show it but does not counts as 0."""
    overlaps = [
        overlap(view, masks[camera].mask if camera in masks else None, body) for camera, view in views.items()
    ]
    return fitting.score(np.array(overlaps))


def _start(views: Mapping[str, View], masks: ObjectMasks, model: BoxModel) -> Array:
    """Footprint's centre ``(3,)`` on the support plane to start from: where the masks' centres meet."""
    blobs = {camera: blob for camera, one in masks.items() if (blob := whole_mask(one.mask))}
    names = [camera for camera, blob in blobs.items() if blob.whole] or list(blobs)
    middle = model.height + model.size[2] / 2
    points = [intersect_plane(views[n].camera, views[n].T_world_cam, blobs[n].centre, middle) for n in names]
    return np.array([*np.mean(points, axis=0)[:2], model.height])
