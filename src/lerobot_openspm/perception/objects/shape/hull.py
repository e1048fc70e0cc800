"""The shape of an object from its masks: a voxel hull by vote over scenes and views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.shape.fitting import Cloud, Evidence
from lerobot_openspm.perception.objects.shape.silhouette import bilinear

VOXELS_PER_AXIS = 44


class NoShapeError(Exception):
    """A shape that no picture of any demonstration shows."""


@dataclass(frozen=True)
class Posed:
    """One scene's evidence with the object's pose ``(4, 4)`` in it."""

    evidence: tuple[Evidence, ...]
    T_world_obj: Array


@dataclass(frozen=True)
class Votes:
    """Share of the pictures in which each voxel of a cube looks like the object.

    Attributes:
        share: Values ``(n, n, n)`` from 0 to 1, axes x, y, z.
        spacing: Voxel size in metres; the cube is centred on the frame's origin.
    """

    share: NDArray[np.float32]
    spacing: float

    def cloud(self, threshold: float, limits: tuple[float, float] = (-np.inf, np.inf)) -> Cloud | None:
        """Surface of the largest body with votes above a threshold and z within limits; None if empty."""
        z = self.axis
        allowed = (z >= limits[0]) & (z <= limits[1])
        return surface(_largest_body((self.share >= threshold) & allowed), self.spacing)

    @property
    def axis(self) -> Array:
        """Coordinates ``(n,)`` of the voxels' centres along each axis, metres."""
        n = self.share.shape[0]
        return np.asarray((np.arange(n) - (n - 1) / 2) * self.spacing, float)

    def turned(self, order: int) -> Votes:
        """Votes averaged over ``order`` equal turns about the z axis."""
        n = self.share.shape[0]
        total = np.zeros_like(self.share)
        # Slices along z are the channels of one image; OpenCV takes them by fours.
        for k in range(order):
            turn = cv2.getRotationMatrix2D(((n - 1) / 2, (n - 1) / 2), 360.0 * k / order, 1.0)
            for start in range(0, n, 4):
                part = np.ascontiguousarray(self.share[:, :, start : start + 4])
                total[:, :, start : start + 4] += cv2.warpAffine(part, turn, (n, n)).reshape(part.shape)
        return Votes((total / order).astype(np.float32), self.spacing)


def surface(solid: NDArray[np.bool_], spacing: float) -> Cloud | None:
    """Centres of the voxels of a solid ``(n, n, n)`` that have an empty neighbour; None if there are none."""
    padded = np.pad(solid, 1)
    inner = padded.copy()
    for axis in range(3):
        inner &= np.roll(padded, 1, axis) & np.roll(padded, -1, axis)
    index = np.argwhere((padded & ~inner)[1:-1, 1:-1, 1:-1])
    if len(index) < 8:
        return None
    return Cloud((index - (np.array(solid.shape) - 1) / 2) * spacing, spacing)


def vote(scenes: Sequence[Posed], half_size: float, worth: NDArray[np.bool_] | None = None) -> Votes:
    """Let every picture vote on every voxel of a cube around the object.

    A voxel's share is half the mean over the cameras and half that of the camera least convinced of it: the
    object lies within the silhouettes of every camera, however few scenes that camera sees it in; but what
    often stands in front of it must not carve it away.

    Args:
        scenes: Evidence and poses.
        half_size: Half the cube's edge, metres.
        worth: Voxels ``(n, n, n)`` to ask about; the others get no votes. All by default.
    """
    n = VOXELS_PER_AXIS
    spacing = 2 * half_size / n
    axis = (np.arange(n) - (n - 1) / 2) * spacing
    asked = np.argwhere(np.ones((n, n, n), bool) if worth is None else worth)
    centres = axis[asked]
    cameras = sorted({one.camera for scene in scenes for one in scene.evidence})
    votes, seen = np.zeros((2, len(cameras), len(asked)), np.float32)
    for scene in scenes:
        points_world = se3.apply(scene.T_world_obj, centres)
        for one in scene.evidence:
            uv, depth = project(one.view.camera, one.view.T_world_cam, points_world)
            uv = np.nan_to_num(uv, nan=-1.0)
            u, v = uv[:, 0], uv[:, 1]
            height, width = one.probability.shape
            inside = (depth > 0.01) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
            if one.visible is not None:
                inside &= bilinear(one.visible, uv) > 0.9
            value = bilinear(one.probability, uv)
            camera = cameras.index(one.camera)
            votes[camera] += np.where(inside, np.clip((value - 0.25) * 2, 0, 1), 0)
            seen[camera] += inside
    share = np.zeros((n, n, n), np.float32)
    # A camera that saw a voxel once or twice may have seen something in front of it.
    per_camera = np.where(seen >= min(4, len(scenes)), votes / np.maximum(seen, 1), 1)
    # A voxel that hardly any picture shows is no part of the object that pictures could confirm.
    known = seen.sum(0) >= 0.3 * seen.sum(0).max(initial=1)
    share[tuple(asked.T)] = np.where(known, (per_camera.min(0) + per_camera.mean(0)) / 2, 0)
    return Votes(share, spacing)


def footprint(points: Array) -> tuple[Array, float, Array]:
    """The smallest upright rectangle around points ``(n, 3)``, whatever their heights.

    Returns:
        Its centre ``(2,)``, the direction of its long side (radians), its sides ``(2,)``, the longer first.
    """
    (x, y), (width, depth), angle = cv2.minAreaRect(points[:, :2].astype(np.float32) * 1000)
    long_axis = np.deg2rad(angle) + (0.0 if width >= depth else np.pi / 2)
    sides = np.array([max(width, depth), min(width, depth)]) / 1000
    return np.array([x, y]) / 1000, float(se3.wrap_angle(long_axis, np.pi)), sides


def around(cloud: Cloud, half_size: float) -> NDArray[np.bool_]:
    """Voxels ``(n, n, n)`` of a cube that lie in the box around a cloud or up to three voxels beyond."""
    n = VOXELS_PER_AXIS
    spacing = 2 * half_size / n
    axis = (np.arange(n) - (n - 1) / 2) * spacing
    low, high = cloud.points.min(0) - 3 * spacing, cloud.points.max(0) + 3 * spacing
    x, y, z = ((axis >= a) & (axis <= b) for a, b in zip(low, high, strict=True))
    return x[:, None, None] & y[:, None] & z


def _largest_body(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest 6-connected component of a solid."""
    labels, count = label(solid)  # pyright: ignore[reportGeneralTypeIssues]  (typed as a scalar)
    if count <= 1:
        return solid
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == sizes.argmax()
