"""What is not done is taken up again where it can be mended."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.test_row import HAND, Eyes, row, watch
from tests.memory.builders import entry, hand_pose, key_pose

from lerobot_openspm.control.executor import Hand, Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import Axis

OPEN = "open the top drawer"
CABINET = {"cabinet": se3.from_yaw([0.1, 0.0, 0.0], 0.5)}
KINDS = {
    "slide": Axis("slide", np.array([1.0, 0.0, 0.0]), 0.15),
    "turn": Axis("turn", np.array([0, 0, 1.0]), 1.5),
}


def handle(axis):
    """A handle that is taken, led along its axis, and let go."""
    T = hand_pose(0.1, 0.0, 0.1)
    end = axis.follow(T)
    poses = [
        key_pose("cabinet", hand_pose(0.1, 0.0, 0.2), "approach"),
        key_pose("cabinet", T, "approach"),
        key_pose("cabinet", T, "grasp", closed=True),
        key_pose("cabinet", end, "open" if axis.kind == "slide" else "turn", closed=True, axis=axis),
        key_pose("cabinet", end, "release"),
    ]
    return entry(OPEN, poses, CABINET)


@pytest.mark.parametrize("axis", KINDS.values(), ids=list(KINDS))
def test_travel_is_the_inverse_of_following(axis):
    start = hand_pose(0.1, 0.2, 0.3, 0.4)
    assert_allclose(axis.travel(start, axis.follow(start)), axis.amount, atol=1e-9)


@pytest.mark.parametrize("axis", KINDS.values(), ids=list(KINDS))
def test_a_handle_that_slipped_out_is_taken_again_where_it_is_now_for_the_rest_of_its_way(axis):
    eyes, one = Eyes(CABINET), row(handle(axis), instruction=OPEN)
    one.observe(HAND, eyes)
    shown = [target.T_world_ee for target in one.executor.plan]
    here = Hand(shown[2], 0.03)
    one.executor.begin(one.executor.plan, here, 3)
    world_axis = one.executor.plan[3].axis
    way = Axis(axis.kind, world_axis.direction, 0.4 * axis.amount)
    watch(one, eyes, Hand(way.follow(shown[2]), 0.03), 1)
    assert one.executor.index == 3
    watch(one, eyes, Hand(axis.follow(shown[2]), 0.0), 1)  # the fingers have closed
    assert one.executor.index == 0
    for index in (0, 1, 2):
        assert_allclose(one.executor.plan[index].T_world_ee, way.follow(shown[index]), atol=1e-9)
    again = Hand(one.executor.plan[2].T_world_ee, 0.03)
    one.executor.begin(one.executor.plan, again, 3)
    assert_allclose(one.executor.plan[3].T_world_ee, shown[3], atol=1e-9)


def stuck(one, eyes, hand, index):
    """The hand, held up short of a key pose until it is given up."""
    one.executor.begin(one.executor.plan, hand, index)
    for _ in range(200):
        watch(one, eyes, hand, 1)
        if one.executor.attempts:
            return
    pytest.fail("it was not given up")


def carrying(opening):
    """The bowl is in the hand, and its place is not reached."""
    eyes, one = Eyes(entry().layout), row()
    one.observe(HAND, eyes)
    one.executor.begin(one.executor.plan, HAND, 2)
    grasp = one.executor.plan[2]
    watch(one, eyes, Hand(grasp.T_world_ee, grasp.memory.opening), grasp.memory.n_steps + 1)
    assert one.tracker.held == {"bowl"}
    eyes.visible = 0.0
    place = one.executor.plan[5].T_world_ee.copy()
    place[2, 3] += 0.02
    stuck(one, eyes, Hand(place, opening), 5)
    return one


def test_what_is_still_in_the_hand_is_not_fetched_again_but_set_down_once_more():
    one = carrying(opening=0.03)
    assert one.status is Status.RUNNING
    assert one.executor.plan[one.executor.index].memory.phase == "pre-place"
    assert one.tracker.held == {"bowl"}


def test_what_is_no_more_in_the_hand_is_fetched():
    one = carrying(opening=0.0)
    assert one.executor.plan[one.executor.index].memory.phase == "approach"
    assert one.tracker.held == frozenset()
