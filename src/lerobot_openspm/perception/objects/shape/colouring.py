"""The colours of a shape's surface: they tell apart poses whose silhouettes are alike."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.shape.fitting import Cloud, Evidence
from lerobot_openspm.perception.objects.shape.hull import Posed
from lerobot_openspm.perception.objects.shape.silhouette import Float32

# A point is hidden by its own object where another point lies so many spacings nearer.
BEHIND_SPACINGS = 2.5
# Colours this far apart in CIELAB agree by a share of 1/e.
ALIKE_LAB = 9.0
# A point's colour is known from so many pictures on.
MIN_PICTURES = 3
# What a point never seen may look like is told by so many of the others. One that looks like any of them
# agrees by this share: less than one that shows its own colour, more than one that shows another.
PALETTE, UNSEEN_SHARE = 64, 0.9
# A pose is a little off and a point stands for what is around it: a known point may show its colour half a
# spacing beside it, to eight sides.
BESIDE_SPACINGS = 0.5
AROUND = ((0, 0), (-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
UNSEEN = -1.0
# A pixel is another object's where the object's colours are less probable than this.
OWN_PROBABILITY = 0.5


def learn_colours(posed: Sequence[Posed], cloud: Cloud) -> Float32:
    """Mean CIELAB colour ``(n, 3)`` of a cloud's points; -1 where they were hardly seen."""
    total, count = np.zeros((len(cloud.points), 3)), np.zeros(len(cloud.points))
    for scene in posed:
        for index, colours, own in _seen(scene.evidence, cloud, scene.T_world_obj):
            total[index[own]] += colours[own, 0]
            count[index[own]] += 1
    is_known = count >= MIN_PICTURES
    mean = total / np.maximum(count, 1)[:, None]
    return np.where(is_known[:, None], mean, UNSEEN).astype(np.float32)


def agreement(evidence: Sequence[Evidence], cloud: Cloud, colours: Float32, T_world_obj: Array) -> float:
    """How far the views show the learned colours where a pose ``(4, 4)`` puts them, from 0 to 1.

    A point whose colour was never seen may have that of any other one. What is not of the object's colours at
    all tells nothing here: that is what silhouettes are for.
    """
    known, shown = colours[:, 0] >= 0, colours.astype(float)
    if not known.any():
        return 0.0
    palette = shown[known][:: max(1, int(known.sum()) // PALETTE)]
    shares: list[NDArray[np.floating]] = []
    for index, seen, own in _seen(evidence, cloud, T_world_obj):
        index, seen = index[own], seen[own]
        is_known = known[index]
        alike = np.empty(len(index))
        alike[is_known] = _alike(seen[is_known], shown[index[is_known], None]).max(axis=1)
        alike[~is_known] = UNSEEN_SHARE * _alike(seen[~is_known, :1], palette[None]).max(axis=1)
        shares.append(alike)
    together = np.concatenate(shares) if shares else np.zeros(0)
    return float(together.mean()) if len(together) else 0.0


def _alike(a: Array, b: Array) -> Array:
    return np.exp(-np.square(np.linalg.norm(a - b, axis=-1) / ALIKE_LAB))


def _seen(
    evidence: Sequence[Evidence], cloud: Cloud, T_world_obj: Array
) -> Iterator[tuple[NDArray[np.intp], Array, NDArray[np.bool_]]]:
    """By view: points in sight, the colours ``(k, 9, 3)`` there and around, and which are the object's."""
    points_world = se3.apply(T_world_obj, cloud.points)
    for one in evidence:
        camera = one.view.camera
        uv, depth = project(camera, one.view.T_world_cam, points_world)
        inside = (depth > 0.01) & (np.nan_to_num(uv, nan=-1.0) >= 0).all(axis=1)
        inside &= (uv < np.array([camera.width, camera.height]) - 0.5).all(axis=1)
        index = np.flatnonzero(inside)
        if len(index) == 0:
            continue
        spacing_px = cloud.spacing * camera.focal_px / float(depth[index].mean())
        index = index[_in_front(uv[index], depth[index], spacing_px, BEHIND_SPACINGS * cloud.spacing)]
        pixel = np.floor(uv[index] + 0.5).astype(int).T[::-1]
        if one.visible is not None:
            kept = one.visible[tuple(pixel)] > 0.5
            index, pixel = index[kept], pixel[:, kept]
        lab = cv2.cvtColor(np.ascontiguousarray(one.view.image), cv2.COLOR_RGB2LAB)
        beside = max(1, round(BESIDE_SPACINGS * spacing_px)) * np.array(AROUND)
        last = np.array([camera.height, camera.width])[:, None, None] - 1
        around = (pixel[:, :, None] + beside.T[:, None]).clip(0, last)
        yield index, lab[tuple(around)].astype(float), one.probability[tuple(pixel)] > OWN_PROBABILITY


def _in_front(uv: Array, depth: Array, spacing_px: float, margin: float) -> NDArray[np.bool_]:
    """Which of the points ``(n, 2)`` at depths ``(n,)`` are not behind others of them."""
    cells = np.floor(uv / max(1.5 * spacing_px, 1.0)).astype(int)
    cells -= cells.min(axis=0) - 1
    nearest = np.full(tuple(cells.max(axis=0) + 2), np.inf, np.float32)
    np.minimum.at(nearest, tuple(cells.T), depth.astype(np.float32))
    nearest = -cv2.dilate(-nearest, np.ones((3, 3), np.uint8))
    return depth <= nearest[tuple(cells.T)] + margin
