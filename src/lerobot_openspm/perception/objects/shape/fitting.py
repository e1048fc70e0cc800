"""Fitting a model's pose to soft masks in several views at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.shape import silhouette
from lerobot_openspm.types import UNKNOWN_YAW_STD, View

LIMIT_PX = 40.0
COARSE_PX, FINE_PX = 64.0, 160.0
# Cuts of the residuals, one Gauss-Newton step each: from far off, and from nearby.
COARSE_CUTS_PX = (30.0, 30.0, 20.0, 12.0)
FINE_CUTS_PX = (6.0, 4.0, 3.0, 3.0)
# Residuals along a contour are alike over several pixels: so many of them count as one observation.
CORRELATED_PX = 4.0
MIN_RESIDUAL_PX = 0.4
MIN_VISIBLE_SHARE = 0.35
# Relative to the overlap that is typical of the object's demonstrations.
FOUND_CONFIDENCE = 0.74
RIVAL_SHARE = 0.93
# A further place must explain the images so well to count as another object of the kind: a mug of a bowl's
# colour reaches 0.81, a bottle that is half hidden 0.87.
ANOTHER_CONFIDENCE = 0.84
# Two bodies nearer than this share of their radius are one: a part of a mask is no second object.
SAME_PLACE = 0.7


@dataclass(frozen=True)
class Evidence:
    """One view with its foreground probability.

    Attributes:
        view: The view.
        probability: Values ``(H, W)`` from 0 to 1, float32.
        visible: 0 where something is known to hide whatever lies behind, else 1, ``(H, W)`` float32; None for
            nothing known.
        camera: Name of the camera.
    """

    view: View
    probability: silhouette.Float32
    visible: silhouette.Float32 | None = None
    camera: str = ""

    @cached_property
    def distance(self) -> silhouette.Float32:
        """Signed distance of the mask, see :func:`silhouette.observed_distance`; computed once."""
        return silhouette.observed_distance(self.probability, LIMIT_PX)


@dataclass(frozen=True)
class Cloud:
    """Surface points ``(n, 3)`` of a model in its frame, ``spacing`` metres apart."""

    points: Array
    spacing: float


@dataclass(frozen=True)
class PosePrior:
    """Standard deviations of the prior around the start pose: 0 holds a coordinate, infinity frees it."""

    position: float = np.inf
    height: float = 0.0
    yaw: float = np.inf

    @property
    def information(self) -> Array:
        """Diagonal ``(4,)`` of the prior's information over x, y, z, yaw."""
        stds = np.array([self.position, self.position, self.height, self.yaw])
        return 1 / np.maximum(stds, 1e-6) ** 2


@dataclass(frozen=True)
class Fit:
    """A fitted pose, its covariance ``(4, 4)`` over x, y, z, yaw, and how well it explains the views.

    Attributes:
        overlaps: Intersection over union per view, NaN where the model is out of sight.
        score: Their mean over the views that show the object; 0 when none does.
    """

    T_world_obj: Array
    covariance: Array
    overlaps: Array
    score: float


