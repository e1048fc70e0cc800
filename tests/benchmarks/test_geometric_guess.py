"""The stand-in for a zero-shot source of key poses does what an instruction asks, in the right places."""

import numpy as np
import pytest
from benchmarks.libero.geometric_guess import ABOVE_M, PULL_M, GuessConfig, _Guesser, remembered, source_of
from benchmarks.libero.guessed_key_poses import HOLDING, GuessedKeyPose

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import parse_instruction

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


def test_a_models_key_poses_are_kept_relative_to_what_the_instruction_names():
    sub_tasks = parse_instruction("open the top drawer of the cabinet and put the bowl inside")
    names = {name for sub_task in sub_tasks for name in sub_task.objects}
    layout = {name: se3.from_yaw([0.1 * i, 0.2, 0.0], 0.5) for i, name in enumerate(sorted(names))}
    first = "approach grasp open release retreat"
    second = "approach grasp lift pre-place place release retreat"
    guessed = [
        GuessedKeyPose(phase, np.array([0.3, 0.1, 0.01 * i]), np.array([0.0, 0.0, 0.2]), phase in HOLDING)
        for i, phase in enumerate(f"{first} {second}".split())
    ]
    kept = remembered(guessed, sub_tasks, layout, DOWN, 0.08)
    assert [pose.sub_task for pose in kept] == [0] * 5 + [1] * 7
    assert [pose.anchor.place for pose in kept[5:8]] == [sub_tasks[1].target] * 3
    assert {pose.anchor.place for pose in kept[8:]} == {sub_tasks[1].landmark}
    for pose, said in zip(kept, guessed, strict=True):
        T_world_ee = pose.anchor.frame(layout) @ pose.T_obj_ee
        np.testing.assert_allclose(T_world_ee[:3, 3], said.position, atol=1e-12)
        np.testing.assert_allclose(T_world_ee[:3, :3], se3.exp_so3([0, 0, 0.2]) @ DOWN, atol=1e-12)
        assert pose.closed == said.closed
        assert pose.dwell == (said.phase in ("grasp", "release"))


def test_a_source_without_a_model_is_refused():
    with pytest.raises(PhaseLabelError, match="pass --model_id=NAME"):
        source_of(GuessConfig("a", "b", "openai"))
    assert source_of(GuessConfig("a", "b")) is None
