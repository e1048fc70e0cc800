import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import load_arm

LIBERO = "configs/arms/libero_panda.urdf"
# Read off LIBERO's simulator after a reset.
HOME = np.array([0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.2267522, np.pi / 4])

# Two joints about z, half a metre apart, and a hand 0.3 m further.
PLANAR = """<robot name="planar">
  <link name="world"/><link name="upper"/><link name="lower"/><link name="ee"/>
  <joint name="shoulder" type="revolute"><parent link="world"/><child link="upper"/>
    <origin xyz="1 0 0"/><axis xyz="0 0 2"/><limit lower="-2" upper="2"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.5 0 0" rpy="0 0 0"/><axis xyz="0 0 1"/><limit lower="0" upper="{upper}"/></joint>
  <joint name="tool" type="{kind}"><parent link="lower"/><child link="{tool}"/>
    <origin xyz="0.3 0 0"/></joint>
</robot>"""


def planar(tmp_path, upper="2.5", kind="fixed", tool="ee"):
    path = tmp_path / "planar.urdf"
    path.write_text(PLANAR.format(upper=upper, kind=kind, tool=tool))
    return path


@pytest.fixture(scope="module")
def panda(request):
    return load_arm(request.config.rootpath / LIBERO)


def test_two_joints_by_hand(tmp_path):
    T = load_arm(planar(tmp_path)).ee_pose(np.array([np.pi / 2, np.pi / 2]))
    assert_allclose(T, se3.from_yaw([1 - 0.3, 0.5, 0.0], np.pi), atol=1e-12)


def test_a_panda_at_home_looks_down_in_front_of_its_base(panda):
    T = panda.ee_pose(HOME)
    assert_allclose(T[:3, 3], [-0.2085, 0.0, 1.1733], atol=1e-3)  # read off LIBERO's simulator
    assert_allclose(T[:3, 2], [0.0, 0.0, -1.0], atol=0.06)


@given(seed=st.integers(0, 10_000))
def test_what_joints_within_their_limits_reach_is_reached(panda, seed):
    low, high = np.stack([joint.limits for joint in panda.joints]).T
    angles = np.clip(HOME + np.random.default_rng(seed).normal(0, 0.25, 7), low + 0.01, high - 0.01)
    T = panda.ee_pose(angles)
    found = panda.angles_for(T, HOME, HOME)
    assert (found >= low).all()
    assert (found <= high).all()
    assert_allclose(panda.ee_pose(found), T, atol=1e-4)


def test_nearly_all_that_joints_reach_is_found_from_wherever_it_is_sought(panda):
    low, high = np.stack([joint.limits for joint in panda.joints]).T
    poses = [panda.ee_pose(angles) for angles in np.random.default_rng(5).uniform(low, high, (200, 7))]
    misses = np.array([panda.miss(T, panda.angles_for(T, panda.middle, panda.middle)) for T in poses])
    assert (misses < [0.001, 0.01]).all(1).mean() >= 0.99


def test_a_hand_that_is_half_a_turn_off_is_turned_round(panda):
    T = panda.ee_pose(HOME) @ se3.from_yaw(np.zeros(3), np.pi)
    assert_allclose(panda.miss(T, HOME), [0.0, np.pi], atol=1e-6)
    assert_allclose(panda.ee_pose(panda.angles_for(T, HOME, HOME)), T, atol=1e-4)


def test_what_is_too_far_away_is_missed_by_so_much(tmp_path):
    arm = load_arm(planar(tmp_path))
    start = arm.ee_pose(np.array([0.1, 0.5]))
    near, far = arm.misses([arm.ee_pose(np.array([0.4, 1.0])), se3.from_yaw([2.0, 0.0, 0.0], 0.0)], start)
    assert_allclose(near, 0.0, atol=1e-4)
    assert_allclose(far[0], 0.2, atol=1e-3)  # it is 0.8 m long, and stands at x = 1


def test_a_limit_keeps_the_arm_from_a_pose(tmp_path):
    T = load_arm(planar(tmp_path)).ee_pose(np.array([0.0, 2.0]))
    limited = load_arm(planar(tmp_path, upper="1.0"))
    ((metres, radians),) = limited.misses([T], limited.ee_pose(np.array([0.0, 0.5])))
    assert metres > 0.05 or radians > 0.5


def test_the_room_of_joints_is_that_of_the_nearest_to_its_limit(tmp_path):
    arm = load_arm(planar(tmp_path, upper="1.0"))
    low, high = np.stack([joint.limits for joint in arm.joints]).T
    assert arm.room(arm.middle) == pytest.approx((high - low).min() / 2)
    assert arm.room(np.array([0.0, 0.9])) == pytest.approx(0.1)
    assert arm.room(np.array([low[0] + 0.05, 0.9])) == pytest.approx(0.05)
    assert_allclose(arm.base, arm.joints[0].T_before_joint[:3, 3])


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"tool": "flange"}, "no joint leads to a link 'ee'"),
        ({"kind": "prismatic"}, "of type 'prismatic'"),
        ({"upper": "-1"}, "limits of joint 'elbow'"),
        ({"upper": "nan"}, "limits of joint 'elbow'"),
        ({"upper": "wide"}, "not a URDF that can be read"),
    ],
)
def test_a_bad_urdf_is_refused_by_name(tmp_path, changes, told):
    with pytest.raises(CalibrationError, match=told) as error:
        load_arm(planar(tmp_path, **changes))
    assert "planar.urdf" in str(error.value)


def test_a_missing_urdf_says_what_to_pass(tmp_path):
    with pytest.raises(CalibrationError, match=r"--policy\.arm=FILE"):
        load_arm(tmp_path / "none.urdf")


def test_a_circle_of_links_is_refused(tmp_path):
    path = tmp_path / "circle.urdf"
    joint = '<joint name="{0}" type="fixed"><parent link="{0}"/><child link="{1}"/></joint>'
    path.write_text("<robot>" + joint.format("ee", "a") + joint.format("a", "ee") + "</robot>")
    with pytest.raises(CalibrationError, match="circle"):
        load_arm(path)
