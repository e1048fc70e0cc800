"""Key poses remember which sub-task of the instruction they serve."""

import numpy as np
from tests.memory.builders import robot
from tests.mining.episodes import Drawer

from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.compound import parts
from lerobot_openspm.memory.instruction import parse_instruction
from lerobot_openspm.mining.key_poses import find_key_poses
from lerobot_openspm.mining.mine import MinedEpisode, build_entries

TASK = "open the top drawer and put the bowl inside"
LAYOUT = {"cabinet": se3.from_yaw([0.3, 0.0, 0.0], 0.0), "bowl": se3.from_yaw([-0.1, 0.2, 0.0], 0.0)}


def drawn():
    """Pulls a handle, lets go, backs off, takes the bowl, puts it where the drawer was opened."""
    d = Drawer([-0.2, 0.0, 0.3])
    d.move([0.1, 0.0, 0.12])
    d.move([0.2, 0.0, 0.12])
    d.grip(True)
    d.move([0.05, 0.0, 0.12])
    d.grip(False)
    d.move([-0.07, 0.0, 0.25])
    d.move([-0.1, 0.2, 0.14])
    d.move([-0.1, 0.2, 0.02])
    d.grip(True)
    d.move([-0.1, 0.2, 0.3])
    d.move([0.1, 0.0, 0.3])
    d.move([0.1, 0.0, 0.14])
    d.grip(False)
    d.move([0.1, 0.0, 0.3])
    return d.episode(task=TASK)


def test_every_key_pose_of_a_demonstration_of_two_sub_tasks_knows_its_own():
    episode = drawn()
    mined = MinedEpisode(episode, tuple(find_key_poses(episode, robot())), parse_instruction(TASK))
    (entry,) = build_entries([mined], [LAYOUT], [{}], {}, "local/demos")
    by_sub_task = [[pose.phase for pose in entry.key_poses if pose.sub_task == i] for i in (0, 1)]
    assert by_sub_task[0][-4:] == ["grasp", "open", "release", "retreat"]
    assert "open" not in by_sub_task[1]
    assert by_sub_task[1][-3:] == ["place", "release", "retreat"]
    opening, putting = parts(entry)
    assert opening.objects == ("cabinet",)
    assert sorted(putting.objects) == ["bowl", "cabinet"]
    for part, served in ((opening, 0), (putting, 1)):
        own = [pose.T_obj_ee for pose in entry.key_poses if pose.sub_task == served]
        np.testing.assert_array_equal([pose.T_obj_ee for pose in part.key_poses], own)
