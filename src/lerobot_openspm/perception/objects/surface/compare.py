"""How well a pose of a surface agrees with what the cameras show.

The points of the surface that a camera can see at the pose are compared with the picture. A point counts for
the pose where the picture has its colour, against it where the picture shows the table, and hardly at all
where something else may be in front of it. Around the silhouette the picture must not go on in its colours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.backdrop import Float32, pixels_of
from lerobot_openspm.perception.objects.surface.carving import spread
from lerobot_openspm.perception.objects.surface.sight import FINEST, LIKE_COARSE, Sight, Surface
from lerobot_openspm.types import Mask

# Colours this far apart, CIELAB, are alike.
LIKE = 8.0
# Pictures are smoothed by so many octaves more than least at most; the search begins with this many.
MAX_OCTAVE, COARSE_OCTAVE = 4, 2
# Smoothed over this share of the points' distance a picture shows as much detail as they have.
DETAIL_SHARE = 0.5
# What neither shows the object nor the table counts as this much of a point, and as evidence for the pose.
BLOCKED_WEIGHT, BLOCKED_EVIDENCE = 0.5, 0.1
# What the colours going on around the silhouette cost.
RIM_COST = 0.6
# An object may reach beyond its outermost points by this share of their distance. The rim, which has to look
# otherwise than the object, begins and ends so many pixels outside of that.
BEYOND, RIM_PX = 1.0, (0, 2)
# What colours that do not vary over the object as expected cost, if they are to vary by much more than this.
PATTERN_COST, PATTERN_STD, PATTERN_BLOCKED = 0.6, 3.0, 0.3
# Points are drawn this large at most, in pixels.
MAX_PX = 16
# What looks like the table and like the object is so much less likely to be the object.
TABLE_SHARE = 0.5
# A view counts if it shows this share of the visible points.
MIN_SHOWN, MIN_SHOWN_COARSE = 0.15, 0.3
# A camera that sees this share of the coloured points sees as much of an object as it can.
WHOLE_SHARE = 0.15
# Views that show less of an object than this in all, 1 being all that one of them could, tell too little.
ENOUGH_SHOWN = 1.0
FINE_POINTS, MIN_POINTS = 300, 8


@dataclass(frozen=True)
class Sample:
    """Points of a surface that a camera sees at some pose, and points just outside its silhouette.

    Attributes:
        points: ``(n, 3)`` in the object's frame.
        colours: Weighted CIELAB ``(n, 2, 3)``.
        rim: ``(m, 3)`` in the object's frame, at the depth of the silhouette's edge.
        rim_colours: Weighted CIELAB ``(m, 2, 3)`` of the edge.
        weight: From 0 to 1; less where the camera sees only a small part of the surface.
        octave: How far pictures are smoothed to show as much detail as the surface has.
        pattern: How much the variation of its colours tells; see :class:`Surface`.
    """

    points: Float32
    colours: Float32
    rim: Float32
    rim_colours: Float32
    weight: float
    octave: int
    pattern: float

    def thinned(self, step: int) -> Sample:
        """Every so many-th of the points."""
        return replace(
            self, points=self.points[::step], colours=self.colours[::step],
            rim=self.rim[::step], rim_colours=self.rim_colours[::step],
        )  # fmt: skip


def rotations(yaws: Array) -> Array:
    """Rotations ``(n, 3, 3)`` about the vertical."""
    c, s, o = np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)
    return np.stack([c, -s, o, s, c, o, o, o, o + 1], -1).reshape(-1, 3, 3)


def take_sample(surface: Surface, sight: Sight, pose: Array, count: int) -> Sample | None:
    """What a camera sees of a surface at a pose (x, y, z, yaw); None if hardly anything."""
    R, t = rotations(pose[3:4])[0], pose[:3]
    world = surface.points @ R.T + t
    camera, T = sight.view.camera, sight.view.T_world_cam
    u, v, depth, inside = pixels_of(camera, T, world)
    if inside.sum() < MIN_POINTS:
        return None
    rows, columns = np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)
    across_px = surface.spacing * camera.focal_px / float(np.median(depth[inside]))
    radius, beyond = (int(np.clip(np.ceil(share * across_px), 0, MAX_PX)) for share in (0.5, BEYOND))
    pad = MAX_PX + RIM_PX[1] + 2
    top, left = rows.min() - pad, columns.min() - pad
    shape = (int(rows.max() - top + pad + 1), int(columns.max() - left + pad + 1))
    nearest = np.full(shape, np.inf, np.float32)
    np.minimum.at(nearest, (rows - top, columns - left), depth[inside])
    drawn = spread(nearest, radius)
    facing = ((world - T[:3, 3]) * (surface.normals @ R.T)).sum(1) < 0
    visible = np.zeros(len(world), bool)
    visible[inside] = depth[inside] <= drawn[rows - top, columns - left] + 1.5 * surface.spacing
    visible &= facing & surface.has_colour
    own = np.flatnonzero(visible)
    if len(own) < MIN_POINTS:
        return None
    rim, edge = _rim(np.isfinite(drawn), radius, beyond, np.array([left, top]), count // 2, u[own], v[own])
    rays = np.stack(
        [(rim[:, 0] - camera.cx) / camera.fx, (rim[:, 1] - camera.cy) / camera.fy, np.ones(len(rim))], -1
    )
    beside = (rays * depth[own[edge], None]) @ T[:3, :3].T + T[:3, 3]
    chosen = spaced(own, count)
    return Sample(
        surface.points[chosen].astype(np.float32), surface.weighted[chosen].astype(np.float32),
        ((beside - t) @ R).astype(np.float32), surface.weighted[own[edge]].astype(np.float32),
        min(1.0, len(own) / (WHOLE_SHARE * len(surface.coloured))), _octave(surface, sight, depth[own]),
        surface.pattern,
    )  # fmt: skip


def _octave(surface: Surface, sight: Sight, depth: Float32) -> int:
    """How far a picture is smoothed that shows points at these depths ``(n,)``; see :class:`Sight`."""
    across_px = surface.spacing * sight.view.camera.focal_px / float(np.median(depth))
    finest_px = FINEST * sight.view.camera.width / 256
    return int(np.clip(np.ceil(np.log2(DETAIL_SHARE * across_px / finest_px)), 0, MAX_OCTAVE))


def _rim(
    mask: Mask, radius: int, beyond: int, corner: Array, count: int, u: Float32, v: Float32
) -> tuple[Array, NDArray[np.int64]]:
    """Pixels ``(m, 2)`` so far outside a drawn silhouette, and the nearest of its points at ``(u, v)``."""
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    if radius > 1:  # points were drawn as squares that reach beyond the surface
        closed = cv2.erode(closed, np.ones((2 * (radius // 2) + 1,) * 2, np.uint8))
    near, far = (
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * (beyond + more) + 1,) * 2) for more in RIM_PX
    )
    rows, columns = np.nonzero(cv2.dilate(closed, far) - cv2.dilate(closed, near))
    some = spaced(np.arange(len(rows)), count)
    rim = np.stack([columns[some], rows[some]], -1) + corner
    _, nearest = KDTree(np.stack([u, v], -1)).query(rim)
    return rim.astype(float), np.asarray(nearest, np.int64)


def spaced(indices: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """At most so many of some indices, evenly from all."""
    if len(indices) <= count:
        return indices
    return indices[np.linspace(0, len(indices) - 1, count).astype(int)]


def compare(sample: Sample, sight: Sight, poses: Array, is_coarse: bool = False) -> tuple[Array, Array]:
    """How well poses ``(q, 4)`` agree with a view, and how much of the object it tells of, each ``(q,)``.

    Agreement is 1 where every point has its colour and nothing goes on around it.
    """
    colours, table = sight.smoothed(max(sample.octave, COARSE_OCTAVE) if is_coarse else sample.octave)
    like = LIKE_COARSE if is_coarse else LIKE
    shown, on_table, inside = _shown(sample.points, sight, poses, colours, table)
    match = _match(shown, sample.colours, like)
    good = (match * inside).sum(1)
    bad = (on_table * (1 - match) * inside).sum(1)
    blocked = inside.sum(1) - good - bad
    told = good + bad + BLOCKED_WEIGHT * blocked
    n = len(sample.points)
    score = (good - bad + BLOCKED_EVIDENCE * blocked) / np.maximum(told, 0.05 * n)
    weights = inside * (1 - (1 - PATTERN_BLOCKED) * (1 - match) * (1 - on_table))
    together, tells = correlation(shown, sample.colours, weights)
    score = score * (1 - PATTERN_COST * sample.pattern * tells * (1 - np.clip(together, 0, 1)))
    if len(sample.rim):
        shown, on_table, inside = _shown(sample.rim, sight, poses, colours, table)
        goes_on = (_match(shown, sample.rim_colours, like) * (1 - on_table) * inside).sum(1)
        score = score - RIM_COST * goes_on / np.maximum(inside.sum(1), 1)
    return score, told / n


def palette_likeness(surface: Surface, sight: Sight) -> Float32:
    """How much every second pixel ``(H / 2, W / 2)`` has one of a surface's colours, from 0 to 1."""
    colours, table = sight.smoothed(COARSE_OCTAVE)
    colours, palette = colours[::2, ::2], surface.palette
    away = (colours**2).sum(-1, keepdims=True) - 2 * colours @ palette.T + (palette**2).sum(1)
    like = np.exp(away.min(-1) / (-2 * LIKE_COARSE**2))
    return np.asarray(like * (1 - TABLE_SHARE * table[::2, ::2]), np.float32)


