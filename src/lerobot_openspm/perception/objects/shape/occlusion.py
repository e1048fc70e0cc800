"""What other objects hide of a place, as far as it is known where they stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.shape.fitting import Evidence
from lerobot_openspm.perception.objects.shape.silhouette import Float32
from lerobot_openspm.types import View

# Points of a surface are at most about this far from one another, metres.
GAP_M = 0.012
# What has its middle this near to that of another thing, metres, is that thing.
SAME_THING_M = 0.02


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


def behind(evidence: Sequence[Evidence], standing: Sequence[Array], point: Array) -> list[Evidence]:
    """The views of something at a point ``(3,)``, world: pixels of what stands before it tell nothing.

    Args:
        evidence: The views.
        standing: Points ``(n, 3)`` of each thing's surface, world. One whose middle is there is the same
            thing by another name, and hides nothing.
        point: The middle of what may be there.
    """
    others = [own for own in standing if np.linalg.norm(own.mean(0) - point) > SAME_THING_M]
    if not others:
        return list(evidence)
    told = list[Evidence]()
    for one in evidence:
        nearest = nearest_depth(others, one.view)
        _, depth = project(one.view.camera, one.view.T_world_cam, point)
        is_free = (nearest >= float(depth)).astype(np.float32)
        if is_free.all():
            told.append(one)
            continue
        visible = is_free if one.visible is None else np.minimum(one.visible, is_free)
        told.append(replace(one, visible=visible))
    return told
