import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose
from tests.geometry.strategies import transforms

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.tracking.tracker import (
    FALLEN_M,
    FALLING_S,
    Tracker,
    TrackerSettings,
    TrackStatus,
    nearest_equivalent,
)
from lerobot_openspm.types import PoseEstimate

COVARIANCE = np.diag([1e-6, 1e-6, 1e-6, 1e-4])
CUP = se3.from_yaw([0.1, 0.2, 0.0], 0.4)
FAR_HAND = se3.transform(np.diag([1.0, -1.0, -1.0]), [-0.4, -0.4, 0.5])
LOOK_S = 0.25


def seen(T, status="found", **changes):
    fields = {"covariance": COVARIANCE, "confidence": 1.0, **changes}
    return PoseEstimate(status, T, **fields)


def unseen(visible=1.0):
    return seen(np.eye(4), "not_found", confidence=0.0, visible=visible)


def shifted(T, *by):
    return se3.transform(T[:3, :3], T[:3, 3] + by)


def tracker(periods=None, **settings):
    one = Tracker(periods or {"cup": 2 * np.pi}, TrackerSettings(**settings))
    assert one.look({"cup": seen(CUP)}, FAR_HAND, 0.0) == {"cup"}
    return one


def look(one, estimate, hand=FAR_HAND):
    one.predict(LOOK_S)
    return one.look({"cup": estimate}, hand, LOOK_S)


def pose(one, hand=FAR_HAND):
    return one.poses(hand)["cup"]


def test_what_was_never_seen_is_lost_and_has_no_pose():
    one = Tracker({}, TrackerSettings())
    assert one.look({"cup": unseen()}, FAR_HAND, 0.0) == frozenset()
    assert one.status("cup") is TrackStatus.LOST
    assert one.poses(FAR_HAND) == {}


def test_noise_is_averaged_out():
    rng = np.random.default_rng(0)
    one = tracker()
    raw, kept = [], []
    for _ in range(200):
        noisy = se3.apply_increment(CUP, np.array([*rng.normal(0, 1e-3, 2), 0, 0, 0, rng.normal(0, 1e-2)]))
        assert look(one, seen(noisy)) == frozenset()
        raw.append(noisy[:2, 3] - CUP[:2, 3])
        kept.append(pose(one)[:2, 3] - CUP[:2, 3])
    assert np.std(kept) < 0.8 * np.std(raw)
    assert abs(np.mean(kept)) < 3e-4
    assert one.status("cup") is TrackStatus.TRACKED


def test_the_output_is_the_papers_mean_of_the_filter_and_the_output_before():
    smooth, raw = tracker(smoothing=0.3, smoothing_rotation=0.5), tracker(smoothing=1, smoothing_rotation=1)
    near = shifted(CUP, 0.002, 0.0, 0.0) @ se3.from_yaw(np.zeros(3), 0.02)
    for one in (smooth, raw):
        look(one, seen(near))
    change = pose(raw)[:3, 3] - CUP[:3, 3]
    assert_allclose(pose(smooth)[:3, 3] - CUP[:3, 3], 0.3 * change, atol=1e-12)
    turned = [float(se3.yaw_of(pose(one)) - se3.yaw_of(CUP)) for one in (smooth, raw)]
    assert turned[0] == pytest.approx(0.5 * turned[1], rel=1e-6)
    assert 0 < turned[1] < 0.02


def test_a_jump_is_believed_at_the_second_look_that_agrees():
    one, there = tracker(), shifted(CUP, 0.1, 0.0, 0.0)
    assert look(one, seen(there)) == frozenset()
    assert one.status("cup") is TrackStatus.AMBIGUOUS
    assert one.doubtful
    assert_allclose(pose(one), CUP)
    assert one.displaced == set()
    assert look(one, seen(shifted(there, 0.004, 0.0, 0.0))) == {"cup"}
    assert one.displaced == {"cup"}
    assert_allclose(pose(one), shifted(there, 0.004, 0.0, 0.0))
    assert one.status("cup") is TrackStatus.TRACKED


@pytest.mark.parametrize("change", [lambda one: one.hold("cup", FAR_HAND), lambda one: one.forget(["cup"])])
def test_what_the_hand_took_and_what_a_name_stood_for_before_need_not_be_where_it_was(change):
    one = tracker()
    change(one)
    assert one.displaced == {"cup"}


def test_two_looks_at_different_places_are_no_agreement():
    one = tracker()
    for x in (0.1, -0.1, 0.2, -0.2):
        assert look(one, seen(shifted(CUP, x, 0.0, 0.0))) == frozenset()
    assert_allclose(pose(one), CUP)


@pytest.mark.parametrize("poor", [{"confidence": 0.8}, {"visible": 0.3}, {"status": "ambiguous"}])
def test_a_poor_sight_changes_nothing(poor):
    one = tracker()
    for _ in range(5):
        status = poor.get("status", "found")
        changes = {k: v for k, v in poor.items() if k != "status"}
        look(one, seen(shifted(CUP, 0.1, 0.0, 0.0), status, **changes))
    assert_allclose(pose(one), CUP)