def fit(
    evidence: Sequence[Evidence],
    cloud: Cloud,
    T_start: Array,
    pose_prior: PosePrior,
    cuts_px: Sequence[float],
    detail_px: float = FINE_PX,
) -> Fit:
    """Move a model from ``T_start`` to where its silhouettes match the masks.

    Args:
        evidence: The views.
        cloud: The model.
        T_start: Start pose ``(4, 4)``, upright.
        pose_prior: What may move, and how far.
        cuts_px: One Gauss-Newton step per entry; residuals beyond the entry are outliers in that step.
        detail_px: Size of the drawings, see :func:`silhouette.draw`.
    """
    T, prior, offset = np.array(T_start, float), pose_prior.information, np.zeros(4)
    hessian, scale = np.zeros((4, 4)), 1.0
    for cut in cuts_px:
        hessian, gradient, squares, weights = np.zeros((4, 4)), np.zeros(4), 0.0, 0.0
        for one in evidence:
            drawing = silhouette.draw(cloud.points, cloud.spacing, T, one.view, detail_px)
            if drawing is None:
                continue
            part = silhouette.normal_equations(
                drawing, one.distance, one.visible, one.view, T, cloud.points, cut
            )
            hessian, gradient = hessian + part[0], gradient + part[1]
            squares, weights = squares + part[2], weights + part[3]
        if weights < 8:
            break
        scale = CORRELATED_PX * max(squares / weights, MIN_RESIDUAL_PX**2)
        step = np.linalg.solve(hessian / scale + np.diag(prior + 1e-3), -gradient / scale - prior * offset)
        step = np.clip(step, [-0.04, -0.04, -0.04, -0.5], [0.04, 0.04, 0.04, 0.5])
        offset += step
        T = se3.from_yaw(T[:3, 3] + step[:3], se3.yaw_of(T) + step[3])
    drawings = [silhouette.draw(cloud.points, cloud.spacing, T, one.view, detail_px) for one in evidence]
    overlaps = _overlaps(evidence, drawings)
    return Fit(T, _covariance(hessian / scale, prior), overlaps, score(overlaps))


def measure(
    evidence: Sequence[Evidence], cloud: Cloud, T_world_obj: Array, detail_px: float = COARSE_PX
) -> Array:
    """Intersection over union of drawing and mask per view ``(v,)``; NaN where the model is out of sight."""
    T = T_world_obj
    drawings = [silhouette.draw(cloud.points, cloud.spacing, T, one.view, detail_px) for one in evidence]
    return _overlaps(evidence, drawings)


def _overlaps(evidence: Sequence[Evidence], drawings: Sequence[silhouette.Drawing | None]) -> Array:
    overlaps = np.full(len(evidence), np.nan)
    for i, (one, drawing) in enumerate(zip(evidence, drawings, strict=True)):
        if drawing is None:
            continue
        common, model, mask = silhouette.overlap(drawing, one.probability, one.visible)
        whole = np.count_nonzero(drawing.distance > 0) / drawing.scale**2
        # What is mostly cut off by the image's border says little about the fit.
        if model > max(20.0, MIN_VISIBLE_SHARE * whole):
            overlaps[i] = common / max(model + mask - common, 1.0)
    return overlaps


def score(overlaps: Array) -> float:
    """One number of overlaps per view: a view in which the object is hidden pulls it down, but only half."""
    seen = overlaps[np.isfinite(overlaps)]
    return 0.0 if len(seen) == 0 else float(0.5 * seen.max() + 0.5 * seen.mean())


def verdict(
    scores: Sequence[float], typical_overlap: float
) -> tuple[Literal["found", "not_found", "ambiguous"], float]:
    """Status and confidence of fits at distinct places, from their scores, the best first; one at least."""
    confidence = float(np.clip(scores[0] / max(typical_overlap, 1e-3), 0, 1))
    if confidence < FOUND_CONFIDENCE:
        return "not_found", confidence
    is_rivalled = len(scores) > 1 and scores[1] > RIVAL_SHARE * scores[0]
    return "ambiguous" if is_rivalled else "found", confidence


def distinct(poses: Sequence[Array], radius: float) -> list[int]:
    """Indices of the poses ``(4, 4)``, the best first, that are not at the place of a better one."""
    kept: list[int] = []
    for i, T in enumerate(poses):
        places = [poses[k][:2, 3] for k in kept]
        if all(np.linalg.norm(T[:2, 3] - place) > SAME_PLACE * radius for place in places):
            kept.append(i)
    return kept


def others(scores: Sequence[float], typical_overlap: float) -> int:
    """How many of the fits after the best, from the same scores, show an object of the kind too."""
    return sum(score >= ANOTHER_CONFIDENCE * typical_overlap for score in scores[1:])


def _covariance(information: Array, prior: Array) -> Array:
    """Covariance ``(4, 4)``, the yaw's bounded by that of an unknown yaw."""
    floor = np.array([0.25, 0.25, 0.25, 1 / UNKNOWN_YAW_STD**2])
    return np.asarray(np.linalg.inv(information + np.diag(prior + floor)), float)
