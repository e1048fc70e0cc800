"""Connected patches of foreground: finding them, picking one, and placing their centres in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry.camera import ray_directions
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.shape.silhouette import Float32
from lerobot_openspm.types import Mask, View


@dataclass(frozen=True)
class Blob:
    """A connected patch of foreground.

    Attributes:
        mask: Its pixels ``(H, W)``.
        centre: Mean pixel coordinates ``(2,)``.
        area: Number of pixels.
        whole: Whether it ends before the image does; else its centre is not the object's.
    """

    mask: Mask
    centre: Array
    area: float
    whole: bool


def find_blobs(probability: Float32, min_area: float, limit: int) -> list[Blob]:
    """The largest patches of a soft mask ``(H, W)``, at most ``limit``; gaps of two pixels are bridged."""
    mask = (probability > 0.5).astype(np.uint8)
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    order = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")
    blobs = []
    for label in order[:limit]:
        x, y, width, height, area = (int(value) for value in stats[label])
        if area < min_area:
            break
        patch = labels[y : y + height, x : x + width] == label
        own = np.zeros(mask.shape, bool)
        own[y : y + height, x : x + width] = patch
        v, u = np.nonzero(patch)
        whole = x > 0 and y > 0 and x + width < mask.shape[1] and y + height < mask.shape[0]
        blobs.append(Blob(own, np.array([u.mean() + x, v.mean() + y]), float(area), whole))
    return blobs


def triangulate(views: Sequence[View], centres: Sequence[Array]) -> tuple[Array, float]:
    """Point ``(3,)`` nearest to the rays through a pixel ``(2,)`` per view; its largest distance to one."""
    origins = np.stack([view.T_world_cam[:3, 3] for view in views])
    rays = np.stack(
        [ray_directions(view.camera, view.T_world_cam, uv) for view, uv in zip(views, centres, strict=True)]
    )
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    point = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, origins), rcond=None)[0]
    return point, float(np.linalg.norm(np.einsum("nij,nj->ni", across, point - origins), axis=1).max())


def reach(view: View, blob: Blob, point_world: Array) -> float:
    """Distance in metres, at a point's depth, from a patch's centre to its furthest pixel."""
    v, u = np.nonzero(blob.mask)
    distance = float(np.linalg.norm(point_world - view.T_world_cam[:3, 3]))
    return float(np.hypot(u - blob.centre[0], v - blob.centre[1]).max()) * distance / view.camera.focal_px


def disc(view: View, point_world: Array, radius: float) -> Mask:
    """Pixels ``(H, W)`` within ``radius`` metres of a point, at the point's depth; empty if behind."""
    p_cam = view.T_world_cam[:3, :3].T @ (point_world - view.T_world_cam[:3, 3])
    mask = np.zeros(view.image.shape[:2], np.uint8)
    if p_cam[2] > 0.01:
        u = view.camera.fx * p_cam[0] / p_cam[2] + view.camera.cx
        v = view.camera.fy * p_cam[1] / p_cam[2] + view.camera.cy
        radius_px = view.camera.focal_px * radius / p_cam[2]
        if max(abs(u), abs(v)) < 1e4:
            cv2.circle(mask, (round(u), round(v)), max(1, round(radius_px)), 1, -1)
    return mask.astype(bool)


def grow(mask: NDArray[np.bool_], pixels: float) -> Mask:
    """A mask dilated by about so many pixels."""
    size = 2 * max(1, round(pixels)) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(mask.astype(np.uint8), kernel).astype(bool)
