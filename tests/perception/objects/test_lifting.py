"""Masks become points in the world: from depth, from the hull of several views, from one view and a plane."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.perception.drawn_masks import body, box_views, depth_of, masked_views, masks_of
from tests.perception.drawn_world import draw_poses
from tests.properties import examples

from lerobot_openspm.errors import ObservationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import intersect_plane
from lerobot_openspm.perception.objects.box.box import Box
from lerobot_openspm.perception.objects.box.lifting import depth_points, lift, support_height

PLACE = st.floats(-0.1, 0.1)
YAW = st.floats(-np.pi, np.pi)


def outside(points: np.ndarray, box: Box) -> np.ndarray:
    """Distance of points from a box, 0 within it."""
    own = se3.apply(se3.inverse(box.T_world_obj), points)
    low, high = box.size * [-0.5, -0.5, 0.0], box.size * [0.5, 0.5, 1.0]
    return np.linalg.norm(np.maximum(np.maximum(low - own, own - high), 0), axis=1)


def without_depth(views):
    return {name: replace(view, depth=None) for name, view in views.items()}


@examples(15)
@given(PLACE, PLACE, YAW)
def test_points_with_depth_lie_on_the_object(x, y, yaw):
    box = Box(se3.from_yaw([x, y, 0.0], yaw), np.array([0.12, 0.06, 0.05]))
    views = box_views(box)
    lifted = lift(views, masks_of(views, "block"), 0.0)
    assert lifted.source == "depth"
    assert outside(lifted.points_world, box).max() < 0.002
    own = se3.apply(se3.inverse(box.T_world_obj), lifted.points_world)
    assert np.ptp(own, axis=0) == pytest.approx(box.size, abs=2.5 * lifted.spacing)
    assert lifted.ray_gap_m < 0.01


def test_flying_pixels_and_holes_in_the_depth_are_left_out():
    box = Box(se3.from_yaw([0.0, 0.0, 0.0], 0.4), np.array([0.12, 0.06, 0.05]))
    view = box_views(box)["front"]
    mask = view.labels == 1
    rng = np.random.default_rng(0)
    spoilt = view.depth.copy()
    rows, columns = np.nonzero(mask)
    chosen = rng.permutation(len(rows))
    for part, value in ((chosen[:60], 0.0), (chosen[60:120], 0.3), (chosen[120:180], 1.6)):
        spoilt[rows[part], columns[part]] = value
    spoilt[rows[chosen[180]], columns[chosen[180]]] = np.nan
    spoilt_view = replace(view, depth=spoilt)
    points = depth_points(spoilt_view, mask)
    assert len(rows) - 230 < len(points) <= len(rows) - 181
    assert outside(points, box).max() < 0.002


def test_a_mask_that_is_a_pixel_too_wide_brings_no_table_with_it():
    box = Box(se3.from_yaw([0.0, 0.0, 0.0], 0.4), np.array([0.12, 0.06, 0.05]))
    views = box_views(box)
    masks = {}
    for name, mask in masks_of(views, "block").items():
        wide = mask.copy()
        wide[1:] |= mask[:-1]
        wide[:-1] |= mask[1:]
        masks[name] = wide
    lifted = lift(views, masks, 0.0)
    assert np.quantile(outside(lifted.points_world, box), 0.98) < 0.004


@examples(6)
@given(st.integers(0, 2**31), st.sampled_from(["block", "cup"]))
def test_the_hull_holds_the_object_and_fills_its_masks(seed, name):
    poses = draw_poses(np.random.default_rng(seed))
    views = masked_views(poses)
    lifted = lift(views, masks_of(views, name), 0.0)
    assert lifted.source == "hull"
    assert lifted.ray_gap_m < 0.01
    assert lifted.points_world[:, 2].min() >= 0
    low, high = lifted.points_world.min(0), lifted.points_world.max(0)
    vertices = body(name, poses[name]).vertices()
    slack = 1.5 * lifted.spacing
    assert (low - slack < vertices.min(0)).all()
    assert (high + slack > vertices.max(0)).all()


@examples(5)
@given(YAW, PLACE, PLACE)
def test_moving_and_turning_everything_moves_and_turns_the_points(yaw, x, y):
    poses = draw_poses(np.random.default_rng(3))
    T_moved = se3.from_yaw([x, y, 0.0], yaw)
    moved = {name: T_moved @ T for name, T in poses.items()}
    here, there = masked_views(poses), masked_views(moved, T_moved)
    for only in (("front",), ("front", "side")):
        one = lift({k: here[k] for k in only}, {k: masks_of(here, "block")[k] for k in only}, 0.0)
        two = lift({k: there[k] for k in only}, {k: masks_of(there, "block")[k] for k in only}, 0.0)
        # The hull's voxels keep to the world's axes, so they do not turn with the scene.
        expected = se3.apply(T_moved, one.points_world)
        assert two.source == one.source
        assert np.linalg.norm(two.points_world.mean(0) - expected.mean(0)) < 0.006
        assert np.std(two.points_world[:, 2]) == pytest.approx(np.std(expected[:, 2]), abs=0.004)


def test_one_view_without_depth_leaves_the_rays_and_the_plane():
    poses = draw_poses(np.random.default_rng(1))
    views = masked_views(poses, only=("front",))
    lifted = lift(views, masks_of(views, "cup"), 0.01)
    assert lifted.source == "plane"
    assert lifted.points_world[:, 2] == pytest.approx(0.01)
    assert np.isnan(lifted.ray_gap_m)
    v, u = np.nonzero(views["front"].labels == 2)
    camera, T = views["front"].camera, views["front"].T_world_cam
    assert lifted.points_world == pytest.approx(intersect_plane(camera, T, np.stack([u, v], 1), 0.01))


def test_a_mask_cut_by_the_border_does_not_pull_the_centre():
    poses = draw_poses(np.random.default_rng(1))
    views = masked_views(poses)
    mask = masks_of(views, "block")["side"]
    columns = np.flatnonzero(mask.any(0))
    middle = int(columns.mean())
    # The same picture without what lies beyond the middle of the block: its mask ends at the border.
    view = views["side"]
    camera = replace(view.camera, width=middle)
    cut = replace(view, image=view.image[:, :middle], labels=view.labels[:, :middle], camera=camera)
    both = {"front": views["front"], "side": cut, "again": views["side"]}
    lifted = lift(both, masks_of(both, "block"), 0.0)
    whole = lift(views, masks_of(views, "block"), 0.0)
    assert lifted.ray_gap_m == pytest.approx(whole.ray_gap_m, abs=1e-3)
    pair = {k: both[k] for k in ("front", "side")}
    with_cut = lift(pair, masks_of(pair, "block"), 0.0)
    assert np.isnan(with_cut.ray_gap_m)
    assert np.linalg.norm(with_cut.points_world.mean(0)[:2] - whole.points_world.mean(0)[:2]) < 0.015


def test_the_plane_around_an_object_is_seen_in_its_depth():
    box = Box(se3.from_yaw([0.02, -0.05, 0.0], 0.4), np.array([0.12, 0.06, 0.05]))
    view = box_views(box)["side"]
    noise = np.random.default_rng(0).normal(0, 0.003, view.depth.shape).astype(np.float32)
    assert support_height(view, view.labels == 1) == pytest.approx(0.0, abs=1e-3)
    noisy = replace(view, depth=view.depth + noise)
    assert support_height(noisy, view.labels == 1) == pytest.approx(0.0, abs=2e-3)
    blind = replace(view, depth=np.zeros_like(view.depth))
    assert support_height(blind, view.labels == 1) is None


def test_without_enough_pixels_there_are_no_points():
    poses = draw_poses(np.random.default_rng(1))
    views = masked_views(poses)
    empty = np.zeros_like(views["front"].labels, bool)
    assert lift(views, {"front": empty}, 0.0) is None
    assert lift(views, {}, 0.0) is None
    speck = empty.copy()
    speck[5, 5:10] = True
    assert lift(views, {"front": speck}, 0.0) is None


def test_a_mask_without_its_view_is_refused():
    views = masked_views(draw_poses(np.random.default_rng(1)))
    with pytest.raises(ObservationError, match=r"masks of \['side'\] but views of \['front'\]"):
        lift({"front": views["front"]}, masks_of(views, "cup"), 0.0)


def test_specks_beside_the_mask_do_not_count():
    poses = draw_poses(np.random.default_rng(1))
    views = masked_views(poses)
    masks = masks_of(views, "cup")
    clean = lift(views, masks, 0.0)
    spoilt = {name: mask.copy() for name, mask in masks.items()}
    spoilt["front"][2:4, 2:6] = True
    np.testing.assert_array_equal(lift(views, spoilt, 0.0).points_world, clean.points_world)


@pytest.mark.parametrize("what", ["mask", "depth image"])
def test_what_has_not_the_images_size_is_refused(what):
    box = Box(se3.from_yaw([0.0, 0.0, 0.0], 0.0), np.array([0.12, 0.06, 0.05]))
    views = box_views(box)
    masks = masks_of(views, "block")
    if what == "mask":
        masks["front"] = masks["front"][:-1]
    else:
        views["front"] = replace(views["front"], depth=views["front"].depth[:, :-1])
    with pytest.raises(ObservationError, match=rf"camera 'front': {what} of shape .*160, 160"):
        lift(views, masks, 0.0)


def test_depth_of_the_drawn_box_is_that_of_its_corners():
    """The tests' own ruler: the nearest corner of a box is seen at its distance."""
    box = Box(se3.from_yaw([0.0, 0.0, 0.0], 0.0), np.array([0.12, 0.06, 0.05]))
    view = box_views(box)["front"]
    along = (box.vertices() - view.T_world_cam[:3, 3]) @ view.T_world_cam[:3, 2]
    seen = depth_of(view, [box])[view.labels == 1]
    assert seen.min() == pytest.approx(along.min(), abs=0.003)
