"""What other objects hide of a place, as far as it is known where they stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import Look
from lerobot_openspm.perception.objects.shape.silhouette import Float32
from lerobot_openspm.types import View

# Points of a surface are at most about this far from one another, metres.
GAP_M = 0.012
# What has its middle this near to that of another thing, metres, is that thing.
SAME_THING_M = 0.02


def behind(look: Look, name: str, point: Array) -> Look:
    """The look for something at a point ``(3,)``, world: what stands before it is hidden too.

    Args:
        look: The look. Something known whose middle is at the point is the same thing by another name.
        name: What is sought.
        point: The middle of what may be there.

    Returns:
        The look itself where nothing is before the point.
    """
    others = [
        own
        for other, own in look.standing.items()
        if other != name and np.linalg.norm(own.mean(0) - point) > SAME_THING_M
    ]
    hidden = dict(look.hidden)
    for camera, view in look.views.items():
        _, depth = project(view.camera, view.T_world_cam, point)
        covered = nearest_depth(others, view) < float(depth)
        if covered.any():
            hidden[camera] = covered | hidden[camera] if camera in hidden else covered
    is_same = all(hidden[camera] is look.hidden.get(camera) for camera in hidden)
    return look if is_same else replace(look, hidden=hidden)


def nearest_depth(surfaces: Sequence[Array], view: View) -> Float32:
    """Depth ``(H, W)`` of what stands nearest to a camera, metres; infinite where nothing known stands.

    Args:
        surfaces: Points ``(n, 3)`` of each thing's surface, world.
        view: The view.
    """
    camera = view.camera
    nearest = np.full((camera.height, camera.width), np.inf, np.float32)
    for points in surfaces:
        uv, depth = project(camera, view.T_world_cam, points)
        pixel = np.rint(np.nan_to_num(uv, nan=-1.0)).astype(int)
        inside = (depth > 0.01) & (pixel >= 0).all(1) & (pixel < [camera.width, camera.height]).all(1)
        if not inside.any():
            continue
        own = np.full_like(nearest, np.inf)
        np.minimum.at(own, (pixel[inside, 1], pixel[inside, 0]), depth[inside].astype(np.float32))
        size = 2 * int(np.ceil(GAP_M * camera.focal_px / float(np.median(depth[inside])) / 2)) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        covered = cv2.morphologyEx(np.isfinite(own).astype(np.uint8), cv2.MORPH_CLOSE, kernel)
        own = np.where(np.asarray(covered) > 0, cv2.erode(own, kernel), np.inf)
        nearest = np.minimum(nearest, own)
    return nearest
