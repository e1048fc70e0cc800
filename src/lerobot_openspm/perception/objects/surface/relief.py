"""An object's relief: over each place of its footprint, the height at which pictures agree about its colour.

A surface point looks alike from everywhere, a point before or behind it does not. Where an object has one
colour all heights agree, and neighbours decide (semi-global matching, Hirschmueller 2008).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.backdrop import Float32, sample
from lerobot_openspm.perception.objects.surface.carving import Carved, Frames
from lerobot_openspm.types import Mask

# Lightness varies with the direction of the light more than colour does.
WEIGHTS = np.array([0.6, 1.0, 1.0], np.float32)
# The best of the views count, since others are blocked by something.
TRUSTED_SHARE, MAX_DIFFERENCE, UNKNOWN = 0.6, 25.0, 20.0
MIN_VIEWS = 3
# What a step of one layer, and a larger one, between neighbouring columns costs.
STEP_COST, JUMP_COST = 0.8, 4.0
# Of heights that agree as well the lowest is taken: what is far behind an object agrees too. CIELAB a metre.
RISE_COST = 2.0


def find_relief(frames: Frames, carved: Carved) -> NDArray[np.int64]:
    """The topmost layer ``(n, n)`` of each column of a carved space."""
    rise = RISE_COST * (carved.z - carved.z[0])
    cost = np.where(carved.solid, _disagreement(frames, carved) + rise, 3 * UNKNOWN)
    return _semi_global(cost, np.any(carved.solid, axis=-1))


def _disagreement(frames: Frames, carved: Carved) -> Array:
    """How much the pictures differ about each voxel ``(n, n, m)``, CIELAB; averaged over neighbours."""
    points = carved.points[carved.solid]
    views = []
    for frame in frames.distinct:
        world = se3.apply(frame.standing[frames.name], points)
        colours = sample(frame.colours, frame.view.camera, frame.view.T_world_cam, world, frame.hidden)
        rows, columns, _, _ = frame.look(world)
        colours[~frame.foreground[rows, columns]] = np.nan
        views.append(colours)
    cost = np.zeros(carved.solid.shape)
    cost[carved.solid] = disagreement(np.stack(views), UNKNOWN)
    return _smoothed(cost) / np.maximum(_smoothed(carved.solid.astype(float)), 1e-3)


def disagreement(seen: Float32, unknown: float) -> Array:
    """How much views differ ``(k,)`` about points whose colours ``(v, k, 3)`` they show, CIELAB.

    The best of the views count, since others are blocked by something. A point that too few show gets
    ``unknown``.
    """
    weighted = seen * WEIGHTS
    is_seen = np.isfinite(weighted[..., 0])
    middle = np.ma.median(np.ma.masked_invalid(weighted), axis=0).filled(0.0)
    away = np.linalg.norm(weighted - middle, axis=-1)
    away = np.sort(np.where(is_seen, np.minimum(away, MAX_DIFFERENCE), np.inf), axis=0)
    n_seen = is_seen.sum(0)
    trusted = np.maximum((n_seen * TRUSTED_SHARE).astype(int), 1)
    sums = np.cumsum(away, axis=0)[trusted - 1, np.arange(seen.shape[1])]
    return np.where(n_seen >= MIN_VIEWS, sums / trusted, unknown)


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
