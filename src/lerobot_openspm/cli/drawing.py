"""Pictures for people: key poses drawn into a camera image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import View

Image = NDArray[np.uint8]
# One colour per phase, RGB; the same in every picture.
PHASE_COLOURS = {
    "approach": (66, 135, 245), "grasp": (230, 60, 60), "lift": (245, 160, 40), "pre-place": (170, 90, 220),
    "place": (40, 170, 90), "release": (20, 120, 60), "retreat": (120, 120, 120), "push": (230, 60, 60),
    "open": (200, 40, 120), "turn": (200, 40, 120),
}  # fmt: skip
AXIS_M = 0.025
# Marks are rings. One that would lie on others is drawn around them, so that all are seen.
RING_PX, WIDTH_PX = 4, 2
FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_key_poses(view: View, poses: Sequence[Array], phases: Sequence[str], scale: int = 2) -> Image:
    """Draw hand poses ``T_world_ee`` ``(4, 4)`` into a view: the way, at each the hand's axes and a ring."""
    height, width = view.image.shape[:2]
    image = cv2.resize(view.image, (width * scale, height * scale), interpolation=cv2.INTER_CUBIC)
    image = np.asarray(image, np.uint8)
    tips = np.stack([T[:3, 3] for T in poses])
    pixels = _pixels(view, tips, scale)
    cv2.polylines(image, [pixels[:, None]], False, (255, 255, 255), 1, cv2.LINE_AA)
    for T, phase in zip(poses, phases, strict=True):
        colour = PHASE_COLOURS[phase]
        across = _pixels(view, T[:3, 3] + np.outer([-AXIS_M, AXIS_M], T[:3, 1]), scale)
        back = _pixels(view, np.stack([T[:3, 3], T[:3, 3] - 2 * AXIS_M * T[:3, 2]]), scale)
        for line in (across, back):
            cv2.line(image, line[0].tolist(), line[1].tolist(), colour, 2, cv2.LINE_AA)
    for tip, radius, phase in zip(pixels, _radii(pixels), phases, strict=True):
        _ring(image, tip.tolist(), radius, phase)
    _write_legend(image, phases)
    return image


def save_png(image: Image, path: Path) -> None:
    """Write an RGB image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise OSError(f"could not write {path}")


def _pixels(view: View, points_world: Array, scale: int) -> NDArray[np.int32]:
    uv, _ = project(view.camera, view.T_world_cam, points_world)
    # Points behind the camera are drawn far outside rather than nowhere, which OpenCV cannot do.
    return np.nan_to_num((uv + 0.5) * scale - 0.5, nan=-1e4).clip(-1e4, 1e4).round().astype(np.int32)


def _radii(pixels: NDArray[np.int32]) -> list[int]:
    """Radius of the ring at each pixel ``(n, 2)``: one size more than of those before it that it meets."""
    radii: list[int] = []
    for i, pixel in enumerate(pixels):
        apart = np.linalg.norm(pixels[:i] - pixel, axis=1)
        met = [radius for radius, px in zip(radii, apart, strict=True) if px < 2 * RING_PX]
        radii.append(max(met, default=RING_PX - 2 * WIDTH_PX) + 2 * WIDTH_PX)
    return radii


def _ring(image: Image, center: Sequence[int], radius: int, phase: str) -> None:
    cv2.circle(image, (center[0], center[1]), radius, PHASE_COLOURS[phase], WIDTH_PX, cv2.LINE_AA)


def _write_legend(image: Image, phases: Sequence[str]) -> None:
    for i, phase in enumerate(dict.fromkeys(phases)):
        at = (8, 18 + 16 * i)
        _ring(image, (at[0] + 4, at[1] - 4), RING_PX, phase)
        cv2.putText(image, phase, (at[0] + 14, at[1]), FONT, 0.42, (20, 20, 20), 1, cv2.LINE_AA)