def test_what_is_half_out_of_all_views_at_first_is_not_followed_until_more_of_it_is_seen():
    one = Tracker({"cup": 2 * np.pi}, TrackerSettings())
    assert look(one, seen(CUP, visible=0.4)) == frozenset()
    assert one.poses(FAR_HAND) == {}
    assert look(one, seen(CUP, visible=0.6)) == {"cup"}
    assert_allclose(pose(one), CUP)


def test_two_places_that_explain_the_pictures_are_ambiguous_then_stale_then_lost():
    one = tracker()
    statuses = []
    for _ in range(10):
        look(one, seen(shifted(CUP, 0.1, 0.0, 0.0), "ambiguous"))
        statuses.append(one.status("cup"))
    assert statuses[0] is TrackStatus.AMBIGUOUS
    assert statuses[1:7] == [TrackStatus.STALE] * 6
    assert statuses[-1] is TrackStatus.LOST


def test_a_hidden_object_is_not_carried_off_by_a_velocity_of_noise():
    rng = np.random.default_rng(3)
    far = []
    for _ in range(20):
        one = tracker()
        for _ in range(12):
            look(one, seen(shifted(CUP, *rng.normal(0, 1e-3, 2), 0.0)))
        for _ in range(40):  # ten seconds
            look(one, unseen(visible=0.0))
        look(one, seen(CUP))
        far.append(np.linalg.norm(pose(one)[:3, 3] - CUP[:3, 3]))
    assert max(far) < 0.003


def test_doubt_makes_one_look_enough_but_no_glimpse():
    one, there = tracker(), shifted(CUP, 0.1, 0.0, 0.0)
    one.doubt(["cup", "never seen"], FAR_HAND)
    assert look(one, seen(there, confidence=0.8)) == frozenset()
    assert look(one, seen(there)) == {"cup"}
    assert look(one, seen(CUP)) == frozenset(), "doubt ends with the next sure sight"


def test_what_should_be_seen_and_is_not_gets_stale_then_lost_then_is_found_again():
    one = tracker()
    statuses = []
    for _ in range(10):
        look(one, unseen())
        statuses.append(one.status("cup"))
    assert statuses[0] is TrackStatus.TRACKED
    assert statuses[1:7] == [TrackStatus.STALE] * 6
    assert statuses[7:] == [TrackStatus.LOST] * 3
    look(one, seen(CUP))
    assert one.status("cup") is TrackStatus.TRACKED


@pytest.mark.parametrize(
    ("estimate", "hand"),
    [
        (unseen(visible=0.2), FAR_HAND),
        (unseen(), shifted(CUP, 0.0, 0.0, 0.15)),  # the hand is about
        (seen(CUP, confidence=0.7), FAR_HAND),
    ],
)
def test_what_is_hidden_is_not_lost(estimate, hand):
    one = tracker()
    for _ in range(20):
        look(one, estimate, hand)
    assert one.status("cup") is TrackStatus.HIDDEN
    assert_allclose(pose(one), CUP)


@given(T_first=transforms(), T_second=transforms())
def test_a_held_object_moves_with_the_hand(T_first, T_second):
    one = tracker()
    one.hold("cup", T_first)
    assert one.held == {"cup"}
    assert_allclose(pose(one, T_first), CUP, atol=1e-9)
    moved = T_second @ se3.inverse(T_first) @ CUP
    assert_allclose(pose(one, T_second), moved, atol=1e-8)
    one.release(["cup"], T_second)
    assert one.held == frozenset()
    assert_allclose(pose(one, T_first), moved, atol=1e-8)
    assert one.status("cup") is TrackStatus.TRACKED


def test_a_held_object_that_slips_is_followed_and_one_that_falls_is_let_go():
    one = tracker()
    one.hold("cup", FAR_HAND)
    lifted = shifted(FAR_HAND, 0.0, 0.1, 0.1)
    slipped = shifted(CUP, 0.004, 0.1, 0.1)
    for _ in range(30):
        assert look(one, seen(slipped), lifted) == frozenset()
    assert_allclose(pose(one, lifted), slipped, atol=1.5e-3)
    assert one.status("cup") is TrackStatus.HELD
    fallen = shifted(CUP, -0.1, 0.0, 0.0)
    assert look(one, seen(fallen), lifted) == frozenset()
    assert look(one, seen(fallen), lifted) == {"cup"}
    assert one.held == frozenset()
    assert_allclose(pose(one, lifted), fallen)


def test_what_the_hand_has_lost_lies_below_it_no_higher_than_it_was_taken_from():
    for to, expected in (((0.1, 0.0, 0.15), (0.1, 0.0, 0.0)), ((0.0, 0.1, -0.02), (0.0, 0.1, -0.02))):
        one = tracker()
        one.hold("cup", FAR_HAND)
        moved = shifted(FAR_HAND, *to)
        one.drop(["cup", "never seen"], moved)
        assert one.held == frozenset()
        assert_allclose(pose(one, FAR_HAND), shifted(CUP, *expected), atol=1e-12)
        assert look(one, seen(shifted(CUP, *expected))) == frozenset(), "it is expected there"
        one.drop(["cup"], moved)
        assert_allclose(pose(one)[:3, 3], shifted(CUP, *expected)[:3, 3], atol=1e-4)


