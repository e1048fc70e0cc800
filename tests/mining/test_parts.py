"""A demonstration that puts several things is mined as one for each, where each stands by itself."""

from dataclasses import replace

import numpy as np
import pytest
from tests.memory.builders import robot
from tests.mining.episodes import pick_and_place

from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.entry import episode_of
from lerobot_openspm.mining.entries import task_entries
from lerobot_openspm.mining.key_poses import find_key_poses
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.mining.parts import divided
from lerobot_openspm.mining.processor import compare


@pytest.mark.parametrize(
    ("instruction", "parts"),
    [
        (
            "put the white mug on the left plate and put the yellow mug on the right plate",
            ["put the white mug on the left plate", "put the yellow mug on the right plate"],
        ),
        ("put both moka pots on the stove", ["put the moka pot on the stove"] * 2),
        (
            "put both the soup and the butter in the basket",
            ["put the soup in the basket", "put the butter in the basket"],
        ),
        (
            "put the bowl on the plate and open the drawer",
            ["put the bowl on the plate", "open the drawer of the cabinet"],
        ),
        # What needs what was done before stays together.
        ("put the bowl on the plate and put the bowl on the stove", None),
        ("put the bowl in the bottom drawer of the cabinet and close it", None),
        ("put the mug in the microwave and close it", None),
        ("open the drawer and put the bowl inside", None),
        ("put the bowl on the plate", None),
    ],
)
def test_what_stands_by_itself_is_a_demonstration_of_its_own(instruction, parts):
    sub_tasks = parse_instruction(instruction)
    episode = pick_and_place()[0].episode(0, instruction)
    once = find_key_poses(episode, robot())
    key_poses = [replace(pose, contact=pose.contact + 2 * i) for i in range(len(sub_tasks)) for pose in once]
    item = MinedEpisode(episode, tuple(key_poses), sub_tasks)
    found = divided(item)
    if parts is None:
        assert found == [item]
        return
    assert [one.episode.task for one in found] == parts
    assert [one.sub_tasks for one in found] == [(sub_task,) for sub_task in sub_tasks]
    assert all(one.key_poses == tuple(once) for one in found)
    assert all(one.episode.index == episode.index for one in found)


def test_what_an_episode_does_a_second_time_has_a_source_of_its_own():
    instruction = "put both moka pots on the stove"
    episode = pick_and_place()[0].episode(7, instruction)
    once = find_key_poses(episode, robot())
    key_poses = tuple(replace(pose, contact=pose.contact + 2 * i) for i in range(2) for pose in once)
    parts = divided(MinedEpisode(episode, key_poses, parse_instruction(instruction)))
    poses = [{"moka pot": np.eye(4), "stove": se3.from_yaw([0.1, 0.1, 0.0], 0.0)}] * 2
    (task,) = compare(parts, poses, [{}, {}], {})
    entries = task_entries(task, "a/b")
    assert [one.source for one in entries] == ["a/b#7", "a/b#7.2"]
    assert [episode_of(one.source) for one in entries] == [7, 7]
    assert {one.language for one in entries} == {"put the moka pot on the stove"}
