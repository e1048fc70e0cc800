"""A drawer is followed along its axis from where its handle was taken."""

import numpy as np
from numpy.testing import assert_allclose
from tests.memory.builders import OPEN_WIDTH, entry, hand_pose, key_pose, robot

from lerobot_openspm.control.executor import Executor
from lerobot_openspm.control.state import EpisodeState
from lerobot_openspm.control.transfer import transfer
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import Axis
from lerobot_openspm.types import Hand

HOME = hand_pose(0.0, 0.0, 0.3)
ROBOT = robot()


def drawer(axis=None):
    """Take a handle, pull it by 0.15 m along the cabinet's x, let go."""
    axis = axis or Axis("slide", np.array([1.0, 0.0, 0.0]), 0.15)
    poses = [
        key_pose("cabinet", hand_pose(0.1, 0.0, 0.2), "approach"),
        key_pose("cabinet", hand_pose(0.1, 0.0, 0.2), "grasp", closed=True),
        key_pose("cabinet", hand_pose(0.25, 0.0, 0.2), "open", closed=True, axis=axis),
        key_pose("cabinet", hand_pose(0.25, 0.0, 0.2), "release"),
    ]
    object_poses = {"cabinet": se3.from_yaw([0.05, 0.1, 0.0], 0.6)}
    memory = entry("open the top drawer of the cabinet", key_poses=poses, object_poses=object_poses)
    executor = Executor("closed_loop_trc", ROBOT, EpisodeState())
    executor.begin(transfer(memory, object_poses, {}, HOME), Hand(HOME, OPEN_WIDTH))
    return executor, object_poses["cabinet"]


def test_a_drawer_is_pulled_along_its_axis_from_where_its_handle_was_taken():
    executor, T_world_obj = drawer()
    taken = executor.targets[1].T_world_ee @ se3.from_yaw([0.004, -0.006, 0.003], 0.02)
    executor.begin(executor.targets, Hand(taken, 0.03), 2)
    target = executor.targets[2]
    assert_allclose(target.T_world_ee[:3, 3] - taken[:3, 3], 0.15 * T_world_obj[:3, 0], atol=1e-9)
    assert_allclose(target.T_world_ee[:3, :3], taken[:3, :3])
    executor.change(drawer()[0].targets)  # a look at something else does not take it back
    assert_allclose(executor.targets[2].T_world_ee, target.T_world_ee)


def test_the_open_loop_follows_an_axis_from_where_the_hand_should_be():
    executor, _ = drawer()
    executor = Executor("open_loop", ROBOT, EpisodeState())
    executor.begin(drawer()[0].targets, Hand(HOME, OPEN_WIDTH))
    executor.begin(executor.targets, Hand(HOME, OPEN_WIDTH), 2)
    assert_allclose(executor.targets[2].T_world_ee, drawer()[0].targets[2].T_world_ee, atol=1e-9)
