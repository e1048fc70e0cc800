"""The shape of an object from its masks: a voxel hull by vote over scenes and views, its symmetry, its frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.fitting import Cloud, Evidence
from lerobot_openspm.perception.silhouette import bilinear

VOXELS_PER_AXIS = 44


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

    def cloud(self, threshold: float) -> Cloud | None:
        """Surface voxels of the largest connected body with votes above the threshold; None if it is empty."""
        return surface(_largest_body(self.share >= threshold), self.spacing)


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


def vote(scenes: Sequence[Posed], half_size: float, turns: Array) -> Votes:
    """Let every picture vote on every voxel of a cube around the object.

    Args:
        scenes: Evidence and poses.
        half_size: Half the cube's edge, metres.
        turns: Yaws ``(k,)`` in radians; each scene votes once per entry, the object turned by it. One zero for no
            symmetry.
    """
    n = VOXELS_PER_AXIS
    spacing = 2 * half_size / n
    axis = (np.arange(n) - (n - 1) / 2) * spacing
    centres = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    votes, seen = np.zeros(n**3, np.float32), np.zeros(n**3, np.float32)
    for scene in scenes:
        for turn in turns:
            T = scene.T_world_obj @ se3.from_yaw(np.zeros(3), turn)
            points_world = se3.apply(T, centres)
            for one in scene.evidence:
                uv, depth = project(one.view.camera, one.view.T_world_cam, points_world)
                size = [one.view.camera.width - 1, one.view.camera.height - 1]
                inside = (depth > 0.01) & (np.nan_to_num(uv, nan=-1) >= 0).all(1) & (uv <= size).all(1)
                value = bilinear(one.probability, np.nan_to_num(uv))
                votes += np.where(inside, np.clip((value - 0.25) * 2, 0, 1), 0)
                seen += inside
    # A voxel that hardly any picture shows is no part of the object that pictures could confirm.
    share = np.where(seen >= 0.3 * seen.max(), votes / np.maximum(seen, 1), 0)
    return Votes(share.reshape(n, n, n), spacing)


def footprint(points: Array) -> tuple[Array, float]:
    """Centre ``(2,)`` and long axis (radians) of the smallest rectangle around points ``(n, 3)`` from above."""
    (x, y), (width, depth), angle = cv2.minAreaRect(points[:, :2].astype(np.float32) * 1000)
    long_axis = np.deg2rad(angle) + (0.0 if width >= depth else np.pi / 2)
    return np.array([x, y]) / 1000, float(se3.wrap_angle(long_axis, np.pi))


def _largest_body(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest 6-connected component of a solid."""
    from scipy.ndimage import label

    labels, count = label(solid)
    if count <= 1:
        return solid
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == sizes.argmax()
