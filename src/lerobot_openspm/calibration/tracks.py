"""Following image features through an episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry.se3 import Array

# Images are enlarged or reduced to this height, within a limit: windows and thresholds below are in pixels of
# that. Corners of what is enlarged further are too round to be found.
WORKING_HEIGHT, MAX_ENLARGEMENT = 512, 2.0
WINDOW_PX = 15
CORNER_HALF_WINDOW_PX = 5
CORNER_SHIFT_PX = 3.0
FORWARD_BACKWARD_PX = 0.6
BORDER_PX = 6.0
SPACING_PX = 8
QUALITY = 0.02
MAX_CORNERS = 300
# New features are looked for every so many frames; "moving" is what changed within so many frames.
SEARCH_STEPS, CHANGE_STEPS = 2, 3
CHANGE_LEVELS = 12
MIN_FRAMES = 6


@dataclass(frozen=True)
class Track:
    """One feature followed through consecutive frames of an episode.

    Attributes:
        episode: Which of the given episodes, counted from 0.
        start: First frame.
        uv: Pixel coordinates ``(n, 2)`` in the frames ``start, start + 1, ...``
    """

    episode: int
    start: int
    uv: Array


def track_features(images: NDArray[Any], episode: int, *, moving_only: bool) -> list[Track]:
    """Follow corners by Lucas-Kanade flow, and put each back on its corner in every frame.

    Flow alone drifts, and takes a point beside a corner for the corner: when the hand has turned, that point
    is on another side of it. What flow cannot follow there and back, or what stops being a corner, ends.

    Args:
        images: RGB images ``(n, height, width, 3)``, uint8.
        episode: Number to give to the tracks.
        moving_only: Begin tracks only where the image changes, as for a camera that stands still.
    """
    scale = min(WORKING_HEIGHT / images.shape[1], MAX_ENLARGEMENT)
    grey = [_working_image(image, scale) for image in images]
    finished: list[tuple[int, list[NDArray[Any]]]] = []
    active: list[tuple[int, list[NDArray[Any]]]] = []
    for frame in range(len(grey) - 1):
        if frame % SEARCH_STEPS == 0:
            changed = _changed(grey, frame) if moving_only else np.full(grey[frame].shape, 255, np.uint8)
            active += [(frame, [uv]) for uv in _new_corners(grey[frame], changed, [a[1][-1] for a in active])]
        if not active:
            continue
        following, kept = _follow(grey[frame], grey[frame + 1], np.array([a[1][-1] for a in active]))
        finished += [track for track, ok in zip(active, kept, strict=True) if not ok]
        for (_, path), uv, ok in zip(active, following, kept, strict=True):
            if ok:
                path.append(uv)
        active = [track for track, ok in zip(active, kept, strict=True) if ok]
    # Pixel centres are integers, so half a pixel is added before scaling and removed after.
    return [
        Track(episode, start, (np.array(path, float) + 0.5) / scale - 0.5)
        for start, path in finished + active
        if len(path) >= MIN_FRAMES
    ]


def _working_image(image: NDArray[Any], scale: float) -> NDArray[Any]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    how = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=how)


def _changed(grey: Sequence[NDArray[Any]], frame: int) -> NDArray[Any]:
    """Mask of what differs from the frames a little before and after."""
    others = [t for t in (frame - CHANGE_STEPS, frame + CHANGE_STEPS) if 0 <= t < len(grey)]
    change = np.max([cv2.absdiff(grey[frame], grey[t]) for t in others], axis=0) if others else grey[0] * 0
    mask = np.where(change > CHANGE_LEVELS, 255, 0).astype(np.uint8)
    return cv2.dilate(mask, np.ones((10, 10), np.uint8))


def _new_corners(grey: NDArray[Any], mask: NDArray[Any], taken: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Corners ``(n, 2)`` within a mask, away from those that are followed already."""
    mask = mask.copy()
    for u, v in taken:
        cv2.circle(mask, (int(u), int(v)), SPACING_PX, 0, -1)
    corners = cv2.goodFeaturesToTrack(grey, MAX_CORNERS, QUALITY, SPACING_PX, mask=mask, blockSize=5)
    if corners is None:  # pyright: ignore[reportUnnecessaryComparison]
        return np.zeros((0, 2), np.float32)
    corners = corners.reshape(-1, 2)
    on_corner, shift = _refined(grey, corners)
    return on_corner[shift < CORNER_SHIFT_PX]


def _refined(grey: NDArray[Any], uv: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The corners next to points ``(n, 2)``, and how far they lie from them."""
    inside = np.clip(uv, 1, np.array(grey.shape[::-1], np.float32) - 2).astype(np.float32)
    half, stop = (CORNER_HALF_WINDOW_PX,) * 2, (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 0.01)
    refined = cv2.cornerSubPix(grey, inside[:, None].copy(), half, (-1, -1), stop)[:, 0]
    return refined, np.linalg.norm(refined - uv, axis=1)


def _follow(before: NDArray[Any], after: NDArray[Any], uv: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Where points ``(n, 2)`` went, and which of them can be believed."""
    points, window = uv.astype(np.float32)[:, None], (WINDOW_PX, WINDOW_PX)
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, points, points.copy(), winSize=window)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, there.copy(), winSize=window)
    returned = np.linalg.norm(back[:, 0] - uv, axis=1) < FORWARD_BACKWARD_PX
    refined, shift = _refined(after, there[:, 0])
    height, width = after.shape
    inside = (refined > BORDER_PX).all(1) & (refined < np.array([width, height]) - BORDER_PX).all(1)
    kept = (found[:, 0] == 1) & (found_back[:, 0] == 1) & returned & inside & (shift < CORNER_SHIFT_PX)
    return refined, kept
