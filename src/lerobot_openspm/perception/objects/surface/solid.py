"""An object as the cells of space that it fills.

A relief tells the top of an object. What pictures see through below it, as between the shelves of a rack, is
taken out again: a cell at the surface stays if the pictures that see it agree about its colour (space
carving, Kutulakos and Seitz 2000).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter, label

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.backdrop import Backdrop, Float32, sample
from lerobot_openspm.perception.objects.surface.carving import Carved, Frame, Frames, silhouette
from lerobot_openspm.perception.objects.surface.relief import disagreement
from lerobot_openspm.types import Mask

# A cell is filled if this share of the views that see it have something there that nothing else explains. Few
# views do not tell: things that no task touches are seen behind it.
FILLED_SHARE, MIN_FILLED = 0.5, 4
# A cell of the surface is taken out where pictures differ by more than this about it, CIELAB.
INCONSISTENT = 14.0
# So often at most; what is behind a cell that was taken out is looked at next.
SWEEPS = 12
# A piece that stands by itself is the object's if it has this share of the cells of the largest one.
PIECE_SHARE = 0.1
# A camera sees a cell that is at most this many cells behind the nearest one.
DEPTH_CELLS = 1.5


@dataclass(frozen=True)
class Solid:
    """Filled cells ``(n, n, m)`` of a grid in the object's frame, as :class:`Carved` has it."""

    x: Array
    z: Array
    filled: Mask

    @property
    def cell(self) -> float:
        """Distance between cells, metres."""
        return float(self.x[1] - self.x[0])

    @cached_property
    def surface(self) -> Mask:
        """Cells ``(n, n, m)`` that border on an empty one; nothing is empty below the lowest."""
        below = np.concatenate([self.filled[..., :1], self.filled], -1)
        return self.filled & ~np.asarray(binary_erosion(below), bool)[..., 1:]

    @cached_property
    def points(self) -> Array:
        """Middles ``(k, 3)`` of the surface's cells, metres."""
        i, j, layer = np.nonzero(self.surface)
        return np.column_stack([self.x[i], self.x[j], self.z[layer]])

    @cached_property
    def normals(self) -> Array:
        """Outward directions ``(k, 3)`` at the points."""
        below = np.concatenate([self.filled[..., :1]] * 3 + [self.filled], -1).astype(float)
        slopes = np.gradient(gaussian_filter(below, 1.2))
        out = -np.stack([slope[..., 3:][self.surface] for slope in slopes], -1)
        return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)

    def depth(self, frame: Frame, name: str) -> Float32:
        """Depth ``(H, W)`` of the surface in a picture in which the object of that name stands."""
        return silhouette(frame, se3.apply(frame.standing[name], self.points), self.cell)


class Depths:
    """How far away the surfaces of standing objects are in each picture; each is drawn once."""

    def __init__(self, solids: Mapping[str, Solid]) -> None:
        """Take the objects by name."""
        self._solids = solids
        self._drawn: dict[tuple[str, int], Float32] = {}
        self._frames: list[Frame] = []  # kept, so that no other frame gets the id of one of them

    def nearest(self, frame: Frame, besides: str = "") -> Float32:
        """Depth ``(H, W)`` of the nearest surface, except one object's; infinite where there is none."""
        height, width = frame.view.image.shape[:2]
        names = [name for name in frame.standing if name in self._solids and name != besides]
        depths = [self._depth(frame, name) for name in names]
        return np.min(depths, axis=0) if depths else np.full((height, width), np.inf, np.float32)

    def covered(self, frame: Frame) -> Mask:
        """Pixels ``(H, W)`` that the surfaces explain."""
        covered = np.isfinite(self.nearest(frame)).astype(np.uint8)
        return cv2.dilate(covered, np.ones((3, 3), np.uint8)).astype(bool)

    def _depth(self, frame: Frame, name: str) -> Float32:
        key = name, id(frame)
        if key not in self._drawn:
            self._frames.append(frame)
            self._drawn[key] = self._solids[name].depth(frame, name)
        return self._drawn[key]


