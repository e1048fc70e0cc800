"""Silhouettes of coarse points, sides told by their colours, and what has tipped over."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.perception.drawn_world import cameras

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.perception.objects.shape import fitting
from lerobot_openspm.perception.objects.shape.colouring import UNSEEN, agreement, learn_colours
from lerobot_openspm.perception.objects.shape.fitting import Cloud, Evidence, PosePrior, fit
from lerobot_openspm.perception.objects.shape.hull import Posed
from lerobot_openspm.perception.objects.shape.tipped import has_tipped, lying
from lerobot_openspm.types import View

HALF = np.array([0.06, 0.05, 0.04])
RED, BLUE = (200, 40, 30), (30, 60, 200)


def block(spacing: float, half: np.ndarray = HALF) -> Cloud:
    """Points of a block's surface that stands on z = 0."""
    axes = [np.arange(-h + spacing / 2, h, spacing) for h in half]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    is_rim = (np.abs(points) > half - 0.75 * spacing).any(axis=1)
    return Cloud(points[is_rim] + [0, 0, half[2]], spacing)


def views(
    T_world_obj: np.ndarray, half: np.ndarray = HALF, turned: np.ndarray | None = None
) -> list[Evidence]:
    """A block, red in front (x > 0) and blue behind, as two cameras see it; `turned` tips it over."""
    found = []
    for name, (camera, T_world_cam) in cameras().items():
        image = np.full((camera.height, camera.width, 3), 120, np.uint8)
        mask = np.zeros(image.shape[:2], np.uint8)
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        for colour, side in ((BLUE, -1), (RED, 1)):
            corners = signs[signs[:, 0] == side] * half
            middle = np.concatenate([corners, corners * [0, 1, 1]])
            R = np.eye(3) if turned is None else turned
            points = middle @ R.T
            points[:, 2] += np.abs(R @ np.diag(half)).sum(axis=1)[2]
            uv, _ = project(camera, T_world_cam, se3.apply(T_world_obj, points))
            hull = cv2.convexHull(np.rint(uv * 16).astype(np.int32))
            cv2.fillConvexPoly(image, hull, colour, shift=4)
            cv2.fillConvexPoly(mask, hull, 1, shift=4)
        found.append(Evidence(View(image, camera, T_world_cam), mask.astype(np.float32), None, name))
    return found


@pytest.mark.parametrize("spacing", [0.004, 0.02])
def test_coarse_points_are_aligned_like_fine_ones(spacing):
    T_true = se3.from_yaw([0.02, 0.01, 0.0], 0.3)
    start = se3.from_yaw([0.04, 0.03, 0.0], 0.4)
    found = fit(views(T_true), block(spacing), start, PosePrior(), fitting.COARSE_CUTS_PX).T_world_obj
    assert np.linalg.norm(found[:2, 3] - T_true[:2, 3]) < 0.006


def test_the_colours_of_a_shape_tell_its_front_from_its_back():
    cloud = block(0.008)
    poses = [se3.from_yaw([0.01 * i, 0.0, 0.0], 0.1 * i) for i in range(4)]
    colours = learn_colours([Posed(tuple(views(T)), T) for T in poses], cloud)
    assert (colours[:, 0] > UNSEEN).any()
    T_true = se3.from_yaw([0.03, 0.02, 0.0], 2.5)
    there, back = (
        agreement(views(T_true), cloud, colours, T_true @ se3.from_yaw(np.zeros(3), turn))
        for turn in (0, np.pi)
    )
    assert there > back + 0.1


def test_fine_colours_a_pixel_aside_agree_and_others_do_not():
    cloud, T = block(0.008), se3.from_yaw([0.02, 0.01, 0.0], 0.3)
    first, second = (
        [replace(one, view=replace(one.view, image=noise.integers(0, 255, one.view.image.shape, np.uint8)))
         for one in views(T)[:1]]
        for noise in (np.random.default_rng(0), np.random.default_rng(1))
    )  # fmt: skip
    colours = learn_colours([Posed(tuple(first), T)] * 3, cloud)
    aside = [replace(one, view=replace(one.view, image=np.roll(one.view.image, 1, axis=1))) for one in first]
    assert agreement(first, cloud, colours, T) > 0.7
    assert agreement(aside, cloud, colours, T) > agreement(second, cloud, colours, T) + 0.3


def test_colours_never_seen_tell_nothing():
    cloud = block(0.008)
    assert (
        agreement(views(np.eye(4)), cloud, np.full((len(cloud.points), 3), UNSEEN, np.float32), np.eye(4))
        == 0
    )


@pytest.mark.parametrize("is_lying", [False, True])
def test_what_lies_on_its_side_is_told_from_what_stands(is_lying):
    half = np.array([0.02, 0.02, 0.07])
    cloud, place = block(0.005, half), np.zeros(3)
    about_x = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    seen = views(np.eye(4), half, about_x if is_lying else None)
    upright = fit(seen, cloud, np.eye(4), PosePrior(), fitting.COARSE_CUTS_PX).score
    # Its own demonstrations fit perfectly, so that both are asked.
    assert has_tipped(seen, lying(cloud, is_round=False), [place], min(upright, 0.9), 1.0) == is_lying


def test_what_fits_as_in_its_demonstrations_is_not_asked():
    assert not has_tipped([], [], [], upright=0.95, typical_overlap=1.0)
