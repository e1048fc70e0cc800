"""Small patches of images: cutting them out, and finding them again in another image.

Where an object stays within a few centimetres and keeps its direction, the pixels around it look alike in all
first frames, whatever its colours and its surroundings. A patch around the place that the hand touched is
sought near there in a new image, and its displacement in pixels is one in the world, on the object's plane.
Which patches to use is learned (:mod:`lerobot_openspm.perception.objects.patches.learn`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera, project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import Mask, View

Picture = NDArray[np.uint8]

# How far from each patch's own place an object is sought.
REACH_M = 0.035
MIN_PATCH_PX = 7
# A patch with less contrast than this, in CIELAB levels, is found everywhere.
MIN_CONTRAST = 4.0
# Variance per pixel, CIELAB levels squared, below which pixels are all alike but for rounding.
MIN_SPREAD = 1e-3
# A hand camera sees the patch as in the demonstrations only from the same place.
MAX_CAMERA_SHIFT_M, MAX_CAMERA_TURN_RAD = 0.02, 0.10
# A patch of which more is hidden is not looked for.
MAX_HIDDEN_SHARE = 0.2


@dataclass(frozen=True)
class Patch:
    """A piece of a demonstration's first frame.

    Attributes:
        image: CIELAB pixels ``(h, w, 3)``, uint8.
        corner: Pixel ``(2,)`` of its upper left corner, horizontal first.
        point_world: The object's reference point ``(3,)`` in that frame.
    """

    image: Picture
    corner: Array
    point_world: Array


@dataclass(frozen=True)
class Probe:
    """Patches of one camera and size.

    Attributes:
        camera: Name of the camera.
        calibration: The camera as the patches were seen with it.
        T_world_cam: Its pose ``(4, 4)`` then.
        patches: One per reference demonstration.
        std_m: Spread of its estimates against the other probes', metres.
    """

    camera: str
    calibration: Camera
    T_world_cam: Array
    patches: tuple[Patch, ...]
    std_m: float


@dataclass(frozen=True)
class Sight:
    """One patch's answer for one view: a point ``(3,)`` and the correlation behind it."""

    point_world: Array
    correlation: float


def cut(view: View, point_world: Array, radius: float) -> Patch | None:
    """The pixels within ``radius`` metres of a point; None where hardly any are in the image."""
    uv, depth = project(view.camera, view.T_world_cam, point_world)
    if not np.isfinite(uv).all():
        return None
    half = view.camera.focal_px * radius / depth
    low = np.maximum(np.round(uv - half), 0).astype(int)
    high = np.minimum(np.round(uv + half) + 1, [view.camera.width, view.camera.height]).astype(int)
    if (high - low).min() < max(MIN_PATCH_PX, half):
        return None
    image = _lab(view.image[low[1] : high[1], low[0] : high[0]])
    if image.reshape(-1, 3).std(axis=0).max() < MIN_CONTRAST:
        return None
    return Patch(image, low.astype(float), point_world)


def match(patch: Patch, probe: Probe, view: View) -> Sight | None:
    """Find a patch near its old place in another view of the same camera; None at the image's border.

    A hand camera may have been a little elsewhere then: the patch is expected where its point is seen now.

    Args:
        patch: What to find.
        probe: Tells the camera that the patch was seen with, and its pose.
        view: Of the same camera, at the same size (:func:`as_seen`).
    """
    camera = probe.calibration
    uv_then, _ = project(camera, probe.T_world_cam, patch.point_world)
    uv, depth = project(camera, view.T_world_cam, patch.point_world)
    if not np.isfinite([*uv_then, *uv]).all():
        return None
    expected = patch.corner + uv - uv_then
    reach = int(np.ceil(camera.focal_px * REACH_M / depth))
    height, width = patch.image.shape[:2]
    x, y = np.round(expected).astype(int)
    low = np.maximum([x - reach, y - reach], 0)
    high = np.clip([x + width + reach, y + height + reach], 0, [camera.width, camera.height])
    window = view.image[low[1] : high[1], low[0] : high[0]]
    if window.shape[0] < height or window.shape[1] < width:
        return None
    scores = correlations(_lab(window), patch.image)
    _, correlation, _, (u, v) = cv2.minMaxLoc(scores)
    shift = np.add(low, [u + _vertex(scores[v], u), v + _vertex(scores[:, u], v)]) - expected
    # How the projection moves as the point does, on its horizontal plane.
    moved, _ = project(camera, view.T_world_cam, patch.point_world + np.eye(3)[:2] * 1e-3)
    return Sight(
        patch.point_world + np.append(np.linalg.solve((moved - uv).T / 1e-3, shift), 0.0), float(correlation)
    )


