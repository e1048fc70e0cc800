"""A hand takes hold a little to one side where something stands close to what it grasps."""

from dataclasses import replace

import numpy as np
import pytest
from tests.control.test_clearance import HOME
from tests.memory.builders import OPEN_WIDTH, entry

from lerobot_openspm.control.finger_room import LEAST_ROOM_M, finger_room, fingers_elsewhere, shifted
from lerobot_openspm.control.transfer import transfer
from lerobot_openspm.geometry import se3

SHOWN = entry()
TARGETS = transfer(SHOWN, SHOWN.object_poses, {}, HOME)
GRASP = next(one for one in TARGETS if one.key_pose.phase == "grasp")


def beside(along):
    """A thin post at a distance along the axis over which the fingers open, from the hand at the grasp."""
    heights = np.linspace(-0.04, 0.0, 9)
    own = np.stack([np.zeros(9), np.full(9, along), heights], axis=1)
    return {"post": se3.apply(GRASP.T_world_ee, own)}


@pytest.mark.parametrize("side", [1, -1])
def test_the_hand_goes_away_from_what_is_in_the_way_of_a_finger_but_no_further_than_needed(side):
    (shift,) = finger_room(SHOWN, TARGETS, beside(side * 0.0635), OPEN_WIDTH).values()
    assert shift == pytest.approx(-side * 0.006)


@pytest.mark.parametrize("along", [0.2, -0.075])
def test_it_goes_straight_where_the_fingers_have_room(along):
    assert finger_room(SHOWN, TARGETS, beside(along), OPEN_WIDTH) == {}


def test_it_goes_straight_where_going_aside_frees_hardly_anything():
    plate = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 41), np.linspace(-0.1, 0.06, 33), [0.005]), axis=-1)
    points = {"plate": se3.apply(GRASP.T_world_ee, plate.reshape(-1, 3))}
    assert finger_room(SHOWN, TARGETS, points, OPEN_WIDTH) == {}


def test_both_fingers_keep_clear_of_what_they_close_on():
    most = OPEN_WIDTH - 2 * (LEAST_ROOM_M + 0.004)
    for opening, is_shifted in ((most, False), (most - 0.004, True)):
        poses = [replace(one, opening=opening) if one.closed else one for one in SHOWN.key_poses]
        targets = transfer(entry(key_poses=poses), SHOWN.object_poses, {}, HOME)
        assert bool(finger_room(SHOWN, targets, beside(0.0635), OPEN_WIDTH)) == is_shifted


def test_what_belongs_to_the_grasp_is_in_nobodys_way():
    points = {"bowl": next(iter(beside(0.06).values()))}
    assert finger_room(SHOWN, TARGETS, points, OPEN_WIDTH) == {}


def test_the_hand_is_back_where_it_was_shown_once_it_has_taken_hold():
    moved = shifted(TARGETS, {0: 0.01}, {0: 0.004})
    apart = [se3.inverse(a.T_world_ee) @ b.T_world_ee for a, b in zip(TARGETS, moved, strict=True)]
    for target, T in zip(TARGETS, apart, strict=True):
        before = target.key_pose.phase in ("approach", "grasp")
        depth = 0.004 if target.key_pose.phase == "grasp" else 0.0
        assert np.allclose(T[:3, 3], [0.0, 0.01 if before else 0.0, depth])


def around(radius, degrees):
    """The hand as it takes hold of the rim of something round, turned about its middle."""
    middle = se3.transform(np.eye(3), [0.0, radius, 0.0])
    turn = se3.from_yaw(np.zeros(3), np.deg2rad(degrees))
    return replace(GRASP, T_world_ee=GRASP.T_world_ee @ middle @ turn @ se3.inverse(middle))


@pytest.mark.parametrize(("radius", "order"), [(0.06, [180, 120, 90]), (0.0, [90])])
def test_what_was_in_a_fingers_way_is_kept_furthest_from_and_well_off(radius, order):
    degrees = [10, 90, 180] if radius == 0 else [10, 90, 120, 180]
    found = fingers_elsewhere(GRASP, [around(radius, one) for one in degrees], HOME, OPEN_WIDTH)
    assert [degrees[i] for i in found] == order


def test_of_two_ways_round_the_hand_takes_the_one_that_it_turns_less_for():
    there = around(0.06, 180)
    back = replace(there, T_world_ee=there.T_world_ee @ se3.from_yaw(np.zeros(3), np.pi))
    for hand, expected in ((there, [0, 1]), (back, [1, 0])):
        assert fingers_elsewhere(GRASP, [there, back], hand.T_world_ee, OPEN_WIDTH) == expected
