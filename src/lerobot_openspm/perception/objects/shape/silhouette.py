"""Silhouettes of point models: drawing them, measuring how far they are from a mask, aligning the two.

A model is a cloud of surface points with a known spacing. Drawn in a view it gives a mask and, around it, a
signed distance (positive inside, in pixels). Alignment compares that distance with the observed mask's along
the model's rim and moves the model until both agree: Gauss-Newton over x, y, z, yaw, all views at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import View

Float32 = NDArray[np.float32]
PAD_PX = 6
# Points this near the edge make up the rim, where the half voxel that they lie inside of it is no more.
RIM_PX = 1.5


@dataclass(frozen=True)
class Drawing:
    """A model drawn in one view.

    Attributes:
        uv: Image coordinates ``(n, 2)`` of the model's points, pixels.
        distance: Signed distance to the silhouette's edge over the crop, pixels.
        corner: Image coordinates ``(2,)`` of the crop's first pixel.
        scale: Crop pixels per image pixel.
        rim: Signed distance, in pixels, within which a point belongs to the rim.
    """

    uv: Array
    distance: Float32
    corner: Array
    scale: float
    rim: float = RIM_PX

    def sample(self, field: Float32, uv: Array) -> Float32:
        """Bilinear values ``(n,)`` of a crop-shaped field at image coordinates ``(n, 2)``."""
        return bilinear(field, (uv - self.corner) * self.scale)


def bilinear(field: Float32, uv: Array) -> Float32:
    """Values ``(n,)`` of ``field (H, W)`` at pixel coordinates ``(n, 2)``, the edge repeated outside."""
    maps = uv.astype(np.float32)
    out = np.empty(len(maps), np.float32)
    # remap's tables are 16-bit: long lists are taken in pieces.
    for start in range(0, len(maps), 30000):
        part = maps[start : start + 30000]
        piece = cv2.remap(field, part[:, :1], part[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out[start : start + 30000] = piece[:, 0]
    return out


def signed_distance(mask: NDArray[np.uint8]) -> Float32:
    """Signed distance ``(H, W)`` in pixels to the edge of a 0/1 mask, positive inside."""
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_5)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.where(mask > 0, inside - 0.5, 0.5 - outside).astype(np.float32)


def observed_distance(probability: Float32, limit_px: float) -> Float32:
    """Signed distance ``(2H, 2W)``, in image pixels, of a soft mask ``(H, W)``, cut off at ``limit_px``.

    The soft mask is enlarged before its edge is found: antialiased pixels tell where within them it runs.
    """
    height, width = probability.shape
    distance = np.full((2 * height, 2 * width), -limit_px, np.float32)
    rows, columns = (np.flatnonzero((probability > 0.5).any(axis)) for axis in (1, 0))
    if len(rows) == 0:
        return distance
    # Further from the mask than the limit there is nothing to compute.
    margin = int(np.ceil(limit_px)) + 2
    top, left = max(rows[0] - margin, 0), max(columns[0] - margin, 0)
    bottom, right = min(rows[-1] + margin + 1, height), min(columns[-1] + margin + 1, width)
    size = (2 * (right - left), 2 * (bottom - top))
    large = cv2.resize(probability[top:bottom, left:right], size, interpolation=cv2.INTER_LINEAR)
    near = signed_distance((np.asarray(large) > 0.5).astype(np.uint8)) / 2
    distance[2 * top : 2 * bottom, 2 * left : 2 * right] = np.clip(near, -limit_px, limit_px)
    return distance


def draw(
    points_obj: Array, spacing: float, T_world_obj: Array, view: View, detail_px: float
) -> Drawing | None:
    """Draw surface points ``(n, 3)`` of a model, ``spacing`` metres apart; None where it is out of sight.

    The drawing's longer side takes at most ``detail_px`` crop pixels: fewer are faster, more are exacter.
    """
    uv, depth = project(view.camera, view.T_world_cam, se3.apply(T_world_obj, points_obj))
    if depth.min() <= 0.01:
        return None
    u, v = uv[:, 0], uv[:, 1]
    low, high = np.array([u.min(), v.min()]), np.array([u.max(), v.max()])
    size = np.array([view.camera.width, view.camera.height])
    if (high < 2).any() or (low > size - 3).any():
        return None
    # Small silhouettes are drawn larger than life, so that rounding to pixels does not move their edges.
    scale = float(np.clip(detail_px / (high - low).max(), 0.25, 3.0))
    corner = low - PAD_PX
    shape = np.ceil((high - low + 2 * PAD_PX) * scale).astype(int) + 1
    mask = np.zeros((shape[1], shape[0]), np.uint8)
    cells = np.rint((uv - corner) * scale).astype(int)
    mask[cells[:, 1], cells[:, 0]] = 1
    spacing_px = spacing * view.camera.focal_px / float(depth.mean())
    kernel = 2 * int(np.ceil(spacing_px * scale)) + 1
    mask = cv2.morphologyEx(
        mask, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (kernel, kernel))
    )
    # The points are centres of voxels: the surface is half a voxel further out.
    distance = signed_distance(np.asarray(mask, np.uint8)) / scale + spacing_px / 2
    return Drawing(uv, distance.astype(np.float32), corner, scale, max(RIM_PX, spacing_px / 2 + 1.0))


def overlap(drawing: Drawing, probability: Float32, visible: Float32 | None) -> tuple[float, float, float]:
    """Areas, in image pixels: drawing and mask in common, the drawing, the mask near the drawing.

    Only what lies in the image and is not known to be hidden counts.
    """
    height, width = drawing.distance.shape
    # Crop pixel c shows image pixel corner + c / scale.
    to_image = np.hstack([np.eye(2) / drawing.scale, drawing.corner[:, None]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpAffine(probability, to_image, (width, height), flags=flags, borderValue=-1.0)
    if visible is not None:
        seen[cv2.warpAffine(visible, to_image, (width, height), flags=flags, borderValue=1.0) < 0.9] = -1.0
    model, mask, known = drawing.distance > 0, seen > 0.5, seen >= 0
    area = 1 / drawing.scale**2
    common = np.count_nonzero(model & mask) * area
    return common, np.count_nonzero(model & known) * area, np.count_nonzero(mask) * area


def normal_equations(
    drawing: Drawing,
    observed: Float32,
    visible: Float32 | None,
    view: View,
    T_world_obj: Array,
    points_obj: Array,
    cut_px: float,
) -> tuple[Array, Array, float, float]:
    """One view's part of a Gauss-Newton step over (x, y, z, yaw).

    Args:
        drawing: The model at its present pose.
        observed: From :func:`observed_distance`.
        visible: 0 where the object is known to be hidden, else 1, ``(H, W)``; None for nothing known.
        view: The view.
        T_world_obj: Present pose ``(4, 4)``.
        points_obj: The model's points ``(n, 3)``.
        cut_px: Residuals beyond this many pixels are outliers (occlusion) and count nothing.

    Returns:
        Hessian ``(4, 4)``, gradient ``(4,)``, sum of weighted squared residuals, sum of weights; pixels.
    """
    size = np.array([view.camera.width, view.camera.height])
    u, v = drawing.uv[:, 0], drawing.uv[:, 1]
    inside = (u > 1) & (u < size[0] - 2) & (v > 1) & (v < size[1] - 2)
    own = drawing.sample(drawing.distance, drawing.uv)
    rim = np.flatnonzero(inside & (own < drawing.rim))
    if len(rim) < 8:
        return np.zeros((4, 4)), np.zeros(4), 0.0, 0.0
    uv = drawing.uv[rim]
    residual = bilinear(observed, 2 * uv + 0.5) - own[rim]
    blurred = cv2.GaussianBlur(drawing.distance, (5, 5), 0)
    gx, gy = (np.asarray(cv2.Sobel(blurred, cv2.CV_32F, i, 1 - i), np.float32) for i in (1, 0))
    normal = np.stack([drawing.sample(gx, uv), drawing.sample(gy, uv)], axis=1).astype(float)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    # Points that share a pixel share one vote: otherwise walls seen edge-on would outweigh everything.
    cells = np.rint(uv).astype(int)
    _, index, counts = np.unique(cells[:, 1] * 65536 + cells[:, 0], return_inverse=True, return_counts=True)
    tukey = np.clip(1 - (residual / cut_px) ** 2, 0, None) ** 2
    weight = tukey / counts[index]
    if visible is not None:
        weight = weight * (bilinear(visible, uv) > 0.9)
    jacobian = np.einsum("ni,nij->nj", normal, _pixel_jacobian(view, T_world_obj, points_obj[rim]))
    weighted = jacobian * weight[:, None]
    return weighted.T @ jacobian, weighted.T @ residual, float(weight @ residual**2), float(weight.sum())


def _pixel_jacobian(view: View, T_world_obj: Array, points_obj: Array) -> Array:
    """Derivatives ``(n, 2, 4)`` of image coordinates by the object's x, y, z (m) and yaw (rad)."""
    arm = points_obj @ T_world_obj[:3, :3].T
    R_cam_world = view.T_world_cam[:3, :3].T
    p = (arm + T_world_obj[:3, 3] - view.T_world_cam[:3, 3]) @ R_cam_world.T
    zero, z = np.zeros(len(p)), p[:, 2]
    fx, fy = view.camera.fx, view.camera.fy
    d_u = np.stack([fx / z, zero, -fx * p[:, 0] / z**2], axis=1)
    d_v = np.stack([zero, fy / z, -fy * p[:, 1] / z**2], axis=1)
    d_world = np.stack([d_u, d_v], axis=1) @ R_cam_world
    # A turn about the vertical moves a point at (a, b) by (-b, a).
    d_yaw = d_world[..., 0] * -arm[:, 1, None] + d_world[..., 1] * arm[:, 0, None]
    return np.concatenate([d_world, d_yaw[..., None]], axis=-1)
