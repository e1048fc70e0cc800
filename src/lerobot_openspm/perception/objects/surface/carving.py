"""Carving objects out of the space above the table: where the table is seen through, there is nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening, distance_transform_edt, label

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.backdrop import Float32, lab, pixels_of, representatives
from lerobot_openspm.types import Mask, View

# A voxel is empty if the table is seen through it by a fixed camera, in most demonstrations, or by the hand's
# from two directions and from this share of all.
MIN_VIEWS, EMPTY_SHARE, MOST = 2, 0.04, 0.5
# The first search for an object's footprint: how far around the touched points, and how finely, metres.
FOOTPRINT_M, COARSE_CELL_M = 0.30, 0.01
MAX_HEIGHT_M = 0.40
# An object overhangs its footprint by this much at most.
OVERHANG_M = 0.03
# A footprint this near to a touched point is the object's.
TOUCH_M = 0.05
CELLS, MIN_CELL_M, MAX_CELL_M = 40, 0.004, 0.007


@dataclass(frozen=True)
class Frame:
    """One picture of a demonstration.

    Attributes:
        camera: Name of the camera.
        view: The picture.
        foreground: Pixels ``(H, W)`` that show an object, or the robot.
        hidden: Pixels ``(H, W)`` that show the hand in its own camera; None in others.
        standing: Poses ``T_world_obj`` ``(4, 4)`` of the objects that stand where they stood at first.
        is_untouched: Whether all of them do, so that nothing in the hand is in sight.
    """

    camera: str
    view: View
    foreground: Mask
    hidden: Mask | None
    standing: Mapping[str, Array]
    is_untouched: bool = True
    _colours: list[Float32] = field(default_factory=list[Float32])

    @property
    def colours(self) -> Float32:
        """CIELAB ``(H, W, 3)`` of the picture; computed once."""
        if not self._colours:
            self._colours.append(lab(self.view.image))
        return self._colours[0]

    def look(self, points_world: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Float32, Mask]:
        """Rows, columns, depths and whether they are in sight, of world points ``(n, 3)``."""
        u, v, depth, inside = pixels_of(self.view.camera, self.view.T_world_cam, points_world)
        rows, columns = np.rint(v).astype(np.int64), np.rint(u).astype(np.int64)
        if self.hidden is not None:
            inside = inside & ~self.hidden[rows, columns]
        return rows, columns, depth, inside


@dataclass(frozen=True)
class Frames:
    """The frames in which one object stands, grouped by where the camera looked from."""

    name: str
    frames: Sequence[Frame]

    @cached_property
    def groups(self) -> tuple[NDArray[np.int64], list[int]]:
        """Group of each frame, and one frame of each group."""
        return representatives([frame.view.T_world_cam for frame in self.frames])

    @property
    def distinct(self) -> list[Frame]:
        """One frame of each group."""
        return [self.frames[i] for i in self.groups[1]]

    @property
    def untouched(self) -> Frames:
        """The frames in which nothing has moved yet."""
        return Frames(self.name, [frame for frame in self.frames if frame.is_untouched])

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)


@dataclass(frozen=True)
class Carved:
    """What is left of the space around an object.

    Attributes:
        x: Coordinates ``(n,)`` of the columns along the object's x and y axes, metres.
        z: Heights ``(m,)`` of the layers in the object's frame, metres, from the table upwards.
        solid: Voxels ``(n, n, m)`` that may be the object's.
    """

    x: Array
    z: Array
    solid: Mask

    @property
    def cell(self) -> float:
        """Distance between columns, metres."""
        return float(self.x[1] - self.x[0])

    @property
    def points(self) -> Array:
        """Centres ``(n, n, m, 3)`` of all voxels in the object's frame."""
        return np.stack(np.meshgrid(self.x, self.x, self.z, indexing="ij"), -1)


