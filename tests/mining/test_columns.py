"""Key poses go into a dataset's columns and come back as they were."""

from dataclasses import replace

import numpy as np
import pytest
from tests.memory.builders import robot
from tests.mining.episodes import pick_and_place, pull, push, turn

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.mining import columns as c
from lerobot_openspm.mining.key_poses import find_key_poses

MOTIONS = {"pick": pick_and_place, "push": push, "pull": pull, "turn": turn}


@pytest.fixture(params=MOTIONS)
def mined(request):
    episode = MOTIONS[request.param]()[0].episode(index=3)
    key_poses = find_key_poses(episode, robot())
    # What a judge says is kept to the last digit.
    return episode, [replace(pose, confidence=pose.confidence / 3) for pose in key_poses]


def state_of(episode):
    return np.column_stack([episode.T_world_ee[:, :3, 3], episode.opening])


def columns_of(episode, key_poses):
    return {
        name: values.tolist() for name, values in c.encode_key_poses(state_of(episode), key_poses).items()
    }


def test_what_is_written_is_read(mined):
    episode, key_poses = mined
    read = c.decode_key_poses(columns_of(episode, key_poses), episode, "here")
    assert len(read) == len(key_poses) > 2
    for before, after in zip(key_poses, read, strict=True):
        assert np.array_equal(before.T_world_ee, after.T_world_ee)
        assert replace(before, T_world_ee=None) == replace(after, T_world_ee=None)


def test_every_frame_says_where_it_is_on_the_way_to(mined):
    episode, key_poses = mined
    columns, state = columns_of(episode, key_poses), state_of(episode)
    assert np.flatnonzero(columns[c.IS_KEY_POSE]).tolist() == [pose.frame for pose in key_poses]
    for frame in range(key_poses[-1].frame + 1):
        number, pose = next((i, pose) for i, pose in enumerate(key_poses) if pose.frame >= frame)
        assert (columns[c.KEY_POSE][frame], columns[c.PHASE][frame]) == (number, pose.phase)
        np.testing.assert_array_equal(columns[c.TARGET][frame], np.float32(state[pose.frame]))


def test_frames_after_the_last_key_pose_belong_to_none():
    episode = pick_and_place()[0].episode()
    key_poses = find_key_poses(episode, robot())[:3]
    columns, last = columns_of(episode, key_poses), key_poses[-1].frame
    assert set(columns[c.KEY_POSE][last + 1 :]) == {-1}
    assert set(columns[c.PHASE][last + 1 :]) == {""}
    np.testing.assert_array_equal(columns[c.TARGET][-1], np.float32(state_of(episode)[last]))


def test_an_episode_without_key_poses_has_columns_too():
    episode = pick_and_place()[0].episode()
    columns = columns_of(episode, ())
    assert not any(columns[c.IS_KEY_POSE])
    np.testing.assert_array_equal(columns[c.TARGET], np.float32(state_of(episode)))
    assert c.decode_key_poses(columns, episode, "here") == []


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        (c.KEY_POSE, 7, "openspm.key_pose is .*7.*counted from 0"),
        (c.IS_KEY_POSE, False, "counted from 0"),
        (c.PHASE, "levitate", "openspm.phase is 'levitate'.*expected one of approach, grasp"),
        (c.PHASE, "", "expected one of approach"),
        (c.CONFIDENCE, 1.5, "openspm.confidence 1.5"),
        (c.CONFIDENCE, float("nan"), "openspm.confidence nan"),
    ],
)
def test_columns_that_make_no_sense_are_refused(name, value, said):
    episode = pick_and_place()[0].episode(index=3)
    key_poses = find_key_poses(episode, robot())
    columns = columns_of(episode, key_poses)
    columns[name][key_poses[1].frame] = value
    with pytest.raises(DatasetError, match=f"dataset local/here, episode 3.*{said}"):
        c.decode_key_poses(columns, episode, "dataset local/here")
