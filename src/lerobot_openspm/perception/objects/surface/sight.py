"""What is compared: the surface of an object, and a view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import KDTree

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.backdrop import Backdrop, Float32, lab
from lerobot_openspm.perception.objects.surface.relief import WEIGHTS
from lerobot_openspm.types import Mask, Symmetry, View

# Pictures are smoothed by a Gaussian of so many pixels at least, if they are 256 wide.
FINEST = 0.6
# Turned about its middle, an object has the same shape if this share of its points comes this near to others,
# and its outline as seen from above stays where it was, up to as much or to this share of the radius.
SAME_SHAPE_SHARE, SAME_SHAPE_SPACINGS, SAME_OUTLINE_SHARE = 0.78, 2.0, 0.15
OUTLINE_STEP_DEG = 10
# It looks the same too if this share of them comes near to such as have colours like theirs, CIELAB.
ROUND_SHARE, ROUND_SPACINGS, ROUND_COLOUR = 0.52, 3.0, 20.0
# An object with this radius and this height is large, metres.
LARGE_M = 0.10
# Colours this far apart, CIELAB, are alike in the search over the table.
LIKE_COARSE = 12.0


@dataclass(frozen=True)
class Surface:
    """Coloured points of an object, all in its own frame.

    Attributes:
        points: ``(n, 3)``, metres.
        normals: Outward directions ``(n, 3)``.
        colours: CIELAB ``(n, 2, 3)`` as the fixed and as the hand's camera show it; the colours in between
            are expected too. Not a number for points that only hide what is behind them.
        spacing: Distance between points, metres.
        pattern: From 0 to 1: how much the variation of its colours tells of it.
    """

    points: Array
    normals: Array
    colours: Float32
    spacing: float
    pattern: float = 1.0

    @cached_property
    def has_colour(self) -> Mask:
        """Which of the points have colours ``(n,)``."""
        return np.isfinite(self.colours[:, 0, 0])

    @cached_property
    def coloured(self) -> Array:
        """The points ``(n, 3)`` that have colours."""
        return self.points[self.has_colour]

    @cached_property
    def weighted(self) -> Float32:
        """Its colours ``(n, 2, 3)`` as they are compared."""
        return self.colours * WEIGHTS

    @cached_property
    def middle(self) -> Array:
        """Horizontal middle ``(2,)`` of the coloured points."""
        return _middle(self.coloured)

    def middle_at(self, pose: Array) -> Array:
        """Where its horizontal middle is ``(2,)`` at a pose (x, y, z, yaw)."""
        return se3.apply(se3.from_yaw(pose[:3], float(pose[3])), np.array([[*self.middle, 0.0]]))[0, :2]

    @cached_property
    def palette(self) -> Float32:
        """Weighted CIELAB ``(k, 3)`` of its colours, one for each that is :data:`LIKE_COARSE` from others."""
        seen = self.weighted[self.has_colour].reshape(-1, 3)
        return np.unique(np.rint(seen / LIKE_COARSE), axis=0).astype(np.float32) * np.float32(LIKE_COARSE)

    @cached_property
    def radius(self) -> float:
        """Horizontal distance from the middle within which most coloured points are, metres."""
        return float(np.percentile(np.linalg.norm(self.coloured[:, :2] - self.middle, axis=1), 90))

    @cached_property
    def is_large(self) -> bool:
        """Whether it is wide and tall: a camera sees only a part of it, and another part from elsewhere."""
        low, high = np.percentile(self.coloured[:, 2], (5, 95))
        return min(self.radius, float(high - low)) >= LARGE_M

    @cached_property
    def symmetry(self) -> Symmetry | None:
        """How its shape turns into itself, whatever its colours do; None if it does not."""
        for turn, others in ((0.0, (60, 90, 150, 180)), (np.pi / 2, (90, 180)), (np.pi, (180,))):
            shares, middles = zip(*(self._turned(degrees) for degrees in others), strict=True)
            if min(shares) > SAME_SHAPE_SHARE:
                return Symmetry(np.mean(middles, axis=0), turn)
        return None

    def _turned(self, degrees: int) -> tuple[float, Array]:
        """The share of the points that come near to others if turned, and about which middle ``(2,)``."""
        points, at, share = self.points, np.append(_middle(self.points), 0.0), 0.0
        R = se3.from_yaw(np.zeros(3), float(np.deg2rad(degrees)))[:3, :3]
        tree, near = KDTree(points), SAME_SHAPE_SPACINGS * self.spacing
        for _ in range(3):
            turned = (points - at) @ R.T + at
            away, index = tree.query(turned)
            share = float((away < near).mean())
            # The middle that leaves the least distance between them.
            shift = np.mean(points[index] - turned, axis=0)[:2]
            at = at + np.append(np.linalg.solve(np.eye(2) - R[:2, :2], shift), 0.0)
        return share if self._has_same_outline(at[:2], degrees) else 0.0, at[:2]

    def _has_same_outline(self, middle: Array, degrees: int) -> bool:
        """Whether its convex outline from above, turned about a middle ``(2,)``, is the same."""
        angles = np.deg2rad(np.arange(0, 360, OUTLINE_STEP_DEG))
        along = (self.points[:, :2] - middle) @ np.stack([np.cos(angles), np.sin(angles)])
        reach = np.percentile(along, 99.5, axis=0)
        off = float(np.abs(np.roll(reach, degrees // OUTLINE_STEP_DEG) - reach).max())
        return off < max(SAME_SHAPE_SPACINGS * self.spacing, SAME_OUTLINE_SHARE * self.radius)

    @cached_property
    def is_round(self) -> bool:
        """Whether it looks alike from all sides, so that its direction cannot be seen."""
        if self.symmetry is None or self.symmetry.turn > 0:
            return False
        has = np.isfinite(self.colours[:, 1, 0])
        points, colours = self.points[has], self.colours[has, 1]
        middle = np.append((points[:, :2].min(0) + points[:, :2].max(0)) / 2, 0.0)
        tree, shares = KDTree(points - middle), []
        for turn in np.deg2rad([60, 120, 180, 240, 300]):
            R = se3.from_yaw(np.zeros(3), float(turn))[:3, :3]
            away, index = tree.query((points - middle) @ R.T)
            alike = np.linalg.norm(colours - colours[index], axis=1) < ROUND_COLOUR
            shares.append(float((alike & (away < ROUND_SPACINGS * self.spacing)).mean()))
        return min(shares) > ROUND_SHARE


def _middle(points: Array) -> Array:
    """Horizontal middle ``(2,)`` of points ``(n, 3)``, whatever a few of them do."""
    low, high = np.percentile(points[:, :2], (5, 95), axis=0)
    return np.asarray((low + high) / 2, float)


@dataclass(frozen=True)
class Sight:
    """One view, prepared for comparing.

    Attributes:
        view: The view.
        P: Projection ``(3, 4)`` of world points to homogeneous pixels.
        colours: Weighted CIELAB ``(H, W, 3)``.
        table: Where the table is ``(H, W)``, 1 or 0.
        hidden: Pixels ``(H, W)`` that are no evidence.
    """

    view: View
    P: Float32
    colours: Float32
    table: Float32
    hidden: Mask
    _smoothed: dict[int, tuple[Float32, Float32]] = field(default_factory=dict[int, tuple[Float32, Float32]])

    def smoothed(self, octave: int) -> tuple[Float32, Float32]:
        """Colours and table, smoothed over about ``2 ** octave`` pixels of a picture 256 wide; made once."""
        if octave not in self._smoothed:
            sigma = FINEST * 2.0**octave * self.view.camera.width / 256
            self._smoothed[octave] = (
                np.asarray(cv2.GaussianBlur(self.colours, (0, 0), sigma), np.float32),
                np.asarray(cv2.GaussianBlur(self.table, (0, 0), 1.3 * sigma), np.float32),
            )
        return self._smoothed[octave]


def sight_of(view: View, camera: str, backdrop: Backdrop, hidden: Mask | None) -> Sight:
    """Prepare a view."""
    colours = lab(view.image)
    table = cv2.morphologyEx(
        backdrop.table.matches(colours).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
    ).astype(np.float32)
    covered = np.zeros(table.shape, bool) if hidden is None else hidden.copy()
    own = backdrop.hidden(camera, view)
    if own is not None:
        covered |= own
    T_cam_world = np.linalg.inv(view.T_world_cam)[:3]
    c = view.camera
    K = np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]])
    return Sight(view, (K @ T_cam_world).astype(np.float32), colours * WEIGHTS, table, covered)


def sights_of(views: Mapping[str, View], backdrop: Backdrop) -> dict[str, Sight]:
    """Prepare views by camera of which nothing is hidden but what the hand hides in its own."""
    return {camera: sight_of(view, camera, backdrop, None) for camera, view in views.items()}
