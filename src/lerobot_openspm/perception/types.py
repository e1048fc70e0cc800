"""What perception takes and gives: views, hints from mining, scenes to learn from, pose estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array

Mask = NDArray[np.bool_]

# Standard deviation of a uniform angle: what is known of a yaw that cannot be seen.
UNKNOWN_YAW_STD = float(np.pi / np.sqrt(3))


@dataclass(frozen=True)
class View:
    """One camera's picture of one moment.

    Attributes:
        image: RGB image ``(H, W, 3)``, uint8.
        camera: Intrinsics, already scaled to ``H x W``.
        T_world_cam: Camera pose ``(4, 4)`` at that moment.
    """

    image: NDArray[np.uint8]
    camera: Camera
    T_world_cam: Array


@dataclass(frozen=True)
class Hint:
    """Where the hand touched something, as mining saw it.

    Attributes:
        name: The noun phrase of the instruction, such as ``"bowl"``.
        point_world: Point ``(3,)`` between the fingertips, in metres.
        kind: ``"grasp"`` or ``"contact"``: part of the object was at this point in the first frame;
            ``"release"``: the object lies below or around this point.
        place: Hints of one place touched the same spot of the object, as far as one can know.
    """

    name: str
    point_world: Array
    kind: Literal["grasp", "release", "contact"]
    place: str = ""


@dataclass(frozen=True)
class Scene:
    """What learning sees of one demonstration.

    Attributes:
        views: First frame by camera name, the hand away from the objects.
        hints: Places that were touched, for any number of objects.
        later_views: A frame after the grasped object was carried off, by camera name; None if there is none.
    """

    views: dict[str, View]
    hints: tuple[Hint, ...]
    later_views: dict[str, View] | None = None


@dataclass(frozen=True)
class PoseEstimate:
    """Where an object is.

    Attributes:
        status: ``"ambiguous"`` when two places explain the images equally well; the pose is the better one.
        T_world_obj: Upright pose ``(4, 4)``: origin at the footprint's centre on the support plane.
        covariance: ``(4, 4)`` over x, y, z in metres and yaw in radians.
        confidence: From 0 to 1; 1 is how well the object is typically found in its demonstrations.
        masks: Foreground mask ``(H, W)`` by camera name.
    """

    status: Literal["found", "not_found", "ambiguous"]
    T_world_obj: Array
    covariance: Array
    confidence: float
    masks: dict[str, Mask]