@pytest.mark.parametrize("by", [FALLEN_M + 0.001, FALLEN_M - 0.001, -FALLEN_M - 0.001])
def test_what_is_lost_higher_or_lower_than_it_was_taken_from_may_lie_anywhere_once_it_has_come_to_rest(by):
    one, hand, is_fallen = tracker(), shifted(FAR_HAND, 0.1, 0.0, by), abs(by) > FALLEN_M
    one.hold("cup", FAR_HAND)
    one.doubt(["cup"], hand)
    fallen = {"cup"} if is_fallen else frozenset()
    assert (one.fallen, one.falling) == (fallen, fallen)
    one.predict(FALLING_S - 0.001)
    assert one.falling == fallen
    one.predict(0.002)
    assert (one.fallen, one.falling) == (fallen, frozenset())
    # Not seen where it may lie, it is not given up.
    for _ in range(20):
        look(one, unseen(), FAR_HAND)
    assert one.status("cup") is (TrackStatus.HIDDEN if is_fallen else TrackStatus.LOST)
    there = shifted(CUP, 0.3, 0.2, -0.1)
    assert look(one, seen(there)) == {"cup"}
    assert_allclose(pose(one), there)
    assert one.fallen == frozenset()


@pytest.mark.parametrize("again", ["seen where it is taken to be", "taken hold of"])
def test_what_has_fallen_is_known_again_once_it_is(again):
    one = tracker()
    one.hold("cup", FAR_HAND)
    one.drop(["cup"], shifted(FAR_HAND, 0.0, 0.0, 2 * FALLEN_M))
    assert one.fallen == {"cup"}
    if again == "taken hold of":
        one.hold("cup", FAR_HAND)
    else:
        one.predict(FALLING_S)
        assert look(one, seen(CUP)) == frozenset()
    assert (one.fallen, one.falling) == (frozenset(), frozenset())


def test_objects_do_not_disturb_one_another():
    alone, both = tracker(), tracker()
    plate = shifted(CUP, -0.3, 0.0, 0.0)
    both.look({"plate": seen(plate)}, FAR_HAND, 0.0)
    for x in (0.001, 0.002, 0.1, 0.1):
        near = seen(shifted(CUP, x, 0.0, 0.0))
        look(alone, near)
        both.predict(LOOK_S)
        both.look({"plate": unseen(), "cup": near}, FAR_HAND, LOOK_S)
    assert_allclose(pose(both), pose(alone))
    assert both.status("plate") is TrackStatus.STALE


@pytest.mark.parametrize("period", [np.pi / 2, np.pi, 2 * np.pi])
@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 2])
def test_the_equivalent_next_to_what_was_expected_is_taken(period, turns):
    expected = se3.from_yaw([0.0, 0.0, 0.0], 3.0)  # next to where angles wrap
    looks_alike = se3.from_yaw([0.01, 0.0, 0.0], 3.0 + 0.2 + turns * period)
    nearest = nearest_equivalent(looks_alike, expected, period)
    assert float(se3.distances(nearest, expected)[1]) == pytest.approx(0.2)
    assert_allclose(nearest[:3, 3], looks_alike[:3, 3])


def test_a_round_object_keeps_the_yaw_it_was_given():
    expected = se3.from_yaw([0.0, 0.0, 0.0], 1.0)
    nearest = nearest_equivalent(se3.from_yaw([0.01, 0.0, 0.0], 2.5), expected, 0)
    assert_allclose(nearest[:3, :3], expected[:3, :3])
    one = tracker({"cup": 0.0})
    for yaw in (1.0, 2.0, 3.0):
        assert look(one, seen(se3.from_yaw(CUP[:3, 3], yaw))) == frozenset()
    assert float(se3.yaw_of(pose(one))) == pytest.approx(0.4)


def test_what_the_hand_has_put_down_is_taken_to_be_there_until_it_is_seen_or_doubted():
    one = tracker()
    one.hold("cup", FAR_HAND)
    moved = shifted(FAR_HAND, 0.3, 0.2, -0.1)
    placed = shifted(CUP, 0.3, 0.2, -0.1)
    one.release(["cup"], moved)
    for _ in range(20):  # in sight, and not recognised where it is
        look(one, unseen())
        assert one.status("cup") is TrackStatus.HIDDEN
    assert_allclose(pose(one), placed, atol=1e-9)
    look(one, seen(placed))
    for _ in range(20):
        look(one, unseen())
    assert one.status("cup") is TrackStatus.LOST, "it was recognised there, so it would be again"
    one = tracker()
    one.hold("cup", FAR_HAND)
    one.release(["cup"], moved)
    one.doubt(["cup"], moved)
    for _ in range(20):
        look(one, unseen())
    assert one.status("cup") is TrackStatus.LOST
