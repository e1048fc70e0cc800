"""An object's relief: over each place of its footprint, the height at which pictures agree about its colour.

A surface point looks alike from everywhere, a point before or behind it does not. Where an object has one
colour all heights agree, and neighbours decide (semi-global matching, Hirschmueller 2008). What that leaves
too low, as a bottle's neck, is raised until the silhouettes are filled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, uniform_filter1d

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.backdrop import sample
from lerobot_openspm.perception.objects.surface.carving import Carved, Frame, Frames, silhouette
from lerobot_openspm.types import Mask

# Lightness varies with the direction of the light more than colour does.
WEIGHTS = np.array([0.6, 1.0, 1.0], np.float32)
# The best of the views count, since others are blocked by something.
TRUSTED_SHARE, MAX_DIFFERENCE, UNKNOWN = 0.6, 25.0, 20.0
MIN_VIEWS = 3
# What a step of one layer, and a larger one, between neighbouring columns costs.
STEP_COST, JUMP_COST = 0.8, 4.0
# A voxel is filled if this share of the views that see it have something there that nothing else explains.
FILLED_SHARE, MIN_FILLED = 0.5, 2


@dataclass(frozen=True)
class Relief:
    """Heights ``(n, n)`` over the columns at ``x``, in the object's frame; not a number where it is not."""

    x: Array
    height: Array
    table: float

    @property
    def cell(self) -> float:
        """Distance between columns, metres."""
        return float(self.x[1] - self.x[0])

    def points(self) -> tuple[Array, Array]:
        """Points ``(n, 3)`` of tops and walls, about a cell apart, and their outward normals ``(n, 3)``."""
        has, cell = np.isfinite(self.height), self.cell
        smooth = np.where(has, median_filter(np.where(has, self.height, self.table), 3), self.table)
        slope_x, slope_y = (np.clip(s, -1, 1) for s in np.gradient(smooth, cell))
        rows, columns = np.nonzero(has)
        tops = np.column_stack([self.x[rows], self.x[columns], self.height[has]])
        up = np.column_stack([-slope_x[has], -slope_y[has], np.ones(len(rows))])
        points, normals = [tops], [up / np.linalg.norm(up, axis=1, keepdims=True)]
        around = np.pad(np.where(has, self.height, self.table), 1, constant_values=self.table)
        for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            n = len(self.x)
            beside = around[1 + step[0] : 1 + step[0] + n, 1 + step[1] : 1 + step[1] + n][has]
            counts = np.maximum(np.floor((tops[:, 2] - beside) / cell), 0).astype(int)
            which = np.repeat(np.arange(len(tops)), counts)
            down = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
            walls = tops[which] + np.array([*step, 0]) * cell / 2
            walls[:, 2] -= cell * (down + 0.5)
            points.append(walls)
            normals.append(np.tile([*map(float, step), 0.0], (len(which), 1)))
        return np.concatenate(points), np.concatenate(normals)


def find_relief(frames: Frames, carved: Carved, table: float) -> Relief:
    """The relief of what is left of a carved space."""
    has: Mask = np.any(carved.solid, axis=-1)
    cost = np.where(carved.solid, _disagreement(frames, carved), 3 * UNKNOWN)
    layer = _semi_global(cost, has)
    return Relief(carved.x, np.where(has, carved.z[layer], np.nan), table)


def _disagreement(frames: Frames, carved: Carved) -> Array:
    """How much the pictures differ about each voxel ``(n, n, m)``, CIELAB; averaged over neighbours."""
    points = carved.points[carved.solid]
    views = []
    for frame in frames.distinct:
        world = se3.apply(frame.standing[frames.name], points)
        colours = sample(frame.colours, frame.view.camera, frame.view.T_world_cam, world, frame.hidden)
        rows, columns, _, _ = frame.look(world)
        colours[~frame.foreground[rows, columns]] = np.nan
        views.append(colours * WEIGHTS)
    seen = np.stack(views)
    is_seen = np.isfinite(seen[..., 0])
    middle = np.ma.median(np.ma.masked_invalid(seen), axis=0).filled(0.0)
    away = np.linalg.norm(seen - middle, axis=-1)
    away = np.sort(np.where(is_seen, np.minimum(away, MAX_DIFFERENCE), np.inf), axis=0)
    n_seen = is_seen.sum(0)
    trusted = np.maximum((n_seen * TRUSTED_SHARE).astype(int), 1)
    sums = np.cumsum(away, axis=0)[trusted - 1, np.arange(len(points))]
    cost = np.zeros(carved.solid.shape)
    cost[carved.solid] = np.where(n_seen >= MIN_VIEWS, sums / trusted, UNKNOWN)
    return _smoothed(cost) / np.maximum(_smoothed(carved.solid.astype(float)), 1e-3)


