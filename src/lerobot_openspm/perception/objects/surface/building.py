"""Building surfaces from pictures: what silhouettes leave of the space, with the colours that they show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import KDTree

from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.backdrop import Backdrop, Float32
from lerobot_openspm.perception.objects.surface.carving import Carved, Frame, Frames, carve
from lerobot_openspm.perception.objects.surface.relief import WEIGHTS, find_relief
from lerobot_openspm.perception.objects.surface.sight import Surface
from lerobot_openspm.perception.objects.surface.solid import (
    Depths,
    Solid,
    carve_by_colour,
    colours_of,
    fill_silhouettes,
    solid_under,
)

# A point is believed where so many directions show it, with colours this much alike, CIELAB.
MIN_DIRECTIONS, MAX_SPREAD = 2, 7.0
# How a camera shows a point that it never saw is told by the most similar point that both cameras saw.
SIMILAR_M, SIMILAR_COLOUR = 0.03, 10.0
# Points without believed colours are kept this near to such as have them, metres: they hide what is behind.
BESIDE_M = 0.02
# Silhouettes are filled in so many rounds, since one object's surface explains what is seen beside another.
ROUNDS = 2
# An object with fewer coloured points gets no surface.
MIN_COLOURED = 40


def build_surfaces(
    frames: Sequence[Frame], touched: Mapping[str, Array], heights: Mapping[str, float], backdrop: Backdrop
) -> dict[str, Surface]:
    """Surfaces of objects by name.

    Args:
        frames: All pictures.
        touched: Points ``(k, 3)`` in each object's frame at which it was touched.
        heights: World z of each object's frame.
        backdrop: What no object is.
    """
    own = {name: Frames(name, [f for f in frames if name in f.standing]) for name in touched}
    carved: dict[str, Carved] = {}
    solids: dict[str, Solid] = {}
    for name, points in touched.items():
        table = backdrop.table_height - heights[name]
        space = carve(own[name], points, table) if len(points) and own[name].frames else None
        if space is not None:
            carved[name], solids[name] = space, solid_under(find_relief(own[name], space), space)
    for _ in range(ROUNDS):
        depths = Depths(solids)
        solids = {
            name: fill_silhouettes(own[name].untouched, carved[name], solid, depths, backdrop)
            for name, solid in solids.items()
        }
    depths = Depths(solids)
    solids = {name: carve_by_colour(own[name], solid, depths) for name, solid in solids.items()}
    depths = Depths(solids)
    surfaces = {name: _coloured(own[name], solid, depths) for name, solid in solids.items()}
    return {name: one for name, one in surfaces.items() if len(one.coloured) >= MIN_COLOURED}


def _coloured(frames: Frames, solid: Solid, depths: Depths) -> Surface:
    """A solid's points with the colours that the pictures agree about."""
    points, normals = solid.points, solid.normals
    seen: dict[str, list[Float32]] = {"world": [], "ee": []}
    for frame, colours in colours_of(frames, solid, depths):
        seen[frame.view.camera.mount].append(colours)
    fixed, hand = (_middle(seen[mount], len(points)) for mount in ("world", "ee"))
    middle, spread, count = hand
    believed = (count >= MIN_DIRECTIONS) & (spread <= MAX_SPREAD)
    colours = np.stack([fixed[0], middle], 1)
    colours[~believed] = np.nan
    # What no two pictures agree about may be nothing at all, except right beside what they do agree about.
    near = believed.copy()
    if believed.any():
        near |= KDTree(points[believed]).query(points)[0] < BESIDE_M
    points, normals, colours = points[near], normals[near], colours[near]
    return Surface(points, normals, _completed(points, normals, colours), solid.cell)


def _middle(seen: Sequence[Float32], n: int) -> tuple[Array, Array, Array]:
    """Median colours ``(n, 3)``, median distance from them and number of views ``(n,)``."""
    if not seen:
        return np.full((n, 3), np.nan), np.full(n, np.inf), np.zeros(n, int)
    stack = np.ma.masked_invalid(np.stack(seen))
    middle = np.ma.median(stack, axis=0)
    away = np.ma.sqrt((((stack - middle) * WEIGHTS) ** 2).sum(-1))
    count = (~stack.mask[..., 0]).sum(0)
    return middle.filled(np.nan), np.ma.median(away, axis=0).filled(np.inf), count


def _completed(points: Array, normals: Array, colours: Array) -> Float32:
    """Colours ``(n, 2, 3)`` with those filled in that one of the cameras never saw."""
    done = colours.astype(np.float32)
    has = np.isfinite(colours[:, :, 0])
    both = np.flatnonzero(has.all(1))
    for known, missing in ((1, 0), (0, 1)):
        lacking = np.flatnonzero(has[:, known] & ~has[:, missing])
        if len(lacking) == 0:
            continue
        done[lacking, missing] = colours[lacking, known]
        if len(both):
            features = np.column_stack([points / SIMILAR_M, colours[:, known] / SIMILAR_COLOUR, normals])
            _, index = KDTree(features[both]).query(features[lacking])
            like = both[index]
            done[lacking, missing] += colours[like, missing] - colours[like, known]
    return done
