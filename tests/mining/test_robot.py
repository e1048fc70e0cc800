"""What the demonstrations tell of the robot: its gripper's commands and how far it goes by one."""

from dataclasses import replace

import numpy as np
import pytest
from tests.mining import episodes
from tests.mining.episodes import METRES_PER_ACTION, OPEN, RADIANS_PER_ACTION, SPEED

from lerobot_openspm.geometry import se3
from lerobot_openspm.mining.signals import observe_robot


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_robot_is_observed_and_not_assumed(sign):
    drawn = [episodes.pick_and_place(close_command=sign, yaw=0.5)[0], episodes.turn()[0]]
    drawn[1].commands = [command * sign for command in drawn[1].commands]
    robot = observe_robot([drawing.episode() for drawing in drawn])
    assert (robot.close_command, robot.open_command) == (sign, -sign)
    assert robot.command(True) == sign
    assert robot.closed(np.array([sign, -sign, 0.9 * sign])).tolist() == [True, False, True]
    assert robot.open_width == pytest.approx(OPEN)
    assert robot.metres_per_action == pytest.approx(METRES_PER_ACTION, rel=0.02)
    assert robot.radians_per_action == pytest.approx(RADIANS_PER_ACTION, rel=0.02)
    assert robot.metres_per_step == pytest.approx(SPEED, rel=0.1)
    positions = np.concatenate([drawing.episode().T_world_ee[:, :3, 3] for drawing in drawn])
    np.testing.assert_allclose(robot.workspace, [positions.min(axis=0), positions.max(axis=0)])


def test_a_hand_that_is_kept_level_against_disturbances_tells_nothing_of_its_gain():
    """Motion tilts the hand, and the demonstrator turns it back: it hardly turns as it is commanded to."""
    clean = episodes.pick_and_place(yaw=0.5)[0].episode()
    rng, tilt, T, actions = (
        np.random.default_rng(0),
        np.zeros(2),
        clean.T_world_ee.copy(),
        clean.actions.copy(),
    )
    for i in range(len(T)):
        T[i] = se3.apply_increment(clean.T_world_ee[i], np.array([0.0, 0.0, 0.0, *tilt, 0.0]))
        actions[i, 3:5] = -0.5 * tilt / RADIANS_PER_ACTION
        tilt = tilt + actions[i, 3:5] * RADIANS_PER_ACTION + rng.normal(0, 0.05, 2)
    robot = observe_robot([replace(clean, T_world_ee=T, actions=actions)])
    assert robot.radians_per_action == pytest.approx(RADIANS_PER_ACTION, rel=0.05)
    assert robot.metres_per_action == pytest.approx(METRES_PER_ACTION, rel=0.02)
