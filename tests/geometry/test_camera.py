import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from tests.geometry.strategies import transforms

from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry import camera as cam
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera, intersect_plane, load_cameras, project, ray_directions

# Looks straight down from one metre, image x along the world's x, image y (down) along the world's -y.
T_DOWN = se3.transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 1.0])


def camera(width=100, height=80, fx=200.0, fy=300.0, cx=50.0, cy=40.0, mount="world", T=T_DOWN):
    return Camera(width, height, fx, fy, cx, cy, mount, T)


def fields(**changes):
    return {
        "width": 100, "height": 80, "fx": 200.0, "fy": 300.0, "cx": 50.0, "cy": 40.0,
        "mount": "world", "T_mount_cam": T_DOWN.tolist(), **changes,
    }  # fmt: skip


def write(path, cameras, **changes):
    file = {"format": "openspm-cameras", "version": 1, "cameras": cameras}
    path.write_text(json.dumps(file | changes))
    return path


def test_projection_by_hand_fixes_axes_and_signs():
    # 0.1 m right is 200 * 0.1 / 1 = 20 pixels right; 0.05 m down is 300 * 0.05 / 1 = 15 pixels down.
    uv, depth = project(camera(), np.eye(4), [[0.1, 0.05, 1.0], [0.1, 0.05, 2.0], [-0.1, -0.05, 1.0]])
    assert_allclose(uv, [[70.0, 55.0], [60.0, 47.5], [30.0, 25.0]])
    assert_allclose(depth, [1.0, 2.0, 1.0])


def test_a_camera_that_looks_down_sees_the_worlds_y_upwards():
    uv, depth = project(camera(), T_DOWN, [[0.1, 0.2, 0.5]])
    assert_allclose(uv, [[50 + 200 * 0.1 / 0.5, 40 - 300 * 0.2 / 0.5]])
    assert_allclose(depth, [0.5])


def test_a_turned_camera_by_hand():
    # At x = -1 and looking along the world's x: right is -y, down is -z.
    T = se3.transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [-1.0, 0, 0])
    uv, depth = project(camera(), T, [1.0, 0.2, 0.4])
    assert_allclose(depth, 2.0)
    assert_allclose(uv, [50 + 200 * (-0.2) / 2, 40 + 300 * (-0.4) / 2])


def test_points_behind_the_camera_have_no_pixel():
    uv, depth = project(camera(), np.eye(4), [[0.1, 0.1, -1.0], [0.0, 0.0, 1.0]])
    assert np.isnan(uv[0]).all()
    assert depth[0] == -1.0
    assert_allclose(uv[1], [50, 40])


@pytest.mark.parametrize("batch", [(), (1,), (4,), (2, 3)])
def test_projection_keeps_leading_axes(batch):
    points = np.random.default_rng(0).uniform(-0.3, 0.3, size=(*batch, 3)) + np.array([0, 0, 1])
    uv, depth = project(camera(), np.eye(4), points)
    assert uv.shape == (*batch, 2)
    assert depth.shape == batch
    assert ray_directions(camera(), np.eye(4), uv).shape == (*batch, 3)
    assert intersect_plane(camera(), T_DOWN, uv, 0.0).shape == (*batch, 3)


@given(transforms(), st.floats(-200, 300), st.floats(-200, 300), st.floats(0.05, 5))
def test_points_along_the_ray_of_a_pixel_project_to_it(T_world_cam, u, v, along):
    ray = ray_directions(camera(), T_world_cam, [u, v])
    assert np.linalg.norm(ray) == pytest.approx(1)
    uv, depth = project(camera(), T_world_cam, T_world_cam[:3, 3] + along * ray)
    assert_allclose(uv, [u, v], atol=1e-6)
    assert 0 < depth <= along + 1e-9


@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-0.1, 0.4), st.floats(-0.6, 0.6))
def test_a_point_is_found_again_where_its_ray_meets_its_plane(x, y, height, tilt):
    T_world_cam = T_DOWN @ se3.transform(se3.exp_so3([tilt, tilt / 2, 0.3]), np.zeros(3))
    uv, depth = project(camera(), T_world_cam, [x, y, height])
    if depth > 0.1:
        assert_allclose(intersect_plane(camera(), T_world_cam, uv, height), [x, y, height], atol=1e-9)


def test_scaling_maps_pixel_edges_to_pixel_edges():
    large = camera().scaled(300, 240)
    small, _ = project(camera(), np.eye(4), [0.13, -0.07, 0.9])
    scaled, _ = project(large, np.eye(4), [0.13, -0.07, 0.9])
    # A pixel's centre is an integer, so its edges are half a pixel away: those scale.
    assert_allclose(scaled + 0.5, 3 * (small + 0.5))
    back = large.scaled(100, 80)
    assert_allclose([back.fx, back.fy, back.cx, back.cy], [200, 300, 50, 40])
    with pytest.raises(CalibrationError, match=r"100 x 100.*100 x 80"):
        camera().scaled(100, 100)


