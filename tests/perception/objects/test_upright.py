import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.geometry.strategies import transforms

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.sam3d.reconstruction import make_upright

SIZES = st.tuples(*[st.floats(0.005, 0.5)] * 3).map(np.array)
# Ways to name a box's axes that keep them right-handed.
NAMINGS = np.round(
    se3.exp_so3(np.pi / 2 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 2, 0], [2, 0, 0]]))
)


def corners(extents):
    return np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * extents


def in_any_order(points):
    return points[np.lexsort(np.round(points, 6).T)]


@given(
    st.floats(-np.pi, np.pi),
    st.floats(0, 0.7),
    st.floats(-np.pi, np.pi),
    SIZES,
    st.integers(0, len(NAMINGS) - 1),
)
def test_a_tilted_box_stands_up_again(yaw, tilt, direction, sizes, naming):
    length, width, height = sizes
    length, width = max(length, width) + 0.001, min(length, width)
    foot = np.array([0.3, -0.2, 0.7])
    T_world_obj = se3.from_yaw(foot, yaw)
    centre = foot + np.array([0, 0, height / 2])
    lean = se3.exp_so3(tilt * np.array([np.cos(direction), np.sin(direction), 0]))
    R_obj_box = NAMINGS[naming]
    T_world_box = se3.transform(lean @ T_world_obj[:3, :3] @ R_obj_box, centre)
    extents = np.abs(R_obj_box.T) @ [length, width, height]

    T_upright, size, turned_by = make_upright(T_world_box, extents)

    np.testing.assert_allclose(size, [length, width, height], atol=1e-9)
    np.testing.assert_allclose(T_upright[:3, 3], foot, atol=1e-9)
    assert turned_by == pytest.approx(tilt, abs=1e-7)
    turned = se3.wrap_angle(se3.yaw_of(T_upright) - yaw, np.pi)
    assert np.isclose(turned, 0, atol=1e-7)
    assert -np.pi / 2 <= se3.yaw_of(T_upright) < np.pi / 2 + 1e-12


@given(st.floats(-np.pi, np.pi), SIZES, st.integers(0, len(NAMINGS) - 1))
def test_an_upright_box_stays_where_it_is(yaw, sizes, naming):
    centre = np.array([0.1, 0.2, 0.3])
    T_world_box = se3.from_yaw(centre, yaw) @ se3.transform(NAMINGS[naming], np.zeros(3))
    T_upright, extents, _ = make_upright(T_world_box, sizes)
    after = se3.apply(T_upright, corners(extents) + np.array([0, 0, extents[2] / 2]))
    before = se3.apply(T_world_box, corners(sizes))
    np.testing.assert_allclose(in_any_order(after), in_any_order(before), atol=1e-6)


@given(transforms(), SIZES)
def test_whatever_the_pose_the_result_is_upright_and_keeps_centre_and_size(T_world_box, sizes):
    T_upright, extents, tilt = make_upright(T_world_box, sizes)
    assert se3.is_rigid(T_upright)
    np.testing.assert_allclose(T_upright[2], [0, 0, 1, T_upright[2, 3]], atol=1e-12)
    assert extents[0] >= extents[1]
    assert sorted(extents) == sorted(sizes)
    assert 0 <= tilt <= np.arccos(1 / np.sqrt(3)) + 1e-9
    middle = T_upright[:3, 3] + [0, 0, extents[2] / 2]
    np.testing.assert_allclose(middle, T_world_box[:3, 3], atol=1e-12)


def test_a_box_that_lies_on_its_side_stays_there():
    T_world_box = se3.transform(se3.exp_so3([np.pi / 2, 0, 0]), np.zeros(3))
    _, extents, tilt = make_upright(T_world_box, np.array([3, 2, 1.0]))
    np.testing.assert_allclose(extents, [3, 1, 2])
    assert tilt == pytest.approx(0)
