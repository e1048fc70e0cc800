"""What the fingers feel, hold and lose."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.test_executor import HOME, ROBOT, World, make, run
from tests.memory.builders import OPEN_WIDTH, entry, hand_pose, key_pose, pick_and_place

from lerobot_openspm.control.state import Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.types import Hand


@pytest.mark.parametrize("execution", ["closed_loop_trc", "open_loop"])
def test_a_hand_that_drifts_while_the_fingers_close_is_brought_back(execution):
    executor, world = make(execution), World()
    run(executor, world, until=lambda e: e.targets[e.state.index].key_pose.dwell)
    target = executor.targets[executor.state.index]
    drift = np.array([0.012, -0.008, 0.005, 0.0, 0.0, 0.05])
    world.T = se3.apply_increment(target.T_world_ee, drift)
    actions = []
    for _ in range(target.key_pose.n_steps):
        actions.append(executor.next_action(world.hand))
        world.step(actions[-1])
    assert_allclose(np.array(actions)[:, 6], ROBOT.command(target.key_pose.closed))
    if execution == "open_loop":  # it cannot know
        assert float(se3.distances(world.T, target.T_world_ee)[0]) > 0.01
        return
    # Each of the ten steps makes good a fifth.
    metres, radians = se3.distances(world.T, target.T_world_ee)
    assert target.key_pose.n_steps >= 8
    assert metres < 0.2 * np.linalg.norm(drift[:3])
    assert radians < 0.2 * np.linalg.norm(drift[3:])


@pytest.mark.parametrize(
    ("above", "beside", "turned", "is_let_go"),
    [
        (0.03, 0.0, 0.0, True),
        (0.03, 0.04, 0.0, False),
        (0.09, 0.0, 0.0, False),
        (0.03, 0.0, 0.5, False),
        (0.001, 0.0, 0.25, False),
    ],
)
def test_what_is_held_up_from_below_a_little_above_its_place_is_let_go_there(
    above, beside, turned, is_let_go
):
    executor = make()
    place = executor.targets[5]
    assert place.key_pose.phase == "place"
    R = (se3.from_yaw(np.zeros(3), turned) @ place.T_world_ee)[:3, :3]
    T = se3.transform(R, place.T_world_ee[:3, 3] + [beside, 0.0, above])
    world = World(T, stuck=lambda _: True)
    world.opening = world.held
    executor.begin(executor.targets, world.hand, 5)
    run(executor, world, until=lambda e: e.state.index != 5 or e.state.attempts == 1)
    assert (executor.state.index == 6) == is_let_go
    assert (executor.state.attempts == 0) == is_let_go
    if is_let_go:
        assert_allclose(executor.present.T_world_ee, T)
        assert executor.present.key_pose.phase == "release"


def test_empty_fingers_after_the_grasp_ask_for_another_try():
    executor, world = make(), World(held=0.001)
    run(executor, world, until=lambda e: e.state.attempts == 1)
    assert executor.state.status is Status.RUNNING
    assert executor.state.index == 0  # back to the first approach of this grasp
    world.held = 0.03
    run(executor, world)
    assert executor.state.status is Status.DONE
    assert executor.state.attempts == 1


@pytest.mark.parametrize(
    ("shown", "opening", "is_lost"),
    [
        (0.03, 0.031, False),
        (0.03, 0.019, False),
        (0.03, 0.017, True),  # 12 mm closer than shown
        (0.015, 0.0061, False),
        (0.015, 0.0059, True),  # less than 40 % of what was shown
    ],
)
def test_fingers_that_are_much_closer_than_shown_hold_nothing_or_something_else(shown, opening, is_lost):
    executor = make(
        key_poses=[replace(one, opening=shown) if one.closed else one for one in pick_and_place()]
    )
    executor.begin(executor.targets, Hand(HOME, OPEN_WIDTH), 4)  # carrying
    hand = Hand(HOME, opening)
    assert executor.feels_grip(hand) != is_lost
    assert executor.advance(hand) is is_lost


def test_grip_is_not_judged_before_the_grasp_nor_in_a_push_nor_without_correction():
    empty = Hand(HOME, 0.0)
    executor = make()
    for index in (0, 1, 2, 7):
        executor.begin(executor.targets, empty, index)
        assert executor.advance(empty) is False
    plain = make("closed_loop")
    plain.begin(plain.targets, empty, 4)
    assert plain.advance(empty) is False
    fist = [
        key_pose("plate", hand_pose(0, 0, 0.02), "approach", closed=True, opening=0.0),
        key_pose("plate", hand_pose(0.2, 0, 0.02), "push", closed=True, opening=0.0),
    ]
    pushing = make(key_poses=fist)
    pushing.begin(pushing.targets, empty, 1)
    assert pushing.advance(empty) is False


def test_closed_fingers_that_push_after_something_was_put_down_hold_nothing_that_could_be_lost():
    T = hand_pose(0.2, 0.0, 0.05)
    pushing = [
        key_pose("plate", T, "approach", closed=True),
        key_pose("plate", T, "push", closed=True),
        key_pose("plate", T, "retreat", closed=True),
    ]
    executor = make(key_poses=(*entry().key_poses, *pushing))
    fist = Hand(HOME, 0.0)
    phases = [target.key_pose.phase for target in executor.targets]
    for index in (9, 10):
        executor.begin(executor.targets, fist, index)
        assert not executor.has_lost_grip(fist), phases[index]
    executor.begin(executor.targets, fist, phases.index("lift"))
    assert executor.has_lost_grip(fist)


def test_fingers_that_close_do_not_push_the_hand_back_but_lead_it_sideways():
    executor = make()
    grasp = next(one for one in executor.targets if one.key_pose.phase == "grasp")
    T = grasp.T_world_ee
    metres, along = 0.005, T[:3, 2]
    for i, expected in enumerate((0.2, 0.2, 1.0)):  # the share of the way back that a step goes
        off = se3.transform(T[:3, :3], T[:3, 3] + metres * T[:3, i])
        action = executor.strategy.grip(grasp, off)
        back = -action[:3] * ROBOT.metres_per_action
        assert_allclose(back, expected * metres * T[:3, i], atol=1e-9)
    far = se3.transform(T[:3, :3], T[:3, 3] - 0.1 * along)
    assert np.abs(executor.strategy.grip(grasp, far)[:6]).max() <= 1 + 1e-12
