"""Fitting an upright box or cylinder to the outlines of its masks, in all views at once.

How far a mask reaches in a direction of the image is how far the furthest vertex of the body reaches. These
reaches (the convex hulls' support functions) are compared in pixels, in directions all around. Two views
determine place, direction, size and support plane; one view determines what is left where the plane is known.
Where the image's border cuts a mask, its reach there is not the object's and is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.box.box import Box
from lerobot_openspm.types import UNKNOWN_YAW_STD, Mask, View

_ANGLES = np.arange(32) * 2 * np.pi / 32
DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
# A mask's outermost pixels have their centres inside: on average it reaches about a third of a pixel further.
BEYOND_CENTRE_PX = 0.35 * np.abs(DIRECTIONS).sum(axis=1)
SOFT_PX = 1.0
ROUNDS, MAX_EVALUATIONS = 2, 40
SIZES_M = (1e-4, 10.0)
# What is further off than this many times the middle residual, and at least so many pixels, was hidden.
OUTLIER, OUTLIER_PX = 4.0, 2.0
# Neighbouring directions end at the same corner: so many of them count as one observation.
CORRELATED = 4.0
MIN_RESIDUAL_PX = 0.3
# A support plane that is held and not fitted is known to about this, metres.
HEIGHT_STD_M = 0.002
MIN_VISIBLE_SHARE = 0.35
OUT_OF_SIGHT_PX = 1e4


@dataclass(frozen=True)
class Outline:
    """A mask's reach in all directions.

    Attributes:
        view: The view.
        mask: The mask ``(H, W)``.
        reach_px: Largest coordinate ``(k,)`` of the mask along each of :data:`DIRECTIONS`, pixels.
        whole: Whether the mask ends there ``(k,)`` before the image does.
        confidence: Of the mask, from 0 to 1.
    """

    view: View
    mask: Mask
    reach_px: Array
    whole: NDArray[np.bool_]
    confidence: float


@dataclass(frozen=True)
class OutlineFit:
    """A fitted body.

    Attributes:
        body: The box or cylinder.
        covariance: ``(4, 4)`` over x, y, z in metres and yaw in radians.
        residual_px: Root mean square of the reaches' differences, each at most at the limit of outliers.
    """

    body: Box
    covariance: Array
    residual_px: float


def outline(view: View, mask: Mask, confidence: float = 1.0) -> Outline:
    """The outline of a mask with at least one pixel."""
    v, u = np.nonzero(mask)
    corners = cv2.convexHull(np.stack([u, v], axis=1).astype(np.int32))[:, 0].astype(float)
    along = corners @ DIRECTIONS.T
    furthest = corners[along.argmax(axis=0)]
    last = np.array([mask.shape[1], mask.shape[0]]) - 1
    whole = np.all((furthest > 0) & (furthest < last), axis=1)
    return Outline(view, mask, along.max(axis=0) + BEYOND_CENTRE_PX, whole, confidence)


def fit_outlines(
    outlines: Sequence[Outline], start: Box, free_height: bool = False, free_size: bool = False
) -> OutlineFit:
    """Move a body, and resize it if asked to, to where it fills the outlines.

    Args:
        outlines: One per view, of one object.
        start: Where to begin, and what to keep of what is not free.
        free_height: Whether the support plane is to be found; it takes two views.
        free_size: Whether the size is to be found.
    """
    change = _Change(start, free_height, free_size)
    weights = np.concatenate([one.whole * np.sqrt(one.confidence) for one in outlines])

    def errors(values: Array, weights: Array) -> Array:
        body = change.body(values)
        return weights * np.concatenate([reach_differences(one, body) for one in outlines])

    values, residual, jacobian = change.start_values, np.inf, np.zeros((1, len(change.start_values)))
    for _ in range(ROUNDS if weights.any() else 0):
        found = least_squares(
            errors, values, args=(weights,), loss="soft_l1", f_scale=SOFT_PX, x_scale=change.scales,
            max_nfev=MAX_EVALUATIONS,
        )  # fmt: skip
        values, jacobian = found.x, found.jac
        off = np.abs(errors(values, (weights > 0).astype(float)))
        limit = max(OUTLIER_PX, OUTLIER * float(np.median(off[weights > 0])))
        residual = float(np.sqrt(np.mean(np.minimum(off[weights > 0], limit) ** 2)))
        if off.max() <= limit:
            break
        weights = np.where(off > limit, 0.0, weights)
    return OutlineFit(change.body(values), _covariance(jacobian, change.free, residual), residual)


class _Change:
    """What may change of a body: of x, y, z, yaw and the logarithms of its sides, those that are free."""

    def __init__(self, start: Box, free_height: bool, free_size: bool):
        turns = not start.is_round  # a cylinder has no yaw, and one diameter
        self.free = np.array([True, True, free_height, turns, free_size, free_size and turns, free_size])
        yaw = float(se3.yaw_of(start.T_world_obj))
        self._start, self._all = start, np.array([*start.T_world_obj[:3, 3], yaw, *np.log(start.size)])

    @property
    def start_values(self) -> Array:
        return self._all[self.free]

    @property
    def scales(self) -> Array:
        """A step of a centimetre goes with one of a tenth of a radian, or of the size."""
        return np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0, 1.0])[self.free]

    def body(self, values: Array) -> Box:
        every = self._all.copy()
        every[self.free] = values
        sides = every[[4, 4, 6]] if self._start.is_round else every[4:]
        size = np.exp(np.clip(sides, *np.log(SIZES_M)))
        return Box(se3.from_yaw(every[:3], every[3]), size, self._start.is_round)


def reach_differences(one: Outline, body: Box) -> Array:
    """How much further than the mask the body reaches ``(k,)``, pixels."""
    uv, _ = project(one.view.camera, one.view.T_world_cam, body.vertices())
    uv = np.nan_to_num(uv, nan=OUT_OF_SIGHT_PX)
    return (uv @ DIRECTIONS.T).max(axis=0) - one.reach_px


def overlap(view: View, mask: Mask | None, body: Box) -> float:
    """Intersection over union of a body's picture and a mask ``(H, W)``; NaN where it is mostly out of sight.

    Where the body is in sight but there is no mask of it, that is 0.
    """
    uv, depth = project(view.camera, view.T_world_cam, body.vertices())
    if depth.min() <= 0.01:
        return float("nan")
    picture = np.zeros(view.image.shape[:2], np.uint8)
    corners = cv2.convexHull(np.clip(np.rint(uv * 16), -1e6, 1e6).astype(np.int32))
    area = cv2.contourArea(corners) / 256
    cv2.fillConvexPoly(picture, corners, 1, shift=4)
    drawn = picture > 0
    if drawn.sum() < max(12.0, MIN_VISIBLE_SHARE * area):
        return float("nan")
    return 0.0 if mask is None else float((drawn & mask).sum() / (drawn | mask).sum())


def _covariance(jacobian: Array, free: NDArray[np.bool_], residual_px: float) -> Array:
    """Covariance over x, y, z, yaw from the fit's Jacobian ``(n, free)``, what is not seen bounded."""
    information = jacobian.T @ jacobian / (CORRELATED * max(residual_px, MIN_RESIDUAL_PX) ** 2)
    floor = np.array([0.25, 0.25, 0.25, 1 / UNKNOWN_YAW_STD**2, 0.25, 0.25, 0.25])[free]
    full = np.diag([1.0, 1.0, HEIGHT_STD_M**2, UNKNOWN_YAW_STD**2, 0, 0, 0])
    full[np.ix_(free, free)] = np.linalg.inv(information + np.diag(floor))
    return full[:4, :4]
