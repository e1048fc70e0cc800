"""What is known of how objects look that decides how one takes the place of another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import Symmetry

# The rim of a round thing is what of it is this near to its greatest radius, metres.
RIM_M = 0.01


@dataclass(frozen=True)
class Rim:
    """The rim of a round thing: its radius, metres, and its middle ``(4, 4)`` in the thing's frame."""

    radius: float
    T_obj_rim: Array


@dataclass(frozen=True)
class Looks:
    """Shapes of objects.

    Attributes:
        points: Points ``(n, 3)`` of each object's surface in its frame, where its shape is known.
        symmetries: How objects turn into themselves, of those that do.
    """

    points: Mapping[str, Array] = field(default_factory=dict[str, Array])
    symmetries: Mapping[str, Symmetry] = field(default_factory=dict[str, Symmetry])

    def underside(self, name: str) -> Array:
        """The middle ``(3,)`` of what an object stands on, in its frame, metres.

        Its frame's origin as far as nothing is known.
        """
        points, symmetry = self.points.get(name), self.symmetries.get(name)
        middle, height = np.zeros(2), 0.0
        if points is not None and len(points):
            low, high = np.percentile(points[:, :2], (5, 95), axis=0)
            middle, height = (low + high) / 2, float(np.percentile(points[:, 2], 1))
        if symmetry is not None:
            middle = np.asarray(symmetry.middle)
        return np.array([*middle, height])

    def rim(self, name: str) -> Rim | None:
        """The rim of a round object whose shape is known; None of others."""
        points, symmetry = self.points.get(name), self.symmetries.get(name)
        if points is None or not len(points) or symmetry is None or symmetry.turn > 0:
            return None
        out = np.linalg.norm(points[:, :2] - symmetry.middle, axis=1)
        radius = float(np.percentile(out, 98))
        height = float(np.percentile(points[out > radius - RIM_M, 2], 90))
        return Rim(radius, se3.from_yaw(np.array([*symmetry.middle, height]), 0.0))


UNKNOWN_LOOKS = Looks()
