"""What no object is: the table's colours, a fixed camera's wall, and the hand in its own camera's picture.

A table is seen between the objects in most pictures, so its colour is the most frequent one where the hand's
camera looks. What a fixed camera sees beyond the table is taken from the pixels whose rays do not meet it.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry.camera import Camera, ray_directions
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import BELOW_CUES_M
from lerobot_openspm.types import Mask, View

Float32 = NDArray[np.float32]

# Colours are counted in bins of this size, CIELAB.
BIN = np.array([4.0, 3.0, 3.0])
# A colour begins with what lies this near to the fullest bin ...
NEAR = 12.0
# ... or near to the next full one, if it is so many times as much,
MANY_MORE = 1.5
# ... and takes in what has this squared Mahalanobis distance at most; in a picture, a little more.
LEARNED, SEEN = 12.0, 16.0
# What covers this share of the pixels beyond the table is a wall.
WALL_SHARE = 0.3
# A pixel of the hand's camera that varies by less than this, in levels of 255, shows the hand.
STILL_LEVELS = 6.0
# The table reaches this far beyond where the hand went, metres.
TABLE_MARGIN_M = 0.25
# ... and objects stand with their middle this near to where it went.
REACH_M = 0.10
# The table's height is sought in such steps, metres, in so many pictures, where so many of them show a place;
# at most so far below the floor that touches tell, metres.
HEIGHT_STEP_M, MAX_TABLE_VIEWS, MIN_TABLE_VIEWS = 0.005, 80, 5
MOST_BELOW_M = 0.15
# ... and told if pictures differ there by less than this share of what they usually do, and by so much less,
# CIELAB.
DISTINCT_SHARE, DISTINCT = 0.95, 0.02


def lab(image: NDArray[np.uint8]) -> Float32:
    """CIELAB ``(H, W, 3)`` of an RGB image, L from 0 to 100."""
    return np.asarray(cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), np.float32)


@dataclass(frozen=True)
class Colour:
    """A normal distribution of one colour, CIELAB: mean ``(3,)`` and inverse covariance ``(3, 3)``."""

    mean: Array
    precision: Array

    def matches(self, colours: Float32) -> Mask:
        """Which of the colours ``(..., 3)`` are this one."""
        return self.distance(colours) < SEEN

    def distance(self, colours: Float32) -> Float32:
        """Squared Mahalanobis distance ``(...)`` of colours ``(..., 3)``."""
        off = colours - self.mean.astype(np.float32)
        return ((off @ self.precision.astype(np.float32)) * off).sum(-1)


def frequent_colour(colours: Float32) -> tuple[Colour, Mask]:
    """The most frequent of colours ``(n, 3)``, and which of them are it ``(n,)``.

    What has one colour all over fills a bin more than wood does that covers more of the pictures. So the next
    full bin is taken instead of the fullest where many more colours are near to that.
    """
    first = _near_fullest(colours, np.ones(len(colours), bool))
    second = _near_fullest(colours, ~first)
    own = second if second.sum() > MANY_MORE * first.sum() else first
    colour = Colour(np.zeros(3), np.eye(3))
    for _ in range(6):
        colour = Colour(
            colours[own].mean(0).astype(float),
            np.asarray(np.linalg.inv(np.cov(colours[own].T) + 0.5 * np.eye(3)), float),
        )
        own = colour.distance(colours) < LEARNED
    return colour, own


def _near_fullest(colours: Float32, left: Mask) -> Mask:
    """Which colours ``(n,)`` are near to the bin that most of those that are left fill; none if none is."""
    if not left.any():
        return left
    bins, index = np.unique(np.round(colours[left] / BIN).astype(int), axis=0, return_inverse=True)
    fullest = bins[np.bincount(index.ravel()).argmax()] * BIN
    return np.asarray(np.linalg.norm(colours - fullest, axis=1) < NEAR)


@dataclass(frozen=True)
class Backdrop:
    """What is not an object.

    Attributes:
        table: The table's colour.
        table_height: World z of the table, metres.
        table_area: Least and largest x and y of it ``(2, 2)``, metres.
        walls: Colours beyond the table, by fixed camera.
        hand: Pixels ``(H, W)`` that show the hand, by camera that the hand carries.
    """

    table: Colour
    table_height: float
    table_area: Array
    walls: Mapping[str, tuple[Colour, ...]] = field(default_factory=dict[str, tuple[Colour, ...]])
    hand: Mapping[str, Mask] = field(default_factory=dict[str, Mask])

    @cached_property
    def key(self) -> Hashable:
        """Equal for backdrops with which a view is prepared alike, wherever they were read from."""
        hand = tuple((camera, mask.tobytes()) for camera, mask in self.hand.items())
        return self.table.mean.tobytes(), self.table.precision.tobytes(), hand

    @property
    def reach(self) -> Array:
        """Least and largest x and y ``(2, 2)`` of where the hand can do something, metres."""
        margin = TABLE_MARGIN_M - REACH_M
        return self.table_area + np.array([[margin], [-margin]])

    def foreground(self, camera: str, view: View) -> Mask:
        """Pixels ``(H, W)`` that show neither the table nor a wall; single pixels of either do not count."""
        colours = lab(view.image)
        behind = self.table.matches(colours)
        if walls := self.walls.get(camera):
            beyond = self.beyond(view)
            for wall in walls:
                behind |= beyond & wall.matches(colours)
        opened = cv2.morphologyEx(behind.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        return opened == 0

    def hidden(self, camera: str, view: View) -> Mask | None:
        """Pixels ``(H, W)`` in which a camera of the hand shows the hand, at a view's size."""
        if camera not in self.hand:
            return None
        mask = self.hand[camera].astype(np.uint8)
        return cv2.resize(
            mask, (view.camera.width, view.camera.height), interpolation=cv2.INTER_NEAREST
        ).astype(bool)

    def beyond(self, view: View) -> Mask:
        """Pixels ``(H, W)`` whose rays do not meet the table."""
        height, width = view.image.shape[:2]
        v, u = np.mgrid[:height, :width]
        rays, origin = (
            ray_directions(view.camera, view.T_world_cam, np.stack([u, v], -1)),
            view.T_world_cam[:3, 3],
        )
        down = rays[..., 2] < -1e-6
        along = np.where(down, (self.table_height - origin[2]) / np.where(down, rays[..., 2], -1.0), np.inf)
        with np.errstate(invalid="ignore"):
            place = origin[:2] + along[..., None] * rays[..., :2]
        low, high = self.table_area
        return ~(down & (place > low).all(-1) & (place < high).all(-1))