def correlations(window: Picture, patch: Picture) -> NDArray[np.float32]:
    """Normalised correlation of a patch ``(h, w, 3)`` with each place of a window ``(H, W, 3)``.

    OpenCV's TM_CCOEFF_NORMED; on three channels that takes five to ten times as long.

    Returns:
        Correlations ``(H - h + 1, W - w + 1)``, all channels together; 0 where either has no contrast.
    """
    height, width = patch.shape[:2]
    rows, columns = window.shape[0] - height + 1, window.shape[1] - width + 1
    size = [next_fast_len(n, real=True) or n for n in window.shape[:2]]
    centred = patch - patch.mean((0, 1), dtype=np.float32)
    spectrum = np.fft.rfft2(window - window.mean((0, 1), dtype=np.float32), size, (0, 1))
    own = np.fft.rfft2(centred, size, (0, 1)).conj()
    covariance = np.fft.irfft2((spectrum * own).sum(-1), size)[:rows, :columns]
    sums, squares = (_boxes(table, height, width) for table in cv2.integral2(window))
    spread = (squares - sums**2 / (height * width)).sum(-1) * float((centred**2).sum())
    scale = np.sqrt(np.maximum(spread, 0.0))
    has_contrast = scale > MIN_SPREAD * height * width
    told = np.where(has_contrast, covariance / np.where(has_contrast, scale, 1.0), 0.0)
    return np.clip(told, -1.0, 1.0).astype(np.float32)


def _boxes(integral: NDArray[Any], height: int, width: int) -> Array:
    """Sums over all boxes of a size, from an integral image."""
    below, above = integral[height:].astype(float), integral[:-height].astype(float)
    return below[:, width:] - below[:, :-width] - above[:, width:] + above[:, :-width]


def _vertex(scores: NDArray[np.float32], best: int) -> float:
    """Where between its neighbours the maximum of sampled scores lies, from -0.5 to 0.5."""
    if not 0 < best < len(scores) - 1:
        return 0.0
    before, peak, after = (float(one) for one in scores[best - 1 : best + 2])
    bend = before - 2 * peak + after
    return 0.0 if bend > -1e-9 else 0.5 * (before - after) / bend


def _lab(image: NDArray[np.uint8]) -> Picture:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB), np.uint8)


def is_covered(probe: Probe, hidden: Mask) -> bool:
    """Whether much of where a probe's patches lie may be hidden."""
    height, width = hidden.shape
    scale = np.array([width / probe.calibration.width, height / probe.calibration.height])
    shares = []
    for patch in probe.patches:
        size = np.array([patch.image.shape[1], patch.image.shape[0]])
        low, high = (
            np.floor(patch.corner * scale).astype(int),
            np.ceil((patch.corner + size) * scale).astype(int),
        )
        shares.append(hidden[low[1] : high[1], low[0] : high[0]].mean())
    return float(np.median(shares)) > MAX_HIDDEN_SHARE


Resize = Callable[[View, tuple[int, int]], Picture]


def resized(view: View, size: tuple[int, int]) -> Picture:
    """A view's image at another width and height."""
    return np.asarray(cv2.resize(view.image, size, interpolation=cv2.INTER_AREA), np.uint8)


def as_seen(view: View | None, probe: Probe, resize: Resize = resized) -> View | None:
    """A view at the size of the patches; None if there is none or its camera is elsewhere now."""
    if view is None:
        return None
    moved = se3.log_so3(view.T_world_cam[:3, :3] @ probe.T_world_cam[:3, :3].T)
    shifted = np.linalg.norm(view.T_world_cam[:3, 3] - probe.T_world_cam[:3, 3])
    if shifted > MAX_CAMERA_SHIFT_M or np.linalg.norm(moved) > MAX_CAMERA_TURN_RAD:
        return None
    size = (probe.calibration.width, probe.calibration.height)
    if view.image.shape[:2] == size[::-1]:
        return view
    return View(resize(view, size), probe.calibration, view.T_world_cam)