def _smoothed(values: Array) -> Array:
    """Values ``(n, n, m)`` averaged over neighbouring columns."""
    return np.asarray(uniform_filter1d(uniform_filter1d(values, 3, axis=0), 3, axis=1), float)


def _semi_global(cost: Array, has: Mask) -> NDArray[np.int64]:
    """The layer ``(n, n)`` of least cost ``(n, n, m)``, columns agreeing with their neighbours."""
    swapped, has_swapped = cost.transpose(1, 0, 2), has.T
    total = (
        _sweep(cost, has)
        + _sweep(cost[::-1], has[::-1])[::-1]
        + _sweep(swapped, has_swapped).transpose(1, 0, 2)
        + _sweep(swapped[::-1], has_swapped[::-1])[::-1].transpose(1, 0, 2)
    )
    return np.asarray(total.argmin(-1), np.int64)


def _sweep(cost: Array, has: Mask) -> Array:
    """Least cost of every layer along a path from the first row on."""
    out = np.empty_like(cost)
    out[0] = before = cost[0]
    for i in range(1, len(cost)):
        least = before.min(1, keepdims=True)
        padded = np.pad(before, ((0, 0), (1, 1)), constant_values=1e3)
        step = np.minimum(padded[:, :-2], padded[:, 2:]) + STEP_COST
        reached = np.minimum(np.minimum(before, least + JUMP_COST), step) - least
        before = cost[i] + np.where((has[i] & has[i - 1])[:, None], reached, 0.0)
        out[i] = before
    return out


def fill_silhouettes(
    frames: Frames, carved: Carved, relief: Relief, surfaces: Mapping[str, tuple[Array, float]]
) -> Relief:
    """Raise a relief to where pictures show something that no object's surface explains.

    Args:
        frames: The frames in which the object stands.
        carved: The space that it may take.
        relief: Its relief so far.
        surfaces: Points ``(n, 3)`` in their own frames of all objects, this one too, and their spacing.
    """
    height = np.where(np.isfinite(relief.height), relief.height, -np.inf)
    above = carved.solid & (carved.points[..., 2] > height[..., None])
    points = carved.points[above]
    seen, unexplained = np.zeros(len(points)), np.zeros(len(points))
    for frame in frames.distinct:
        explained = _covered(frame, surfaces)
        rows, columns, _, inside = frame.look(se3.apply(frame.standing[frames.name], points))
        seen += inside
        unexplained += inside & frame.foreground[rows, columns] & ~explained[rows, columns]
    filled = np.zeros(above.shape, bool)
    filled[above] = unexplained >= np.maximum(MIN_FILLED, FILLED_SHARE * seen)
    top = np.where(filled, carved.z, -np.inf).max(-1)
    return Relief(relief.x, np.where(np.isfinite(height), np.maximum(height, top), np.nan), relief.table)


def _covered(frame: Frame, surfaces: Mapping[str, tuple[Array, float]]) -> Mask:
    """Pixels ``(H, W)`` that the surfaces of standing objects explain."""
    covered = np.isfinite(depth_of_all(frame, surfaces)).astype(np.uint8)
    return cv2.dilate(covered, np.ones((3, 3), np.uint8)).astype(bool)


def depth_of_all(frame: Frame, surfaces: Mapping[str, tuple[Array, float]]) -> Array:
    """Depth ``(H, W)`` of the nearest surface of the standing objects; infinite where there is none."""
    depths = [
        silhouette(frame, se3.apply(T, surfaces[name][0]), surfaces[name][1])
        for name, T in frame.standing.items()
        if name in surfaces
    ]
    height, width = frame.view.image.shape[:2]
    return np.min(np.stack(depths), axis=0).astype(float) if depths else np.full((height, width), np.inf)
