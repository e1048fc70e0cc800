"""Key poses remember which sub-task of the instruction they serve."""

from functools import partial

import numpy as np
import pytest
from tests.memory.builders import robot
from tests.mining.episodes import Drawer, pick_and_place

from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.compose import parts
from lerobot_openspm.mining.entries import task_entries
from lerobot_openspm.mining.key_poses import find_key_poses
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.mining.objects import contact_cues
from lerobot_openspm.mining.processor import compare, mine_episodes

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
    item = MinedEpisode(episode, tuple(find_key_poses(episode, robot())), parse_instruction(TASK))
    (task,) = compare([item], [LAYOUT], [{}], {})
    (entry,) = task_entries(task, "local/demos")
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


def mined(*episodes):
    """What is mined of episodes, and the reasons of those that are skipped."""
    return mine_episodes(episodes, partial(find_key_poses, robot=robot()))


def test_a_task_that_the_grammar_cannot_read_is_mined_with_the_things_that_the_hand_took():
    one = pick_and_place()[0].episode(0, "pour the coffee into the cup")
    (item,), _ = mined(one)
    assert [(s.operation, s.target, s.landmark) for s in item.sub_tasks] == [("do", "coffee", "cup")]
    touched = [(cue.name, cue.kind) for cue in contact_cues(item)]
    assert touched == [("coffee", "grasp"), ("cup", "release")]


def twice():
    """Takes a thing and puts it down, then another one."""
    drawer, _ = pick_and_place()
    drawer.move([-0.1, 0.1, 0.14])
    drawer.move([-0.1, 0.1, 0.02])
    drawer.grip(True)
    drawer.move([-0.1, 0.1, 0.16])
    drawer.move([0.1, 0.1, 0.05])
    drawer.grip(False)
    drawer.move([0.1, 0.1, 0.2])
    return drawer


@pytest.mark.parametrize("again", [0, 1, 2])
def test_one_demonstration_of_several_that_grasps_twice_leaves_the_others_as_they_are(again):
    drawers = [twice() if i == again else pick_and_place()[0] for i in range(3)]
    items, _ = mined(*(one.episode(i, "wipe the table with the sponge") for i, one in enumerate(drawers)))
    assert {s.target for item in items for s in item.sub_tasks} == {"sponge"}
    (task,) = compare(items, [{"sponge": np.eye(4)}] * 3, [{}] * 3, {})
    assert len(task_entries(task, "local/any")) == 3


def test_every_thing_that_such_a_task_takes_has_a_name_of_its_own():
    (item,), _ = mined(twice().episode(0, "set the table"))
    assert [s.target for s in item.sub_tasks] == ["set table object", "set table object 2"]
    assert [cue.name for cue in contact_cues(item)] == ["set table object", "set table object 2"]
    layout = {"set table object": np.eye(4), "set table object 2": np.eye(4)}
    (task,) = compare([item], [layout], [{}], {})
    (entry,) = task_entries(task, "local/any")
    assert {pose.anchor.place for pose in entry.key_poses} == set(layout)
    assert entry.key.sub_tasks[0].words == "set table"


def test_a_task_without_a_word_is_skipped():
    said, silent = (pick_and_place()[0].episode(i, task) for i, task in enumerate(("wipe it", "...")))
    found, skipped = mined(said, silent)
    assert [item.episode.index for item in found] == [0]
    assert "says nothing" in skipped[1]
