import numpy as np
from numpy.testing import assert_allclose

from lerobot_openspm.envs.recording import pose_names, pose_vector
from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.oracle import decode_object_poses, name_simulator_poses

OBJECTS = ("bowl", "alphabet_soup", "basket")


def test_what_a_scene_does_not_hold_is_left_out():
    poses = {"bowl": se3.from_yaw([0.1, 0.2, 0.3], 0.4), "basket": np.eye(4)}
    vector = pose_vector(poses, OBJECTS)
    assert len(vector) == len(pose_names(OBJECTS))
    read = decode_object_poses(vector, pose_names(OBJECTS))
    assert list(read) == ["bowl", "basket"]
    for name, T in poses.items():
        assert_allclose(read[name], T, atol=1e-12)


def test_a_name_is_that_of_a_noun_with_all_of_its_words():
    poses = {
        name: se3.from_yaw([i, 0, 0], 0.0)
        for i, name in enumerate(("bowl", "alphabet_soup", "cookie_box", "white_mug", "yellow_and_white_mug"))
    }
    nouns = ["black bowl", "alphabet soup", "soup", "cookie box", "box", "white mug", "yellow and white mug"]
    named = name_simulator_poses(poses, nouns, {})
    assert {noun: T[0, 3] for noun, T in named.items()} == {
        "black bowl": 0,
        "alphabet soup": 1,
        "cookie box": 2,
        "white mug": 3,
        "yellow and white mug": 4,
    }
