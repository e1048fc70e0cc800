"""Frames, sizes and checks of SAM 3D's answers."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.geometry.strategies import rotvecs, vectors
from tests.perception.objects import sam3d_scene as scene

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.perception.objects.base import Appearance
from lerobot_openspm.perception.objects.sam3d.reconstruction import reconstruction_from
from lerobot_openspm.perception.objects.sam3d.size import Sam3dShape, request_arrays
from lerobot_openspm.types import Segmentation, View

FAKE = Path(__file__).with_name("fake_sam3d_worker.py")


def backend(folder, mode="honest", **options):
    return Sam3dShape((sys.executable, str(FAKE), mode, str(folder)), **options)


def describe(folder, *one):
    (shape,) = backend(folder).describe([Appearance(*one)])
    return shape


def told(folder, **arrays):
    np.savez(folder / "answer.npz", **arrays)


@given(rotvecs(), vectors(-0.3, 0.3), vectors(-0.4, 0.4), st.tuples(*[st.floats(0.05, 0.5)] * 3))
def test_points_come_back_where_pytorch3d_puts_them(rotvec, aside, centre, scale):
    scale, extents = np.array(scale), np.array([0.9, 0.5, 0.7])
    t = aside + np.array([0, 0, 1.5])
    # As its Transform3d does: points are rows, first scaled, then rotated from the right, then moved.
    R = Rotation.from_rotvec(rotvec)
    x_obj = scene.surface(extents, 4) + centre
    left_up_forward = (x_obj * scale) @ R.as_matrix() + t
    right_down_forward = np.stack([-left_up_forward[:, 0], -left_up_forward[:, 1], left_up_forward[:, 2]], 1)

    found = reconstruction_from(
        {
            "rotation_wxyz": R.as_quat()[[3, 0, 1, 2]],
            "translation": t,
            "scale": scale,
            "centre": centre,
            "extents": extents,
            "points": x_obj,
        }
    )

    assert se3.is_rigid(found.T_cam_box)
    np.testing.assert_allclose(found.extents, extents * scale)
    np.testing.assert_allclose(found.points_cam, right_down_forward, atol=1e-9)
    from_box = se3.apply(found.T_cam_box, scene.surface(found.extents, 4))
    np.testing.assert_allclose(from_box, right_down_forward, atol=1e-9)


def test_a_quarter_turn_by_hand():
    # w, x, y, z of 90 degrees about z: rows are turned by [[0, -1, 0], [1, 0, 0], [0, 0, 1]].
    half = np.sqrt(0.5)
    answer = scene.described(scene.seen()[0].T_world_cam) | {
        "rotation_wxyz": np.array([half, 0, 0, half]),
        "translation": np.array([0.1, 0.2, 2.0]),
        "scale": np.ones(3),
        "centre": np.zeros(3),
        "extents": np.ones(3),
        "points": np.array([[0.5, 0.0, 0.25]] * 8),
    }
    found = reconstruction_from(answer)
    # (0.5, 0, 0.25) @ R = (0, -0.5, 0.25); moved (0.1, -0.3, 2.25); x and y turned about.
    np.testing.assert_allclose(found.points_cam[0], [-0.1, 0.3, 2.25], atol=1e-12)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_model_gets_a_picture_and_points_that_fit_an_unmirrored_camera(mirrored):
    plain, segmentation = scene.seen()
    view, mask = scene.seen(mirrored)
    arrays = request_arrays(view, mask)
    np.testing.assert_array_equal(arrays["image"], plain.image)
    np.testing.assert_array_equal(arrays["mask"], segmentation.mask)
    points = arrays["pointmap"] * [-1, -1, 1]
    assert arrays["pointmap"].dtype == np.float32
    assert np.isnan(points[:3]).all()
    v, u = np.indices(segmentation.mask.shape)[:, 3:]
    uv, depth = project(plain.camera, np.eye(4), points[3:])
    np.testing.assert_allclose(uv, np.stack([u, v], -1), atol=1e-3)
    np.testing.assert_allclose(depth, plain.depth[3:], rtol=1e-6)


def assert_the_box(shape, within=0.002):
    metres, radians = se3.distances(shape.T_world_obj, scene.T_WORLD_OBJ)
    assert metres < within
    assert radians < 1e-5
    np.testing.assert_allclose(shape.extents, scene.EXTENTS, rtol=0.01)
    assert shape.quality > 0.9


@pytest.mark.parametrize("mirrored", [False, True])
def test_depth_gives_the_size(tmp_path, mirrored):
    view, segmentation = scene.seen(mirrored)
    told(tmp_path, **scene.described(view.T_world_cam))
    assert_the_box(describe(tmp_path, view, segmentation))
    with np.load(tmp_path / "request.npz") as request:
        for name, array in request_arrays(view, segmentation).items():
            np.testing.assert_array_equal(request[f"0.{name}"], array)


def test_without_depth_points_give_the_size(tmp_path):
    view, segmentation = scene.seen(depth=False)
    told(tmp_path, **scene.described(view.T_world_cam, size=2.7))
    upper_side = scene.surface(scene.EXTENTS, 20)
    upper_side = upper_side[upper_side[:, 2] > 0.99 * scene.EXTENTS[2] / 2]
    points = se3.apply(scene.T_WORLD_OBJ, upper_side + scene.UP)
    # Which points are the front ones is known only roughly: 0.5 % of the distance.
    assert_the_box(describe(tmp_path, view, segmentation, points), within=0.0045)
    with np.load(tmp_path / "request.npz") as request:
        assert set(request) == {"0.image", "0.mask"}


def test_many_objects_are_described_in_one_run_in_their_order(tmp_path):
    (near, segmentation), (_, other) = scene.seen(), scene.seen(depth=False)
    told(tmp_path, **scene.described(near.T_world_cam))
    far = se3.apply(scene.T_WORLD_OBJ, 2 * scene.surface(scene.EXTENTS, 20))
    flat = View(near.image, near.camera, near.T_world_cam)
    shapes = backend(tmp_path).describe([Appearance(near, segmentation), Appearance(flat, other, far)])
    assert_the_box(shapes[0])
    assert shapes[1].extents[0] != pytest.approx(shapes[0].extents[0])
    assert backend(tmp_path, "dies").describe([]) == []


def test_a_shape_elsewhere_has_little_quality(tmp_path):
    view, segmentation = scene.seen()
    answer = scene.described(view.T_world_cam)
    told(tmp_path, **answer | {"translation": answer["translation"] + [0.05, 0, 0]})
    assert describe(tmp_path, view, segmentation).quality < 0.6


def test_what_cannot_be_asked_starts_no_worker(tmp_path):
    view, segmentation = scene.seen(depth=False)
    lacking = {
        "know the size": (view, segmentation),
        "got a mask of shape": (view, Segmentation(segmentation.mask[:-1], 1.0)),
        "with 0 pixels": (view, Segmentation(np.zeros_like(segmentation.mask), 1.0)),
        "got depth of shape": (
            View(view.image, view.camera, view.T_world_cam, np.ones((4, 4), np.float32)),
            segmentation,
        ),
    }
    for message, arguments in lacking.items():
        with pytest.raises(PerceptionError, match=message):
            describe(tmp_path, *arguments)
    assert not (tmp_path / "pid").exists()


def test_points_behind_the_camera_give_no_size(tmp_path):
    view, segmentation = scene.seen(depth=False)
    told(tmp_path, **scene.described(view.T_world_cam))
    behind = se3.apply(view.T_world_cam, np.array([[0, 0, -1.0]]))
    with pytest.raises(PerceptionError, match="got none of 1"):
        describe(tmp_path, view, segmentation, behind)


WRONG = {
    "not a unit quaternion": ("rotation_wxyz", lambda q: 1.2 * q, "a unit quaternion"),
    "a quaternion of zeros": ("rotation_wxyz", lambda q: 0 * q, "a unit quaternion"),
    "a matrix": ("rotation_wxyz", lambda q: np.eye(3), "shape (4,)"),
    "NaN": ("translation", lambda t: t * np.nan, "finite"),
    "infinite": ("scale", lambda s: s * np.inf, "finite"),
    "NaN in a point": ("points", lambda p: np.where(p == p[3], np.nan, p), "finite"),
    "mirrored": ("scale", lambda s: s * [-1, 1, 1], "positive"),
    "no scale": ("scale", lambda s: 0 * s, "positive"),
    "behind the camera": ("translation", lambda t: -t, "in front of the camera"),
    "inside out": ("extents", lambda e: -e, "sizes of a box"),
    "no size": ("extents", lambda e: 0 * e, "sizes of a box"),
    "points elsewhere": ("points", lambda p: p + 3, "points within the box"),
    "too few points": ("points", lambda p: p[:7], "at least 8"),
    "too many points": ("points", lambda p: np.tile(p, (6, 1)), "at most 8192"),
    "flat points": ("points", lambda p: p[:, :2], "shape (n, 3)"),
}


@pytest.mark.parametrize(("name", "change", "expected"), WRONG.values(), ids=WRONG)
def test_an_answer_that_makes_no_sense(name, change, expected):
    answer = scene.described(scene.seen()[0].T_world_cam)
    answer[name] = np.asarray(change(answer[name]))
    with pytest.raises(PerceptionError) as caught:
        reconstruction_from(answer)
    for part in (name, "got", "expected", expected, "docs/sam3d.md"):
        assert part in str(caught.value)


@pytest.mark.parametrize("name", sorted(scene.described(np.eye(4))))
def test_an_answer_that_lacks_something(name):
    answer = scene.described(scene.seen()[0].T_world_cam)
    del answer[name]
    with pytest.raises(PerceptionError, match=f"'{name}': got nothing"):
        reconstruction_from(answer)


def test_an_object_as_large_as_a_house(tmp_path):
    view, segmentation = scene.seen()
    told(tmp_path, **scene.described(view.T_world_cam, size=100))
    with pytest.raises(PerceptionError, match="less than 10 m"):
        describe(tmp_path, view, segmentation)


def test_half_precision_is_good_enough_for_a_rotation():
    answer = scene.described(scene.seen()[0].T_world_cam)
    exact = reconstruction_from(answer)
    rounded = reconstruction_from(answer | {"rotation_wxyz": answer["rotation_wxyz"].astype(np.float16)})
    assert se3.is_rigid(rounded.T_cam_box, 1e-9)
    assert se3.distances(rounded.T_cam_box, exact.T_cam_box)[1] < 0.002