def test_a_hand_camera_moves_with_the_hand():
    T_world_ee = se3.from_yaw([0.1, 0.2, 0.3], 0.4)
    carried = camera(mount="ee", T=se3.from_yaw([0.05, 0, 0], 0.1))
    assert_allclose(carried.T_world_cam(T_world_ee), T_world_ee @ carried.T_mount_cam)
    assert_allclose(camera().T_world_cam(T_world_ee), T_DOWN)


def test_a_calibration_survives_its_file(tmp_path):
    cameras = {"observation.images.a": camera(), "b": camera(mount="ee", fx=123.456789012345)}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(cam.cameras_to_dict(cameras)))
    loaded = load_cameras(path)
    assert list(loaded) == list(cameras)
    for key, value in cameras.items():
        assert_allclose(loaded[key].T_mount_cam, value.T_mount_cam, rtol=0, atol=0)
        assert loaded[key].fx == value.fx
        assert loaded[key].mount == value.mount
        assert (loaded[key].width, loaded[key].height) == (100, 80)


@pytest.mark.parametrize("name", ["width", "height", "fx", "fy", "cx", "cy", "mount", "T_mount_cam"])
def test_a_missing_field_is_named_with_file_and_camera(tmp_path, name):
    broken = fields()
    del broken[name]
    path = write(tmp_path / "c.json", {"front": broken})
    with pytest.raises(CalibrationError, match=rf"{re.escape(str(path))}.*'front'.*'{name}'"):
        load_cameras(path)


SCALED = (np.diag([2.0, 1, 1, 1])).tolist()
MIRRORED = (np.diag([-1.0, 1, 1, 1])).tolist()
NAN = [[float("nan")] * 4] * 4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"T_mount_cam": SCALED}, "'T_mount_cam' is not a rigid"),
        ({"T_mount_cam": MIRRORED}, "'T_mount_cam' is not a rigid"),
        ({"T_mount_cam": NAN}, "'T_mount_cam' is not a rigid"),
        ({"T_mount_cam": np.eye(3).tolist()}, "'T_mount_cam' is not a rigid"),
        ({"T_mount_cam": [np.eye(4).tolist()] * 2}, "'T_mount_cam' is not a rigid"),
        ({"T_mount_cam": [[1, 2], [3]]}, "malformed"),
        ({"T_mount_cam": [[10**400] * 4] * 4}, "malformed"),
        ({"fx": "wide"}, "malformed"),
        ({"fx": 10**400}, "malformed"),
        ({"width": float("inf")}, "malformed"),
        ({"fx": float("nan")}, "positive and finite"),
        ({"fy": 0.0}, "positive and finite"),
        ({"width": -3}, "positive and finite"),
        ({"mount": "ceiling"}, "'mount' is 'ceiling'"),
    ],
)
def test_a_malformed_field_is_named_with_file_and_camera(tmp_path, changes, words):
    path = write(tmp_path / "c.json", {"front": fields(**changes)})
    with pytest.raises(CalibrationError, match=rf"{re.escape(str(path))}.*'front'.*{words}"):
        load_cameras(path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"version": 2}, "version 2"),
        ({"format": "other"}, "'other'"),
        ({"cameras": {}}, "'cameras'"),
        ({"cameras": [1]}, "'cameras'"),
        ({"cameras": {"front": 3}}, "malformed"),
        ({"cameras": {"front": None}}, "malformed"),
    ],
)
def test_a_file_of_another_kind_is_turned_down(tmp_path, changes, words):
    path = write(tmp_path / "c.json", **({"cameras": {"front": fields()}} | changes))
    with pytest.raises(CalibrationError, match=rf"{re.escape(str(path))}.*{words}"):
        load_cameras(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[1, 2]",
        b"\xff\xfe\x00",
        b"[" * 200_000,
        b'{"a":' * 100_000,
        b"7" * 5000,
        b" " * 1_000_001,
    ],
    ids=["empty", "truncated", "list", "binary", "deep list", "deep object", "long number", "too large"],
)
def test_what_is_no_calibration_names_the_file(tmp_path, content):
    path = tmp_path / "c.json"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match=re.escape(str(path))):
        load_cameras(path)


def test_a_missing_file_says_what_to_pass(tmp_path):
    with pytest.raises(CalibrationError, match=r"no calibration file.*--policy\.cameras"):
        load_cameras(tmp_path / "nowhere.json")
