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
    "place": (40, 170, 90), "release": (0, 190, 200), "retreat": (30, 30, 30), "push": (230, 60, 60),
    "open": (130, 80, 40), "turn": (130, 80, 40),
}  # fmt: skip
AXIS_M = 0.025
# Marks are discs. One that would lie on others is a ring around them, so that all are seen.
DISC_PX, RING_PX = 4, 2
# Of the legend: a row for each phase, on white.
ROW_PX, LEGEND_PX = 16, 92
FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_key_poses(view: View, poses: Sequence[Array], phases: Sequence[str], scale: int = 2) -> Image:
    """Draw hand poses ``T_world_ee`` ``(4, 4)`` into a view: the way, at each the hand's axes and a mark."""
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
        _mark(image, tip.tolist(), radius, phase)
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
    """Radius of the mark at each pixel ``(n, 2)``: one size more than of those before it that it meets."""
    radii: list[int] = []
    for i, pixel in enumerate(pixels):
        apart = np.linalg.norm(pixels[:i] - pixel, axis=1)
        met = [radius for radius, px in zip(radii, apart, strict=True) if px < 2 * DISC_PX]
        radii.append(max(met) + 2 * RING_PX if met else DISC_PX)
    return radii


def _mark(image: Image, center: Sequence[int], radius: int, phase: str) -> None:
    width = cv2.FILLED if radius == DISC_PX else RING_PX
    cv2.circle(image, (center[0], center[1]), radius, PHASE_COLOURS[phase], width, cv2.LINE_AA)


def _write_legend(image: Image, phases: Sequence[str]) -> None:
    named = list(dict.fromkeys(phases))
    image[: ROW_PX * len(named) + ROW_PX // 2, :LEGEND_PX] = 255
    for row, phase in enumerate(named, start=1):
        _mark(image, (12, ROW_PX * row - 4), DISC_PX, phase)
        cv2.putText(image, phase, (22, ROW_PX * row), FONT, 0.42, (20, 20, 20), 1, cv2.LINE_AA)
