import numpy as np
import pytest
from benchmarks.truth import Truth, pose_error, true_period
from hypothesis import given
from numpy.testing import assert_allclose
from tests.geometry.strategies import transforms

from lerobot_openspm.geometry import se3

TABLETOP, LIBERO = "openspm_tabletop", "libero"


def test_what_does_not_move_is_where_its_frame_was_put():
    T_sim, T_sim_obj = se3.from_yaw([0.1, 0.2, 0.03], 0.4), se3.from_yaw([0.01, 0.0, -0.03], 0.2)
    now = Truth({"bottle": T_sim}, {"wine bottle": T_sim_obj}).now({"bottle": T_sim})
    assert_allclose(now["wine bottle"], T_sim @ T_sim_obj, atol=1e-12)


@given(T_moved=transforms())
def test_the_truth_is_carried_along_by_the_objects_own_motion(T_moved):
    """Also for a body that is modelled lying down."""
    lying = se3.transform(se3.exp_so3([np.pi / 2, 0.0, 0.3]), [0.1, 0.2, 0.0])
    truth = Truth({"bottle": lying}, {"wine bottle": se3.from_yaw([0.0, 0.01, 0.0], 0.1)})
    start, after = truth.now({"bottle": lying}), truth.now({"bottle": T_moved @ lying})
    assert_allclose(after["wine bottle"], T_moved @ start["wine bottle"], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "env_type", "period"),
    [
        ("wine bottle", TABLETOP, 0.0), ("bowl", LIBERO, 0.0), ("cream cheese box", TABLETOP, np.pi),
        ("cream cheese", LIBERO, np.pi), ("rack", TABLETOP, np.pi), ("rack", LIBERO, 2 * np.pi),
        ("stove", TABLETOP, 2 * np.pi),
    ],
)  # fmt: skip
def test_true_periods(name: str, env_type: str, period: float):
    assert true_period(name, env_type) == period


def test_errors_are_up_to_what_looks_the_same():
    there, turned = np.eye(4), se3.from_yaw([0.003, 0.0, 0.004], np.pi + 0.1)
    assert pose_error(there, turned, np.pi) == pytest.approx((0.005, 0.1))
    assert pose_error(there, turned, 2 * np.pi)[1] == pytest.approx(np.pi - 0.1)
    assert pose_error(there, turned, 0.0)[1] == pytest.approx(0.0, abs=1e-6)
    tilted = se3.transform(se3.exp_so3([0.2, 0.0, 0.0]), np.zeros(3)) @ se3.from_yaw(np.zeros(3), 1.0)
    assert pose_error(there, tilted, 0.0)[1] == pytest.approx(0.2)
