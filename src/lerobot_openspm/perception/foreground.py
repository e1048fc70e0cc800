"""Foreground of one image: how likely each pixel is an object's, by its colour, and the connected patches.

Colours are counted in bins of CIELAB, fine in the two chromatic axes and coarse in lightness, which varies
with the shading of a face. An object's colour model is one table: the log-odds, per bin, that a pixel of that
colour is the object's rather than its surroundings'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from lerobot_openspm.geometry.camera import ray_directions
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import Mask, View

# Bins per axis of 8-bit CIELAB. The chromatic axes are clipped to [64, 192): beyond that nothing is confused.
LAB_BINS = (32, 32, 32)
N_BINS = 32 * 32 * 32
MAX_LOG_ODDS = 6.0
# A colour may occur this much (as a logarithm) more often elsewhere and still count as the object's.
PRIOR = 0.5

Bins = NDArray[np.int32]
Float32 = NDArray[np.float32]


def lab_bins(image: NDArray[np.uint8]) -> Bins:
    """Bin index ``(H, W)`` of every pixel of an RGB image ``(H, W, 3)``."""
    lab = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB).astype(np.int32)
    chroma = (np.clip(lab[..., 1:], 64, 191) - 64) >> 2
    return ((lab[..., 0] >> 3) * 1024 + chroma[..., 0] * 32 + chroma[..., 1]).astype(np.int32)


def histogram(bins: Bins) -> Array:
    """Counts ``(N_BINS,)`` of bin indices of any shape."""
    return np.bincount(bins.ravel(), minlength=N_BINS).astype(float)


def smooth(counts: Array) -> Array:
    """Spread counts ``(N_BINS,)`` over neighbouring colours, the total kept."""
    return gaussian_filter(counts.reshape(LAB_BINS), (0.7, 0.7, 0.7), mode="nearest", truncate=3.0).ravel()


def probability(bins: Bins, log_odds: NDArray[np.float32]) -> NDArray[np.float32]:
    """Soft foreground probability ``(H, W)``: the colour evidence, averaged lightly over neighbours."""
    table = 1.0 / (1.0 + np.exp(-log_odds))
    return np.asarray(cv2.GaussianBlur(table[bins].astype(np.float32), (3, 3), 0.6), np.float32)


def evidence(inside: list[Array], outside: Array, min_presence: float) -> NDArray[np.float32]:
    """Log-odds per colour from pixels near an object and pixels elsewhere.

    A colour belongs to the object when it is denser near it than elsewhere, and near it in most pictures:
    what merely stood next to it once is present in few.

    Args:
        inside: One histogram ``(N_BINS,)`` per picture, of the pixels near the object.
        outside: Histogram ``(N_BINS,)`` of the pixels elsewhere in the same pictures.
        min_presence: Fraction of the pictures in which the object's colours are expected.

    Returns:
        Log-odds ``(N_BINS,)``; very negative for colours never seen near the object.
    """
    # Counts, not shares: what matters is which part of all pixels of a colour lies near the object, so that a
    # large uniform background cannot creep in through the few of its pixels that surround the object.
    near, far = smooth(np.sum(inside, axis=0)), smooth(outside)
    # Present: about two pixels of that colour (or of its neighbours) near the object.
    neighbourhood = np.stack([_neighbourhood(counts) for counts in inside])
    presence = (neighbourhood >= 2.0).mean(axis=0)
    pictures = len(inside)
    # Less than a hundredth of a pixel per picture: an unseen colour is no evidence for the object.
    ratio = np.log((near + 0.01 * pictures) / (far + 0.04 * pictures)) + PRIOR
    consensus = 8.0 * (presence - min_presence)
    return np.clip(ratio + np.minimum(consensus, 0.0), -MAX_LOG_ODDS, MAX_LOG_ODDS).astype(np.float32)


def _neighbourhood(counts: Array) -> Array:
    """Sum of the counts ``(N_BINS,)`` over each bin's 3 x 3 x 3 neighbourhood."""
    cube = counts.reshape(LAB_BINS)
    for axis in range(3):
        padded = np.pad(cube, [(1, 1) if i == axis else (0, 0) for i in range(3)])
        n = cube.shape[axis]
        cube = np.sum([np.take(padded, range(k, k + n), axis=axis) for k in range(3)], axis=0)
    return cube.ravel()


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
