import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose
from tests.geometry.strategies import rotvecs

from lerobot_openspm.errors import LayoutError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.vector_layout import parse_layout

AXIS_ANGLE = ["axis_angle_x", "axis_angle_y", "axis_angle_z"]
TABLETOP_STATE = ["x", "y", "z", *AXIS_ANGLE, "finger_left", "finger_right"]
TABLETOP_ACTION = ["delta_x", "delta_y", "delta_z", *(f"delta_{name}" for name in AXIS_ANGLE), "gripper"]
LIBERO_STATE = ["x", "y", "z", "roll", "pitch", "yaw", "gripper", "gripper"]


def test_the_tabletops_names():
    layout = parse_layout(TABLETOP_STATE, "state")
    assert layout.position == (0, 1, 2)
    assert layout.rotation == (3, 4, 5)
    assert layout.rotation_kind == "axis_angle"
    assert layout.gripper == (6, 7)
    action = parse_layout(TABLETOP_ACTION, "action")
    assert (action.position, action.rotation, action.gripper) == ((0, 1, 2), (3, 4, 5), (6,))


def test_liberos_roll_pitch_yaw_are_an_axis_angle_when_told_so():
    state = [0.1, 0.2, 0.3, 3.4, 0.5, -0.2, 0.03, -0.02]  # an axis angle beyond pi
    layout = parse_layout(LIBERO_STATE, "state", "axis_angle")
    assert_allclose(layout.poses(state), se3.transform(se3.exp_so3(state[3:6]), state[:3]))
    assert layout.openings(state) == pytest.approx(0.05)
    believed = parse_layout(LIBERO_STATE, "state").poses(state)
    assert not np.allclose(believed, layout.poses(state))


def test_euler_angles_are_extrinsic_xyz():
    layout = parse_layout(["x", "y", "z", "roll", "pitch", "yaw", "gripper"], "state")
    R = layout.poses([0, 0, 0, 0.3, -0.4, 1.1, 0])[:3, :3]
    turn = lambda axis, angle: se3.exp_so3(angle * np.eye(3)[axis])  # noqa: E731
    assert_allclose(R, turn(2, 1.1) @ turn(1, -0.4) @ turn(0, 0.3), atol=1e-12)


def test_names_decide_and_not_their_order():
    names = ["gripper", "qw", "qx", "qy", "qz", "pos_z", "pos_y", "pos_x"]
    layout = parse_layout(names, "state")
    half = np.sqrt(0.5)
    T = layout.poses([0.04, half, 0, 0, half, 3.0, 2.0, 1.0])
    assert_allclose(T, se3.from_yaw([1.0, 2.0, 3.0], np.pi / 2), atol=1e-12)


def test_a_robot_without_rotation_keeps_its_hand_upright():
    layout = parse_layout(["x", "y", "z", "gripper"], "state")
    assert layout.rotation_kind == "none"
    assert_allclose(layout.poses([[1.0, 2, 3, 0]])[0], se3.transform(np.eye(3), [1, 2, 3]))
    action = layout.decode_actions([0.1, 0.2, 0.3, -1.0])
    assert_allclose(action, [0.1, 0.2, 0.3, 0, 0, 0, -1])
    assert_allclose(layout.encode_actions([0.1, 0.2, 0.3, 9, 9, 9, -1]), [0.1, 0.2, 0.3, -1])


def test_a_rotation_can_be_ignored():
    layout = parse_layout(TABLETOP_ACTION, "action", "none")
    assert_allclose(layout.decode_actions([1, 2, 3, 4, 5, 6, 7]), [1, 2, 3, 0, 0, 0, 7])
    assert_allclose(layout.encode_actions([1, 2, 3, 4, 5, 6, 7]), [1, 2, 3, 0, 0, 0, 7])


@pytest.mark.parametrize(
    "names",
    [
        TABLETOP_ACTION,
        ["dx", "dy", "dz", "drx", "dry", "drz", "gripper"],
        ["gripper", "x", "y", "z", "quat_x", "quat_y", "quat_z", "quat_w"],
        ["yaw", "pitch", "roll", "x", "y", "z", "gripper", "spare"],
    ],
)
@given(rotvec=rotvecs(1.4))
def test_encoding_undoes_decoding(names, rotvec):
    layout = parse_layout(names, "action")
    actions = np.tile(np.concatenate([[0.1, -0.2, 0.3], rotvec, [-1.0]]), (2, 3, 1))
    vectors = layout.encode_actions(actions)
    assert vectors.shape == (2, 3, len(names))
    assert_allclose(layout.decode_actions(vectors), actions, atol=1e-8)


def test_commanded_axis_angles_are_left_as_they_are_even_beyond_pi():
    layout = parse_layout(TABLETOP_ACTION, "action")
    assert_allclose(layout.decode_actions([0, 0, 0, 4.0, 0, 0, 1]), [0, 0, 0, 4.0, 0, 0, 1])


@pytest.mark.parametrize("batch", [(), (1,), (4,), (2, 3)])
def test_leading_axes_are_kept(batch):
    layout = parse_layout(TABLETOP_STATE, "state")
    vectors = np.ones((*batch, 8))
    assert layout.poses(vectors).shape == (*batch, 4, 4)
    assert layout.openings(vectors).shape == batch
    assert layout.decode_actions(vectors).shape == (*batch, 7)


@pytest.mark.parametrize(
    ("names", "kind", "words"),
    [
        (["x", "y", "gripper"], None, r"lack \['z'\]"),
        ([], None, r"lack \['x', 'y', 'z'\]"),
        (["x", "y", "z", "roll", "pitch", "gripper"], None, "incomplete rotation"),
        (["x", "y", "z", "roll", "pitch", "yaw", "rx", "ry", "rz", "gripper"], None, "several rotations"),
        (["x", "y", "z"], None, "no gripper or finger"),
        (["x", "y", "z", "gripper"], "quat", r"0 rotation numbers.*'quat' has 4"),
        (["x", "y", "z", "roll", "pitch", "yaw", "gripper"], "quat", r"3 rotation numbers.*'quat' has 4"),
    ],
)
def test_names_that_make_no_layout_are_repeated_in_the_error(names, kind, words):
    with pytest.raises(LayoutError, match=words) as caught:
        parse_layout(names, "action", kind)
    assert str(names) in str(caught.value)
    assert "--policy.action_layout" in str(caught.value)


@pytest.mark.parametrize("method", ["poses", "openings", "decode_actions"])
@pytest.mark.parametrize("shape", [(7,), (3, 9), ()])
def test_vectors_of_another_size_say_what_came_and_what_was_expected(method, shape):
    layout = parse_layout(TABLETOP_STATE, "state")
    with pytest.raises(LayoutError) as caught:
        getattr(layout, method)(np.zeros(shape))
    assert str(shape) in str(caught.value)
    assert "a last axis of 8" in str(caught.value)