def solid_under(top: NDArray[np.int64], carved: Carved) -> Solid:
    """What is left of a carved space up to its columns' topmost layers ``(n, n)``."""
    return Solid(carved.x, carved.z, carved.solid & (np.arange(len(carved.z)) <= top[..., None]))


def fill_silhouettes(
    frames: Frames, carved: Carved, solid: Solid, depths: Depths, backdrop: Backdrop
) -> Solid:
    """Raise a solid to where pictures show something that no object's surface explains.

    Args:
        frames: The frames in which the object stands and nothing is in the hand.
        carved: The space that it may take.
        solid: What of it is filled so far.
        depths: The surfaces of all objects, this one too.
        backdrop: What no object is. What is seen beyond the table may be anything.
    """
    columns: Mask = np.any(solid.filled, axis=-1)
    top = np.where(columns, solid.filled.shape[2] - 1 - solid.filled[..., ::-1].argmax(-1), -1)
    layers = np.arange(solid.filled.shape[2])
    above = carved.solid & (layers > top[..., None]) & columns[..., None]
    points = carved.points[above]
    seen, unexplained = np.zeros(len(points)), np.zeros(len(points))
    for frame in frames.distinct:
        explained = depths.covered(frame) | backdrop.beyond(frame.view)
        rows, cols, _, inside = frame.look(se3.apply(frame.standing[frames.name], points))
        seen += inside
        unexplained += inside & frame.foreground[rows, cols] & ~explained[rows, cols]
    raised = np.zeros(above.shape, bool)
    raised[above] = unexplained >= np.maximum(MIN_FILLED, FILLED_SHARE * seen)
    new_top = np.where(raised, layers, -1).max(-1)
    return replace(solid, filled=solid.filled | (above & (layers <= new_top[..., None])))


def carve_by_colour(frames: Frames, solid: Solid, depths: Depths) -> Solid:
    """Take out cells of the surface that pictures disagree about, until they agree about all."""
    for _ in range(SWEEPS):
        seen = colours_of(frames, solid, depths)
        gone = disagreement(np.stack([colours for _, colours in seen]), 0.0) > INCONSISTENT
        if gone.sum() < 1e-3 * len(gone):
            break
        filled = solid.filled.copy()
        filled[solid.surface] &= ~gone
        solid = replace(solid, filled=filled)
    return replace(solid, filled=_standing_pieces(solid.filled))


def _standing_pieces(filled: Mask) -> Mask:
    """The largest connected piece of some cells ``(n, n, m)``, and others that stand on the table.

    A thin part that joins them, as a knob to a stove, may be too thin for cells.
    """
    pieces, count = cast(Any, label)(filled)
    if count < 2:
        return filled
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    stands = np.zeros(count + 1, bool)
    stands[np.unique(pieces[..., 0])] = True
    kept = stands & (sizes >= PIECE_SHARE * sizes.max())
    kept[sizes.argmax()] = True
    return np.asarray(kept[pieces])


def colours_of(frames: Frames, solid: Solid, depths: Depths) -> list[tuple[Frame, Float32]]:
    """How each picture shows the points of a surface: CIELAB ``(k, 3)``, not a number where it does not.

    Args:
        frames: The frames in which the object stands.
        solid: The object.
        depths: The surfaces of the other objects, which may be before it.
    """
    points, normals, seen = solid.points, solid.normals, list[tuple[Frame, Float32]]()
    for frame in frames.distinct:
        T, view = frame.standing[frames.name], frame.view
        world = se3.apply(T, points)
        rows, columns, depth, inside = frame.look(world)
        facing = ((world - view.T_world_cam[:3, 3]) * (normals @ T[:3, :3].T)).sum(1) < 0
        shown = inside & facing & frame.foreground[rows, columns]
        nearest = np.minimum(depths.nearest(frame, besides=frames.name), solid.depth(frame, frames.name))
        shown &= depth <= nearest[rows, columns] + DEPTH_CELLS * solid.cell
        colours = sample(frame.colours, view.camera, view.T_world_cam, world, frame.hidden)
        colours[~shown] = np.nan
        seen.append((frame, colours))
    return seen
