"""Boxes and cylinders fitted to the outlines of their masks."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.perception.drawn_masks import box_views, turned_yaw
from tests.properties import examples

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.box.box import Box
from lerobot_openspm.perception.objects.box.outline import DIRECTIONS, fit_outlines, outline, overlap

PLACE = st.floats(-0.12, 0.12)
YAW = st.floats(-np.pi, np.pi)
TRUE_SIZE = np.array([0.12, 0.06, 0.05])


def outlines(views, **changes):
    return [outline(view, view.labels == 1, **changes) for view in views.values()]


def nearby(box: Box, turn: float = 0.25) -> Box:
    T = box.T_world_obj @ se3.from_yaw([0.015, -0.02, 0.0], turn)
    return Box(T, box.size, box.is_round)


@examples(25)
@given(PLACE, PLACE, YAW, st.booleans())
def test_a_body_of_known_size_is_found_within_a_millimetre_or_two(x, y, yaw, is_round):
    size = np.array([0.08, 0.08, 0.06]) if is_round else TRUE_SIZE
    box = Box(se3.from_yaw([x, y, 0.0], yaw), size, is_round)
    found = fit_outlines(outlines(box_views(box)), nearby(box))
    assert np.linalg.norm(found.body.T_world_obj[:2, 3] - [x, y]) < 0.002
    assert found.body.T_world_obj[2, 3] == 0
    assert found.residual_px < 0.6
    if not is_round:
        assert turned_yaw(found.body.T_world_obj, box.T_world_obj, np.pi) < np.deg2rad(2.5)


@examples(12)
@given(YAW, st.floats(0.06, 0.14), st.floats(0.03, 0.05), st.floats(0.02, 0.09))
def test_two_views_determine_size_and_support_plane_too(yaw, long_side, short_side, height):
    box = Box(se3.from_yaw([0.02, -0.03, 0.03], yaw), np.array([long_side, short_side, height]))
    start = Box(box.T_world_obj @ se3.from_yaw([0.01, 0.01, -0.01], 0.2), box.size * [1.2, 0.9, 0.8])
    found = fit_outlines(outlines(box_views(box)), start, free_height=True, free_size=True).body
    # A pixel is 4.5 mm here.
    assert found.size == pytest.approx(box.size, abs=0.009)
    assert found.T_world_obj[:2, 3] == pytest.approx(box.T_world_obj[:2, 3], abs=0.004)
    assert found.T_world_obj[2, 3] == pytest.approx(0.03, abs=0.009)


@examples(8)
@given(YAW, PLACE, PLACE)
def test_moving_and_turning_everything_moves_and_turns_the_fit(yaw, x, y):
    box = Box(se3.from_yaw([0.05, -0.02, 0.0], 0.6), TRUE_SIZE)
    T_moved = se3.from_yaw([x, y, 0.0], yaw)
    moved = Box(T_moved @ box.T_world_obj, TRUE_SIZE)
    here = fit_outlines(outlines(box_views(box)), nearby(box))
    there = fit_outlines(outlines(box_views(moved, T_moved)), nearby(moved))
    expected = T_moved @ here.body.T_world_obj
    assert there.body.T_world_obj == pytest.approx(expected, abs=1e-4)
    R = T_moved[:2, :2]
    turned = R @ here.covariance[:2, :2] @ R.T
    assert there.covariance[:2, :2] == pytest.approx(turned, rel=0.02, abs=1e-9)


def test_the_covariance_says_how_far_off_the_fit_is():
    rng = np.random.default_rng(0)
    squares, yaws = [], []
    for _ in range(40):
        T = se3.from_yaw([*rng.uniform(-0.12, 0.12, 2), 0.0], rng.uniform(-np.pi, np.pi))
        box = Box(T, TRUE_SIZE)
        found = fit_outlines(outlines(box_views(box)), nearby(box))
        off = found.body.T_world_obj[:2, 3] - T[:2, 3]
        squares.append(off @ np.linalg.solve(found.covariance[:2, :2], off) / 2)
        yaws.append(turned_yaw(found.body.T_world_obj, T, np.pi) ** 2 / found.covariance[3, 3])
    # 1 for a covariance that is neither too sure nor too modest.
    assert 0.15 < np.mean(squares) < 2.0
    assert 0.1 < np.mean(yaws) < 3.0


def test_fewer_views_and_less_sure_masks_make_the_pose_less_sure():
    box = Box(se3.from_yaw([0.0, 0.0, 0.0], 0.5), TRUE_SIZE)
    both = outlines(box_views(box))
    sure = fit_outlines(both, nearby(box)).covariance
    for fewer in (both[:1], [replace(one, confidence=0.3) for one in both]):
        less = fit_outlines(fewer, nearby(box)).covariance
        assert (np.diag(less)[[0, 1, 3]] > 1.5 * np.diag(sure)[[0, 1, 3]]).all()
    assert fit_outlines(both, nearby(Box(box.T_world_obj, TRUE_SIZE, is_round=True))).covariance[3, 3] > 3


def test_what_the_border_cuts_off_is_not_taken_for_the_objects_end():
    box = Box(se3.from_yaw([0.0, 0.0, 0.0], 0.5), TRUE_SIZE)
    views = box_views(box)
    view = views["front"]
    last = int(np.flatnonzero((view.labels == 1).any(0)).mean())
    camera = replace(view.camera, width=last)
    views["front"] = replace(view, image=view.image[:, :last], labels=view.labels[:, :last], camera=camera)
    cut = outline(views["front"], views["front"].labels == 1)
    assert 0 < cut.whole.sum() < len(DIRECTIONS)
    found = fit_outlines(outlines(views), nearby(box))
    assert np.linalg.norm(found.body.T_world_obj[:2, 3]) < 0.003


def test_a_part_hidden_in_one_view_moves_the_fit_little():
    box = Box(se3.from_yaw([0.0, 0.0, 0.0], 0.5), TRUE_SIZE)
    views = box_views(box)
    mask = views["front"].labels == 1
    columns = np.flatnonzero(mask.any(0))
    mask[:, columns[int(0.85 * len(columns))] :] = False
    hidden = [outline(views["front"], mask), *outlines({"side": views["side"]})]
    found = fit_outlines(hidden, nearby(box))
    assert np.linalg.norm(found.body.T_world_obj[:2, 3]) < 0.006


def test_a_mask_without_any_whole_end_leaves_the_start():
    box = Box(se3.from_yaw([0.0, 0.0, 0.0], 0.5), TRUE_SIZE)
    view = box_views(box)["front"]
    everywhere = outline(view, np.ones_like(view.labels, bool))
    found = fit_outlines([everywhere], box)
    assert found.residual_px == np.inf
    assert found.body.T_world_obj == pytest.approx(box.T_world_obj)
    assert np.diag(found.covariance)[:2].min() > 1


def test_overlap_counts_what_should_be_seen():
    box = Box(se3.from_yaw([0.0, 0.0, 0.0], 0.5), TRUE_SIZE)
    view = box_views(box)["front"]
    assert overlap(view, view.labels == 1, box) > 0.9
    assert overlap(view, None, box) == 0
    aside = Box(se3.from_yaw([0.0, 0.1, 0.0], 0.5), TRUE_SIZE)
    assert overlap(view, view.labels == 1, aside) < 0.2
    for place in ([0.0, 5.0, 0.0], [3.0, 0.0, 0.0]):
        assert np.isnan(overlap(view, None, Box(se3.from_yaw(place, 0.0), TRUE_SIZE)))
