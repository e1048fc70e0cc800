"""In free space the hand goes straight from key pose to key pose, and lifts slowly."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.test_executor import HOME, ROBOT, World, make
from tests.memory.builders import OPEN_WIDTH, hand_pose, key_pose

from lerobot_openspm.control import strategies
from lerobot_openspm.control.state import Status
from lerobot_openspm.control.strategies import ARRIVING_SHARE, LIFT_STEPS
from lerobot_openspm.control.transfer import LEAST_PASSING_M, PASSING_M
from lerobot_openspm.geometry import se3
from lerobot_openspm.types import Hand

NEAR_M = ROBOT.metres_per_step / ARRIVING_SHARE


@pytest.mark.parametrize("phase", ["approach", "lift", "pre-place", "place", "retreat"])
def test_the_hand_goes_straight_to_a_key_pose_at_the_demonstrated_pace(phase):
    executor = make(key_poses=[key_pose("bowl", hand_pose(0.2, 0.1, 0.3), phase, closed=True)])
    end, world, paces = executor.targets[0].T_world_ee, World(), []
    way = (end - HOME)[:3, 3] / np.linalg.norm((end - HOME)[:3, 3])
    for _ in range(200):
        if float(se3.distance(world.T, end)) <= NEAR_M:
            break
        executor.advance(world.hand)
        before = world.T
        world.step(executor.next_action(world.hand))
        paces.append(float(se3.distance(before, world.T)))
        assert_allclose(np.cross(way, world.T[:3, 3] - HOME[:3, 3]), 0, atol=1e-9)
    assert 5 < len(paces) < 200
    assert_allclose(paces, ROBOT.metres_per_step, rtol=1e-6)
    assert executor.state.replans == 0, "no chunk is asked for"


class LaggingArm(World):
    """Goes on as it was told before: each step takes in a third of what it is told now."""

    told = np.zeros(7)

    def step(self, action):
        self.told = self.told + (action - self.told) / 3
        super().step(self.told)


def swings_m(lead, monkeypatch):
    """How far the hand swings past a corner, to the far side of the way that begins there, metres."""
    monkeypatch.setattr(strategies, "LEAD", lead)
    ends = [hand_pose(0.15, 0.0, 0.3), hand_pose(0.15, 0.15, 0.3)]
    executor = make(key_poses=[key_pose("bowl", end, "approach") for end in ends])
    corner, world, past = executor.targets[0].T_world_ee, LaggingArm(), []
    way, on = (corner - HOME)[:3, 3], (executor.targets[1].T_world_ee - corner)[:3, 3] / 0.15
    across = way - (way @ on) * on
    across /= np.linalg.norm(across)
    for _ in range(200):
        executor.advance(world.hand)
        if executor.state.status is not Status.RUNNING or executor.approach.corrections:
            break
        world.step(executor.next_action(world.hand))
        if executor.state.index == 1:
            past.append(float(across @ (world.T[:3, 3] - corner[:3, 3])))
    assert len(past) > 10
    return max(past)


def test_an_arm_that_lags_swings_less_past_a_corner(monkeypatch):
    assert swings_m(strategies.LEAD, monkeypatch) < 0.8 * swings_m(0.0, monkeypatch)


def test_where_the_hand_was_moved_to_while_it_held_still_is_not_countered():
    executor = make(key_poses=[key_pose("bowl", hand_pose(0.2, 0.1, 0.3), "approach")])
    usual = executor.next_action(Hand(HOME, OPEN_WIDTH))
    executor.stop(Status.PAUSED)
    aside = Hand(hand_pose(0.0, -0.05, 0.3), OPEN_WIDTH)
    assert not executor.next_action(aside)[:6].any()
    executor.state.go(Status.RUNNING)
    after = executor.next_action(aside)
    fresh = make(key_poses=[key_pose("bowl", hand_pose(0.2, 0.1, 0.3), "approach")])
    assert_allclose(after, fresh.next_action(aside))
    assert_allclose(np.linalg.norm(after[:3]), np.linalg.norm(usual[:3]), rtol=1e-6)


def test_key_poses_near_the_next_one_are_passed_closely():
    near = [hand_pose(0.3, 0, 0.3), hand_pose(0.2, 0, 0.3), hand_pose(0.16, 0, 0.3), hand_pose(0.155, 0, 0.3)]
    targets = make(key_poses=[key_pose("bowl", T, "approach") for T in near]).targets
    assert_allclose([one.passing_m for one in targets[:3]], [PASSING_M, 0.2 * 0.04, LEAST_PASSING_M])


def test_a_lift_comes_up_to_speed_slowly_and_nothing_else_does(monkeypatch):
    monkeypatch.setattr(strategies, "LEAD", 0.0)
    executor, world = make(), World()
    speeds: dict[str, list[float]] = {"lift": [], "pre-place": []}
    for _ in range(600):
        if executor.state.status is not Status.RUNNING or executor.advance(world.hand):
            break
        phase, before = executor.present.key_pose.phase, world.T
        left = float(se3.distance(before, executor.present.T_world_ee))
        world.step(executor.next_action(world.hand))
        if phase in speeds and left > NEAR_M:
            speeds[phase].append(float(se3.distance(before, world.T)) / ROBOT.metres_per_step)
    steps = np.arange(1, len(speeds["lift"]) + 1)
    assert len(steps) > 5
    assert_allclose(speeds["lift"], np.minimum(steps / LIFT_STEPS, 1.0), rtol=1e-6)
    assert speeds["pre-place"]
    assert_allclose(speeds["pre-place"], 1.0, rtol=1e-6)


def test_a_lift_over_several_key_poses_comes_up_to_speed_once(monkeypatch):
    monkeypatch.setattr(strategies, "LEAD", 0.0)
    executor = make()
    lift = next(i for i, one in enumerate(executor.targets) if one.key_pose.phase == "lift")
    at = Hand(executor.targets[lift - 1].T_world_ee, 0.03)
    executor.begin(executor.targets, at, lift)
    assert executor.approach.lifted == 0
    executor.approach.steps = 5
    executor.state.index = lift
    short = Hand(executor.targets[lift].T_world_ee, 0.03)
    assert not executor.advance(short)
    assert executor.state.index == lift + 1
    assert executor.approach.speed == pytest.approx(6 / LIFT_STEPS)
    slow = executor.next_action(short)
    executor.approach.steps = LIFT_STEPS
    assert_allclose(slow[:6], 6 / LIFT_STEPS * executor.next_action(short)[:6])
    executor.begin(executor.targets, Hand(HOME, OPEN_WIDTH), 0)
    executor.approach.steps = LIFT_STEPS
    executor.begin(executor.targets, Hand(HOME, OPEN_WIDTH), 1)
    assert executor.approach.speed == 1.0
