"""The stand-in for a zero-shot source of key poses does what an instruction asks, in the right places."""

import numpy as np
import pytest
from benchmarks.libero.geometric_guess import ABOVE_M, PULL_M, _Guesser

from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.instruction import parse_instruction

DOWN = np.diag([1.0, -1.0, -1.0])
MIDDLES = {name: np.array([0.0, 0.0, z]) for name, z in (("bowl", 0.03), ("plate", 0.01), ("cabinet", 0.2))}


def guess(instruction: str):
    guesser = _Guesser({**MIDDLES, "stove": np.zeros(3)}, DOWN, 0.08)
    return [pose for sub_task in parse_instruction(instruction) for pose in guesser.follow(sub_task)]


@pytest.mark.parametrize(
    ("instruction", "phases"),
    [
        ("put the bowl on the plate", "approach approach grasp lift pre-place place release retreat"),
        ("open the top drawer of the cabinet", "approach approach grasp open release retreat"),
        ("turn on the stove", "approach approach grasp turn release retreat"),
        ("push the plate to the front of the stove", "approach approach push"),
    ],
)
def test_phases_follow_the_instruction(instruction, phases):
    assert " ".join(pose.phase for pose in guess(instruction)) == phases


def test_the_bowl_is_grasped_at_its_middle_and_let_go_above_the_plate():
    poses = {pose.phase: pose for pose in guess("put the bowl on the plate")}
    np.testing.assert_allclose(poses["grasp"].T_obj_ee, se3.transform(DOWN, MIDDLES["bowl"]))
    assert poses["grasp"].anchor.place == "bowl"
    assert poses["grasp"].closed
    assert poses["release"].anchor.place == "plate"
    assert not poses["release"].closed
    np.testing.assert_allclose(poses["release"].T_obj_ee[:3, 3], MIDDLES["plate"] + [0, 0, ABOVE_M])


def test_a_drawer_is_pulled_and_a_knob_turned_by_a_quarter():
    pulled = {pose.phase: pose.T_obj_ee for pose in guess("open the top drawer of the cabinet")}
    np.testing.assert_allclose((pulled["open"] - pulled["grasp"])[:3, 3], [0.0, PULL_M, 0.0])
    turned = {pose.phase: pose.T_obj_ee for pose in guess("turn on the stove")}
    metres, radians = se3.distances(turned["turn"], turned["grasp"])
    assert metres == pytest.approx(0.0)
    assert radians == pytest.approx(np.pi / 2)
