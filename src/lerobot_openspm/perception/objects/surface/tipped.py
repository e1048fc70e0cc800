"""Whether an object that stands nowhere as it should lies on its side, or upside down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.search import Freedom, over_table, search
from lerobot_openspm.perception.objects.surface.sight import Sight, Surface

# Onto which sides an object tips: turned by so many degrees about its x and y axes. What is round tips to all
# sides alike.
ROUND_TURNS = ((90, 0), (-90, 0), (180, 0))
TURNS = (*ROUND_TURNS, (0, 90), (0, -90))


def lying(surface: Surface) -> list[Surface]:
    """The surface on each of its other sides, its lowest coloured points on z = 0."""
    sides: list[Surface] = []
    for turn in ROUND_TURNS if surface.is_round else TURNS:
        R = Rotation.from_euler("xy", turn, degrees=True).as_matrix()
        low = (surface.coloured @ R.T)[:, 2].min() - surface.spacing / 2
        points = surface.points @ R.T - np.array([0.0, 0.0, low])
        sides.append(replace(surface, points=points, normals=surface.normals @ R.T))
    return sides


def has_tipped(
    sides: Sequence[Surface],
    sights: Mapping[str, Sight],
    area: Array,
    table_height: float,
    yaws: Sequence[float],
    needed: float,
) -> bool:
    """Whether the views agree with an object on one of its other sides.

    Args:
        sides: The object on them, see :func:`lying`.
        sights: The views.
        area: Least and largest x and y ``(2, 2)`` of where it is sought, metres.
        table_height: World z of what it lies on, metres.
        yaws: Directions to begin from, radians.
        needed: The agreement from which on it is taken to lie there.
    """
    for side in sides:
        ground = over_table(side, area, table_height)
        if search(side, sights, ground, yaws, Freedom(turns=True))[0].score >= needed:
            return True
    return False