def carve(frames: Frames, touched: Array, table: float) -> Carved | None:
    """Carve one object.

    Args:
        frames: The frames in which it stands.
        touched: Points ``(k, 3)`` in its frame at, or above, which it was touched.
        table: Height of the table in its frame, metres.

    Returns:
        None where nothing stands at the touched points.
    """
    reach = float(np.abs(touched[:, :2]).max()) + FOOTPRINT_M
    coarse: Array = np.arange(-reach, reach + COARSE_CELL_M, COARSE_CELL_M).astype(float)
    low = table + np.array([0.5, 1.5]) * COARSE_CELL_M
    base: Mask = np.all(_possible(frames, coarse, low), axis=-1)
    own, _ = _footprint(base, coarse, touched)
    if not own.any():
        return None
    size = float(np.abs(coarse[np.stack(np.nonzero(own))]).max())
    cell = float(np.clip(2 * size / CELLS, MIN_CELL_M, MAX_CELL_M))
    x: Array = np.arange(-size - OVERHANG_M, size + OVERHANG_M + cell, cell).astype(float)
    z: Array = np.arange(table + cell / 2, table + MAX_HEIGHT_M, cell).astype(float)
    solid = np.zeros((len(x), len(x), len(z)), bool)
    solid[..., :2] = _possible(frames, x, z[:2])
    base = np.all(solid[..., :2], axis=-1)
    own, others = _footprint(base, x, touched)
    if not own.any():
        return None
    near = binary_dilation(own, iterations=round(OVERHANG_M / cell))
    if others.any():
        near &= _distance(own) <= _distance(others)
    # Layer by layer upwards: what does not rest on anything is no part of the object.
    solid[..., :2] &= near[..., None]
    for layer in range(2, len(z)):
        below = binary_dilation(solid[..., layer - 1], iterations=2) & near
        if not below.any():
            break
        solid[..., layer] = _possible(frames, x, z[layer : layer + 1], below)[..., 0]
    pieces = _pieces(solid)
    kept = np.isin(pieces, np.setdiff1d(np.unique(pieces[own][:, :1]), [0]))
    top = int(np.flatnonzero(kept.any((0, 1)))[-1]) + 1
    return Carved(x, z[:top], kept[..., :top])


def _possible(frames: Frames, x: Array, z: Array, among: Mask | None = None) -> Mask:
    """Voxels ``(n, n, m)`` that the table is not seen through; all others are False."""
    grid = np.stack(np.meshgrid(x, x, z, indexing="ij"), -1)
    chosen = np.ones(grid.shape[:3], bool) if among is None else np.repeat(among[..., None], len(z), -1)
    points = grid[chosen]
    groups, firsts = frames.groups
    seen, empty = (np.zeros((len(firsts), len(points)), np.int16) for _ in range(2))
    for frame, group in zip(frames, groups, strict=True):
        rows, columns, _, inside = frame.look(se3.apply(frame.standing[frames.name], points))
        seen[group] += inside
        empty[group] += inside & ~frame.foreground[rows, columns]
    is_fixed = np.array([frames.frames[i].view.camera.mount == "world" for i in firsts])
    n_seen, n_empty = (seen > 0).sum(0), (empty > 0)[~is_fixed].sum(0)
    gone = ((empty > MOST * seen) & is_fixed[:, None]).any(0)
    possible = np.zeros(chosen.shape, bool)
    possible[chosen] = (n_seen >= MIN_VIEWS) & (n_empty < np.maximum(MIN_VIEWS, EMPTY_SHARE * n_seen)) & ~gone
    return possible


def _footprint(base: Mask, x: Array, touched: Array) -> tuple[Mask, Mask]:
    """The pieces of a cross-section ``(n, n)`` at touched points, and the others."""
    opened = binary_opening(base, np.ones((3, 3)))
    pieces = _pieces(opened)
    grid = np.stack(np.meshgrid(x, x, indexing="ij"), -1)
    own: set[int] = set()
    for point in touched:
        away = np.where(opened, np.linalg.norm(grid - point[:2], axis=-1), np.inf)
        if away.min() < TOUCH_M:
            own.add(int(pieces[np.unravel_index(away.argmin(), away.shape)]))
    mine = np.isin(pieces, sorted(own)) & opened
    return mine, opened & ~mine


def _pieces(mask: Mask) -> NDArray[np.int64]:
    """Number of the connected piece that each cell belongs to; 0 for none."""
    return np.asarray(label(mask)[0], np.int64)  # pyright: ignore[reportIndexIssue]


def _distance(mask: Mask) -> Array:
    """Cells from each cell to the nearest one of a mask."""
    return np.asarray(distance_transform_edt(~mask), float)


def silhouette(frame: Frame, points_world: Array, spacing: float) -> Float32:
    """Depth ``(H, W)`` of the nearest of points ``(n, 3)``, ``spacing`` metres apart; infinite elsewhere."""
    height, width = frame.view.image.shape[:2]
    u, v, depth, inside = pixels_of(frame.view.camera, frame.view.T_world_cam, points_world)
    nearest = np.full((height, width), np.inf, np.float32)
    if not inside.any():
        return nearest
    rows, columns = np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)
    np.minimum.at(nearest, (rows, columns), depth[inside])
    across = 0.5 * spacing * frame.view.camera.focal_px / float(np.median(depth[inside]))
    radius = int(np.clip(np.ceil(across), 1, 6))
    return spread(nearest, radius)


def spread(nearest: Float32, radius: int) -> Float32:
    """Depths ``(H, W)``, infinite where nothing is, each taken to cover a square of pixels around it."""
    if radius == 0:
        return nearest
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    wide = cv2.erode(nearest, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=float("inf"))
    return np.asarray(wide, np.float32)
