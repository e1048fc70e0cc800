"""Corners of a path lie where it turns, also where it turns near a contact."""

from itertools import pairwise

import numpy as np
import pytest

from lerobot_openspm.mining.corners import corners

STEP_M = 0.016


def rounded(*corner_points: tuple[float, float, float]) -> np.ndarray:
    """A path ``(n, 6)`` through some points at a usual speed, its corners rounded as those of a hand are."""
    legs = [
        np.linspace(a, b, max(2, round(float(np.linalg.norm(np.subtract(b, a))) / STEP_M)), endpoint=False)
        for a, b in pairwise(np.array(corner_points))
    ]
    path = np.concatenate([*legs, [corner_points[-1]]])
    padded = np.concatenate([path[:1], path, path[-1:]])
    smooth = (padded[:-2] + padded[1:-1] + padded[2:]) / 3
    return np.concatenate([smooth, np.zeros_like(smooth)], axis=1)


@pytest.mark.parametrize("hover", [0.05, 0.07, 0.1])
@pytest.mark.parametrize("far", [0.15, 0.3, 0.5])
def test_a_hand_that_sinks_on_its_way_turns_above_the_place_and_not_closer_to_it(hover: float, far: float):
    path = rounded((far, 0, 0), (far, 0, 0.15 + hover), (0, 0, hover), (0, 0, 0))
    away = np.linalg.norm(path[:, None, :3] - path[[0, -1], :3], axis=-1).min(axis=1)
    lift, above = corners(path, np.maximum(0.01, 0.35 * away))
    assert path[lift, 2] == pytest.approx(0.15 + hover, abs=STEP_M)
    assert path[above, 2] == pytest.approx(hover, abs=STEP_M)


def test_a_bow_within_the_tolerance_is_no_corner():
    path = rounded((0, 0, 0), (0.2, 0.05, 0), (0.4, 0, 0))
    assert len(corners(path, np.full(len(path), 0.06))) == 0
    (corner,) = corners(path, np.full(len(path), 0.02))
    assert path[corner, 0] == pytest.approx(0.2, abs=STEP_M)
