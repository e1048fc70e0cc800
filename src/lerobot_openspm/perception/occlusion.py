"""What of a view the robot's own hand may hide."""

from __future__ import annotations

import cv2
import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import Mask, View

# The hand and the arm behind it as balls along the hand's approach axis: from its fingertips this far back.
TIP_M, BACK_M, BALLS = 0.01, -0.30, 12
# The fingers are slimmer than what carries them; they end here.
FINGERS_M, FINGER_SHARE = -0.05, 0.6


def hand_mask(view: View, T_world_ee: Array, radius: float) -> Mask:
    """Pixels ``(H, W)`` that the hand may cover, drawn generously; none in a camera that the hand carries.

    Args:
        view: The view.
        T_world_ee: The hand's pose ``(4, 4)``; its z axis points out of it, away from the arm.
        radius: Of the hand, metres.
    """
    mask = np.zeros(view.image.shape[:2], np.uint8)
    if view.camera.mount == "ee":
        return mask.astype(bool)
    z = np.linspace(TIP_M, BACK_M, BALLS)
    centres = se3.apply(T_world_ee, np.stack([0 * z, 0 * z, z], axis=1))
    uv, depth = project(view.camera, view.T_world_cam, centres)
    for at, centre, distance in zip(z, uv, depth, strict=True):
        if distance > radius and np.abs(centre).max() < 1e4:
            own = radius * (FINGER_SHARE if at > FINGERS_M else 1.0)
            radius_px = max(1, round(view.camera.focal_px * own / float(distance)))
            cv2.circle(mask, (round(centre[0]), round(centre[1])), radius_px, 1, -1)
    return mask.astype(bool)
