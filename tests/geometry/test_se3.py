import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from tests.geometry.strategies import rotvecs, transforms, unit_vectors, vectors

from lerobot_openspm.geometry import se3

BATCHES = [(), (1,), (3,), (2, 3), (0,), (2, 0, 3)]


def rodrigues(axis, angle):
    """Rotation matrix by Rodrigues' formula, written out, as a second opinion."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def batch_of(batch, seed=0):
    rng = np.random.default_rng(seed)
    return se3.transform(se3.exp_so3(rng.normal(size=(*batch, 3))), rng.normal(size=(*batch, 3)))


@given(transforms())
def test_a_transform_times_its_inverse_is_the_identity(T):
    assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-12)
    assert_allclose(T @ se3.inverse(T), np.eye(4), atol=1e-12)
    assert_allclose(se3.inverse(T), np.linalg.inv(T), atol=1e-12)


@given(transforms(), transforms(), transforms())
def test_composition_is_associative_and_stays_rigid(A, B, C):
    assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-12)
    assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-12)
    assert se3.is_rigid(A @ B @ C)


@given(unit_vectors(), st.floats(-20, 20))
def test_exp_is_rodrigues_formula_for_angles_of_any_size(axis, angle):
    assert_allclose(se3.exp_so3(axis * angle), rodrigues(axis, angle), atol=1e-12)


@given(rotvecs())
def test_log_undoes_exp_below_pi(rotvec):
    assert_allclose(se3.log_so3(se3.exp_so3(rotvec)), rotvec, atol=1e-9)


@given(unit_vectors(), st.floats(np.pi - 1e-6, 4 * np.pi))
def test_log_of_turns_of_pi_and_more_gives_the_same_rotation_by_at_most_pi(axis, angle):
    R = se3.exp_so3(axis * angle)
    rotvec = se3.log_so3(R)
    assert np.linalg.norm(rotvec) <= np.pi + 1e-9
    assert_allclose(se3.exp_so3(rotvec), R, atol=1e-9)


def test_a_positive_turn_about_z_takes_x_to_y():
    T = se3.from_yaw([1.0, 2.0, 3.0], np.pi / 2)
    assert_allclose(se3.apply(T, [[1.0, 0, 0]]), [[1.0, 3.0, 3.0]], atol=1e-12)
    assert_allclose(se3.yaw_of(T), np.pi / 2)


def test_quaternions_have_their_real_part_last():
    half = np.sqrt(0.5)
    assert_allclose(
        se3.matrix_from_quat_xyzw([0, 0, half, half]), rodrigues([0, 0, 1], np.pi / 2), atol=1e-12
    )


@given(transforms(), transforms())
def test_apply_increment_undoes_increment(A, B):
    assert_allclose(se3.apply_increment(A, se3.increment(A, B)), B, atol=1e-7)


@given(transforms(), vectors(), rotvecs())
def test_increment_undoes_apply_increment(T, shift, turn):
    step = np.concatenate([shift, turn])
    assert_allclose(se3.increment(T, se3.apply_increment(T, step)), step, atol=1e-7)


def test_increments_are_left_multiplied_and_in_the_outer_frame():
    # A hand turned by 90 degrees about z; a further turn about the world's x.
    start = se3.from_yaw([0.5, 0.0, 0.0], np.pi / 2)
    moved = se3.apply_increment(start, [0.1, 0, 0, np.pi / 2, 0, 0])
    assert_allclose(moved[:3, 3], [0.6, 0, 0], atol=1e-12)
    # Its own x axis pointed along the world's y, which the turn takes to z.
    assert_allclose(moved[:3, 0], [0, 0, 1], atol=1e-12)


@given(transforms(), transforms(), transforms())
def test_distances_are_symmetric_and_the_same_from_any_frame(G, A, B):
    assert_allclose(se3.distances(A, B), se3.distances(B, A), atol=1e-7)
    assert_allclose(se3.distances(G @ A, G @ B), se3.distances(A, B), atol=1e-7)
    assert se3.distance(A, A) == pytest.approx(0, abs=1e-7)


def test_distance_counts_a_radian_as_ten_centimetres():
    A, B = se3.from_yaw([0, 0, 0], 0.0), se3.from_yaw([0.03, 0.04, 0], -0.5)
    assert_allclose(se3.distances(A, B), (0.05, 0.5))
    assert se3.distance(A, B) == pytest.approx(0.05 + 0.1 * 0.5)


@pytest.mark.parametrize("batch", BATCHES)
def test_every_function_keeps_leading_axes_and_computes_each_element_alone(batch):
    T, U = batch_of(batch, 1), batch_of(batch, 2)
    points = np.random.default_rng(3).normal(size=(*batch, 5, 3))
    step = np.random.default_rng(4).normal(size=(*batch, 6))
    quat = np.random.default_rng(5).normal(size=(*batch, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    cases = {
        "inverse": (se3.inverse, (T,), (4, 4)),
        "exp": (se3.exp_so3, (step[..., 3:],), (3, 3)),
        "log": (se3.log_so3, (T[..., :3, :3],), (3,)),
        "quat": (se3.matrix_from_quat_xyzw, (quat,), (3, 3)),
        "apply": (se3.apply, (T, points), (5, 3)),
        "increment": (se3.increment, (T, U), (6,)),
        "apply_increment": (se3.apply_increment, (T, step), (4, 4)),
        "distance": (se3.distance, (T, U), ()),
        "yaw_of": (se3.yaw_of, (T,), ()),
        "from_yaw": (se3.from_yaw, (step[..., :3], step[..., 5]), (4, 4)),
    }
    for name, (function, arguments, shape) in cases.items():
        out = function(*arguments)
        assert out.shape == (*batch, *shape), name
        for i in np.ndindex(*batch):
            assert_allclose(out[i], function(*(a[i] for a in arguments)), atol=1e-12, err_msg=name)


def test_one_transform_is_broadcast_over_many():
    many = batch_of((4, 3))
    assert_allclose(se3.increment(many[0, 0], many)[2, 1], se3.increment(many[0, 0], many[2, 1]), atol=1e-12)
    assert se3.transform(np.eye(3), np.zeros((4, 3, 3))).shape == (4, 3, 4, 4)


@given(st.floats(-50, 50), st.sampled_from([2 * np.pi, np.pi, np.pi / 2, 1.0]))
def test_wrapped_angles_lie_in_one_period_and_differ_by_whole_ones(angle, period):
    wrapped = se3.wrap_angle(angle, period)
    assert -period / 2 - 1e-9 <= wrapped <= period / 2
    assert (angle - wrapped) / period == pytest.approx(round((angle - float(wrapped)) / period), abs=1e-6)


@pytest.mark.parametrize(("period", "count"), [(0.0, 1), (2 * np.pi, 1), (np.pi, 2), (np.pi / 2, 4)])
def test_yaw_equivalents_are_turns_about_the_objects_own_axis(period, count):
    T = se3.transform(se3.exp_so3([0.4, 0.2, 1.0]), [0.3, -0.2, 0.1])
    equivalents = se3.yaw_equivalents(T, period)
    assert len(equivalents) == count
    assert_allclose(equivalents[0], T, atol=1e-12)
    for k, E in enumerate(equivalents):
        assert_allclose(E[:3, 3], T[:3, 3], atol=1e-12)
        assert_allclose(E[:3, 2], T[:3, 2], atol=1e-12)
        assert_allclose(se3.distances(T, E)[1], min(k, count - k) * period, atol=1e-7)


def test_is_rigid_turns_down_whatever_is_not():
    T = batch_of((2,))
    assert se3.is_rigid(T)
    assert se3.is_rigid(np.zeros((0, 4, 4)))
    spoilt = {
        "NaN": (0, 3, np.nan), "infinite": (1, 3, np.inf), "scaled": (0, 0, 2.0), "huge": (0, 0, 1e300),
        "last row": (3, 0, 0.1), "last one": (3, 3, 0.0),
    }  # fmt: skip
    for name, (row, column, value) in spoilt.items():
        bad = T.copy()
        bad[1, row, column] = value
        assert not se3.is_rigid(bad), name
    mirrored = T.copy()
    mirrored[1, :3, 0] *= -1
    assert not se3.is_rigid(mirrored)
    assert not se3.is_rigid(np.eye(3))
