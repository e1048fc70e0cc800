"""What is known of one object after learning: colours and a shape, patches of the images, or a box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class ObjectModel:
    """An object known by its shape, and by its colours where these tell its pixels.

    Attributes:
        name: The noun phrase.
        log_odds: Foreground log-odds ``(N_BINS,)`` per colour, float32; None where a segmenter finds it.
        points: Surface points ``(n, 3)`` in the object's frame, metres, float32. The frame is upright, its
            origin at the footprint's centre on the support plane.
        spacing: Distance between neighbouring points, metres.
        height: World z of the support plane the object stood on, metres.
        yaw_period: Turning by this angle (radians) leaves the object unchanged; 0 for a body of revolution.
        yaw_centre: Middle of the yaws seen in the demonstrations, radians.
        yaw_halfwidth: Half the width of the range of yaws to search, at most ``yaw_period / 2``, radians.
        typical_overlap: Intersection over union of drawing and mask, median over the demonstrations.
    """

    name: str
    log_odds: NDArray[np.float32] | None
    points: NDArray[np.float32]
    spacing: float
    height: float
    yaw_period: float
    yaw_centre: float
    yaw_halfwidth: float
    typical_overlap: float

    @property
    def radius(self) -> float:
        """Largest distance of a point from the vertical axis, metres."""
        return float(np.linalg.norm(self.points[:, :2], axis=1).max())

    @property
    def middle_height(self) -> float:
        """Height of the points' mean above the support plane, metres."""
        return float(self.points[:, 2].mean())

    def search_yaws(self) -> Array:
        """Yaws ``(k,)`` in radians to start a search from, at most about 45 degrees apart."""
        if self.yaw_period == 0:
            return np.zeros(1)
        count = max(1, int(np.ceil(2 * self.yaw_halfwidth / np.deg2rad(46))))
        steps = (np.arange(count) + 0.5) / count * 2 - 1
        return self.yaw_centre + steps * self.yaw_halfwidth


@dataclass(frozen=True)
class Patch:
    """A piece of a demonstration's first frame.

    Attributes:
        image: CIELAB pixels ``(h, w, 3)``, uint8.
        corner: Pixel ``(2,)`` of its upper left corner, horizontal first.
        point_world: The object's reference point ``(3,)`` in that frame.
    """

    image: Picture
    corner: Array
    point_world: Array


@dataclass(frozen=True)
class Probe:
    """Patches of one camera and size.

    Attributes:
        camera: Name of the camera.
        calibration: The camera as the patches were seen with it.
        T_world_cam: Its pose ``(4, 4)`` then.
        patches: One per reference demonstration.
        std_m: Spread of its estimates against the other probes', metres.
    """

    camera: str
    calibration: Camera
    T_world_cam: Array
    patches: tuple[Patch, ...]
    std_m: float


@dataclass(frozen=True)
class PatchModel:
    """An object known by patches. Its frame has the world's axes and stands where the hand touched it.

    Attributes:
        name: The noun phrase.
        probes: What to look for where, the best first.
        height: World z of the reference point, metres; it is not measured.
        typical_correlation: Of the patches in the demonstrations.
    """

    name: str
    probes: tuple[Probe, ...]
    height: float
    typical_correlation: float

    @property
    def yaw_period(self) -> float:
        """A full turn: the object is not known to look alike from any two sides."""
        return 2 * np.pi


# A footprint whose sides differ by less than this share is a square: which is the longer cannot be seen.
SQUARE_SHARE = 0.06


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


def box_period(size: Array) -> float:
    """Angle in radians that turns a box of ``size (3,)``, the long side first, into itself."""
    return float(np.pi / 2 if size[0] - size[1] < SQUARE_SHARE * size[0] else np.pi)


KnownObject = ObjectModel | PatchModel | BoxModel