def shown_at(picture: Float32, sight: Sight, points: Array, places: Array) -> tuple[Array, Array]:
    """Mean of every second pixel over points ``(n, 3)`` at places ``(q, 3)``, and the share that is told.

    Points that are hidden or not in the picture count as 0, and are not told.
    """
    P, hidden = sight.P, sight.hidden[::2, ::2]
    at = (points @ P[:, :3].T)[None] + (places @ P[:, :3].T + P[:, 3])[:, None]
    ahead = np.maximum(at[..., 2], 0.03)
    columns, rows = (np.rint(at[..., i] / ahead / 2).astype(np.int32) for i in (0, 1))
    height, width = picture.shape
    inside = (at[..., 2] > 0.03) & (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    index = np.where(inside, rows * width + columns, 0)
    inside &= ~hidden.ravel()[index]
    return np.asarray((picture.take(index) * inside).mean(1), float), np.asarray(inside.mean(1), float)


def _shown(
    points: Float32, sight: Sight, poses: Array, colours: Float32, table: Float32
) -> tuple[Float32, Float32, Mask]:
    """What is at points ``(n, 3)`` at poses ``(q, 4)``.

    Returns:
        Weighted CIELAB ``(q, n, 3)``, share of table ``(q, n)``, and whether the picture tells ``(q, n)``.
    """
    P = sight.P
    turned = P[:, :3] @ rotations(poses[:, 3]).astype(np.float32)
    at = (turned @ points.T) + (poses[:, :3].astype(np.float32) @ P[:, :3].T + P[:, 3])[..., None]
    ahead = np.maximum(at[:, 2], 0.03)
    columns, rows = np.rint(at[:, 0] / ahead).astype(np.int32), np.rint(at[:, 1] / ahead).astype(np.int32)
    height, width = table.shape
    inside = (at[:, 2] > 0.03) & (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    index = np.where(inside, rows * width + columns, 0)
    inside &= ~sight.hidden.ravel()[index]
    return colours.reshape(-1, 3).take(index, axis=0), table.ravel()[index], inside


def _match(shown: Float32, expected: Float32, like: float) -> Float32:
    """How well colours ``(q, n, 3)`` match what is expected ``(n, 2, 3)``, from 0 to 1."""
    first, along = expected[:, 0], expected[:, 1] - expected[:, 0]
    off = shown - first
    length = np.maximum(np.einsum("nc,nc->n", along, along), 1e-6)
    dot = np.einsum("qnc,nc->qn", off, along)
    share = np.clip(dot / length, 0, 1)
    away = np.maximum(np.einsum("qnc,qnc->qn", off, off) - share * (2 * dot - share * length), 0.0)
    return np.exp(away / (-2 * like**2))


def correlation(shown: Float32, expected: Float32, weights: Float32) -> tuple[Array, Array]:
    """How colours ``(q, n, 3)`` vary together with what is expected ``(n, 2, 3)``.

    Returns:
        The correlation ``(q,)``, and how much it tells, from 0 to 1; less for an object of one colour.
    """
    middle = expected.mean(1)
    middle = middle - middle.mean(0)
    n = np.maximum(weights.sum(1), 1.0)
    weighted = shown * weights[..., None]
    sum_shown, sum_expected = weighted.sum(1), weights @ middle
    together = weighted.reshape(len(shown), -1) @ middle.ravel() - (sum_shown * sum_expected).sum(1) / n
    vary_shown = np.einsum("qnc,qnc->q", weighted, shown) - (sum_shown**2).sum(1) / n
    vary_expected = weights @ (middle**2).sum(1) - (sum_expected**2).sum(1) / n
    together = together / np.sqrt(np.maximum(vary_shown * vary_expected, 1e-6))
    tells = vary_expected / (vary_expected + n * PATTERN_STD**2)
    return np.asarray(together, float), np.asarray(tells, float)


def agreement(
    samples: Mapping[str, Sample], sights: Mapping[str, Sight], poses: Array, is_coarse: bool = False
) -> Array:
    """How well poses ``(q, 4)`` agree with all views."""
    total, weight = np.zeros(len(poses)), np.zeros(len(poses))
    least = MIN_SHOWN_COARSE if is_coarse else MIN_SHOWN
    for camera, sample in samples.items():
        score, told = compare(sample, sights[camera], poses, is_coarse)
        told = np.where(told > least, sample.weight * told, 0.0)
        total += score * told
        weight += told
    return total / np.maximum(weight, ENOUGH_SHOWN)


def samples_at(surface: Surface, sights: Mapping[str, Sight], pose: Array, count: int) -> dict[str, Sample]:
    """What each camera sees of a surface at a pose; cameras that see hardly anything are left out."""
    taken = {camera: take_sample(surface, sight, pose, count) for camera, sight in sights.items()}
    return {camera: sample for camera, sample in taken.items() if sample is not None}


def score_at(surface: Surface, sights: Mapping[str, Sight], pose: Array) -> float:
    """How well a pose agrees with all views; 0 where none shows it."""
    samples = samples_at(surface, sights, pose, FINE_POINTS)
    return float(agreement(samples, sights, pose[None])[0]) if samples else 0.0


def correlation_at(surface: Surface, sights: Mapping[str, Sight], pose: Array) -> float:
    """How the colours of all views vary together with the surface's at a pose; 0 where none shows it."""
    total = weight = 0.0
    for camera, sample in samples_at(surface, sights, pose, FINE_POINTS).items():
        shown, _, inside = _shown(
            sample.points, sights[camera], pose[None], *sights[camera].smoothed(sample.octave)
        )
        together, tells = correlation(shown, sample.colours, inside.astype(np.float32))
        told = sample.weight * float(inside.mean() * tells[0])
        total, weight = total + told * float(together[0]), weight + told
    return total / max(weight, 1e-6)