def learn_backdrop(films: Mapping[str, Sequence[View]], floor: float) -> Backdrop | None:
    """Learn what is no object from all pictures of each camera.

    Args:
        films: By camera, pictures of many moments.
        floor: World z, metres, below which the table does not lie.

    Returns:
        None where no camera of the hand sees a table.
    """
    carried = {key: views for key, views in films.items() if views and views[0].camera.mount == "ee"}
    if not carried:
        return None
    hand = {key: _hand_pixels(views) for key, views in carried.items()}
    pixels = [lab(view.image)[~hand[key]][::23] for key, views in carried.items() for view in views[::3]]
    table, _ = frequent_colour(np.concatenate(pixels))
    spots = np.concatenate([np.stack([_hand_place(view) for view in views]) for views in carried.values()])
    area = np.stack([spots.min(0) - TABLE_MARGIN_M, spots.max(0) + TABLE_MARGIN_M])
    height = _table_height(carried, hand, table, area, floor)
    known = Backdrop(table, height, area)
    walls = {
        key: _walls(known, views)
        for key, views in films.items()
        if views and views[0].camera.mount == "world"
    }
    return Backdrop(table, height, area, walls, hand)


def _hand_place(view: View) -> Array:
    """Where ``(2,)`` the hand that carries a camera is."""
    return (view.T_world_cam @ np.linalg.inv(view.camera.T_mount_cam))[:2, 3]


def _hand_pixels(views: Sequence[View]) -> Mask:
    """Pixels ``(H, W)`` that look alike in most pictures of a camera that moves, and not like the table."""
    images = np.stack([view.image for view in views[:: max(1, len(views) // 120)]])
    middle = np.median(images, axis=0).astype(np.uint8)
    change = np.median(np.abs(images.astype(np.int16) - middle).max(-1), axis=0)
    # The hand never changes; of what changes most, most is table.
    passing = change >= np.percentile(change, 75)
    table, _ = frequent_colour(np.concatenate([lab(image)[passing][::7] for image in images]))
    still = ((change < STILL_LEVELS) & ~table.matches(lab(middle))).astype(np.uint8)
    for how in (cv2.MORPH_CLOSE, cv2.MORPH_OPEN):
        still = cv2.morphologyEx(still, how, np.ones((5, 5), np.uint8)).astype(np.uint8)
    return cv2.dilate(still, np.ones((7, 7), np.uint8)).astype(bool)


def _walls(known: Backdrop, views: Sequence[View]) -> tuple[Colour, ...]:
    colours = np.concatenate([lab(view.image)[known.beyond(view)][::7] for view in views])
    found, n = [], len(colours)
    while len(colours) > max(100, WALL_SHARE * n):
        colour, own = frequent_colour(colours)
        if own.sum() < WALL_SHARE * n:
            break
        found.append(colour)
        colours = colours[~own]
    return tuple(found)


def _table_height(
    carried: Mapping[str, Sequence[View]],
    hand: Mapping[str, Mask],
    table: Colour,
    area: Array,
    floor: float,
) -> float:
    """The height at which pictures from many places agree best about the grain of a plane.

    Only what has the table's colour counts: what stands on it agrees at other heights. It is sought about the
    floor that touches tell, and where it is not there, further below: all that was touched may be tall. A
    table without any grain does not tell its height; it is taken to lie a little below that floor.
    """
    grid = np.stack(
        np.meshgrid(*(np.arange(low, high, 0.008) for low, high in area.T), indexing="ij"), -1
    ).reshape(-1, 2)
    views = [(key, view) for key, group in carried.items() for view in distinct(group)[:MAX_TABLE_VIEWS]]
    pictures = [lab(view.image) for _, view in views]
    others = [hand[key] | ~table.matches(picture) for (key, _), picture in zip(views, pictures, strict=True)]

    def spread_at(height: float) -> float:
        plane = np.asarray(np.column_stack([grid, np.full(len(grid), height)]), float)
        seen = [
            sample(picture, view.camera, view.T_world_cam, plane, other)
            for (_, view), picture, other in zip(views, pictures, others, strict=True)
        ]
        stack = np.ma.masked_invalid(np.stack(seen))
        spread = np.ma.median(np.ma.abs(stack - np.ma.median(stack, axis=0)).sum(-1), axis=0)
        enough = (~stack.mask[..., 0]).sum(0) >= MIN_TABLE_VIEWS
        # The mean, because a coarse pattern differs at its edges alone.
        return float(np.ma.mean(spread[enough])) if enough.any() else np.inf

    for low, high in ((-BELOW_CUES_M, BELOW_CUES_M), (-MOST_BELOW_M, 0.0)):
        steps = np.arange(round(low / HEIGHT_STEP_M), round(high / HEIGHT_STEP_M) + 1)
        heights = floor + HEIGHT_STEP_M * steps.astype(float)
        found = _least(heights, np.array([spread_at(height) for height in heights]))
        if found is not None:
            return found
    return floor - 2 * HEIGHT_STEP_M


def _least(heights: Array, spreads: Array) -> float | None:
    """Where a parabola through the least spread and its neighbours has its vertex.

    None where the least one lies at an end, or hardly below the usual spread.
    """
    i = int(np.argmin(spreads))
    around = spreads[i - 1 : i + 2] if 0 < i < len(heights) - 1 else np.full(3, np.inf)
    usual = float(np.median(spreads))
    if not (np.isfinite(around).all() and around[1] < min(DISTINCT_SHARE * usual, usual - DISTINCT)):
        return None
    bend = around[0] - 2 * around[1] + around[2]
    return float(heights[i] + HEIGHT_STEP_M * 0.5 * (around[0] - around[2]) / bend)


def distinct(views: Sequence[View], metres: float = 0.05, radians: float = 0.25) -> list[View]:
    """One view of each place and direction that a camera looked from."""
    return [views[i] for i in representatives([view.T_world_cam for view in views], metres, radians)[1]]


def representatives(
    poses: Sequence[Array], metres: float = 0.05, radians: float = 0.25
) -> tuple[NDArray[np.int64], list[int]]:
    """Group camera poses ``(4, 4)`` that are alike: the group of each, and one member of each group."""
    centres: list[Array] = []
    firsts: list[int] = []
    groups = np.zeros(len(poses), np.int64)
    for i, T in enumerate(poses):
        for number, other in enumerate(centres):
            near = np.linalg.norm(T[:3, 3] - other[:3, 3]) < metres
            if near and np.trace(other[:3, :3].T @ T[:3, :3]) > 1 + 2 * np.cos(radians):
                groups[i] = number
                break
        else:
            groups[i] = len(centres)
            centres.append(T)
            firsts.append(i)
    return groups, firsts


def sample(
    field_: Float32, camera: Camera, T_world_cam: Array, points_world: Array, hidden: Mask | None
) -> Float32:
    """Bilinear colours ``(n, 3)`` of world points in a picture; not a number where it does not show them."""
    u, v, _, inside = pixels_of(camera, T_world_cam, points_world)
    if hidden is not None:
        inside = inside & ~hidden[np.rint(v).astype(int), np.rint(u).astype(int)]
    colours = np.empty((len(u), 3), np.float32)
    for start in range(0, len(u), 30000):  # remap's tables are 16-bit
        part = slice(start, start + 30000)
        colours[part] = cv2.remap(field_, u[part, None], v[part, None], cv2.INTER_LINEAR)[:, 0]
    colours[~inside] = np.nan
    return colours


def pixels_of(
    camera: Camera, T_world_cam: Array, points_world: Array
) -> tuple[Float32, Float32, Float32, Mask]:
    """Pixel coordinates, depths and whether a picture reaches there, of world points ``(..., 3)``.

    Coordinates of points outside the picture are 0.
    """
    p = (points_world - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    depth = p[..., 2]
    ahead = np.where(depth > 0.03, depth, np.inf)
    u, v = camera.fx * p[..., 0] / ahead + camera.cx, camera.fy * p[..., 1] / ahead + camera.cy
    inside = (depth > 0.03) & (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
    return (
        np.where(inside, u, 0).astype(np.float32), np.where(inside, v, 0).astype(np.float32),
        depth.astype(np.float32), inside,
    )  # fmt: skip
