import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import (
    HAND,
    INSTRUCTION,
    LOOK_AGAIN_STEPS,
    Perception,
    controller,
    observe,
    planning_context,
    shifted,
    watch,
)
from tests.memory.builders import entry, robot

from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.control.state import Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import load_arm
from lerobot_openspm.types import Fault, Hand

BALL = np.random.default_rng(0).normal(size=(50, 3)) / 50


def test_the_first_observation_makes_a_plan():
    perception, one = Perception(entry().object_poses), controller()
    assert one.state.status is Status.WAITING
    observe(one, HAND, perception)
    assert one.state.status is Status.RUNNING
    assert perception.asked == [["bowl", "plate"]]
    bowl = entry().object_poses["bowl"]
    assert_allclose(one.executor.targets[0].T_world_ee, bowl @ entry().key_poses[0].T_obj_ee)
    observe(one, HAND, perception)
    assert len(perception.asked) == 1
    assert one.executor.next_action(HAND) is not None  # straight on, no chunk is wanted


def test_an_object_that_is_not_found_is_looked_for_again_and_then_found():
    object_poses = entry().object_poses
    perception, one = Perception({"bowl": object_poses["bowl"]}), controller()
    for _ in range(LOOK_AGAIN_STEPS):
        observe(one, HAND, perception)
        assert one.state.status is Status.OBJECT_NOT_FOUND
        assert one.executor.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]
    assert len(perception.asked) == 1
    perception.object_poses = {"plate": object_poses["plate"]}  # what was seen once is remembered
    observe(one, HAND, perception)
    assert len(perception.asked) == 2
    assert one.state.status is Status.RUNNING


def test_key_poses_out_of_reach_are_infeasible():
    far = {name: T + np.array([[0, 0, 0, 3.0], *[[0] * 4] * 3]) for name, T in entry().object_poses.items()}
    one = controller()
    observe(one, HAND, Perception(far))
    assert one.state.status is Status.INFEASIBLE
    assert one.executor.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]


def test_what_was_infeasible_is_not_planned_again_before_something_moves(monkeypatch):
    far = {name: T + np.array([[0, 0, 0, 3.0], *[[0] * 4] * 3]) for name, T in entry().object_poses.items()}
    one, perception, planned = controller(), Perception(far), []
    choose = PlanningContext.choose
    monkeypatch.setattr(PlanningContext, "choose", lambda *given: planned.append(given) or choose(*given))
    for _ in range(3 * LOOK_AGAIN_STEPS):
        observe(one, HAND, perception)
    assert len(planned) == 1
    assert one.state.status is Status.INFEASIBLE
    perception.object_poses = entry().object_poses
    for _ in range(8 * LOOK_AGAIN_STEPS):
        observe(one, HAND, perception)
    assert len(planned) > 1
    assert one.state.status is Status.RUNNING
    assert one.state.refusal == ""


def test_an_object_that_moves_beyond_the_arms_reach_is_not_followed(request, caplog):
    arm = load_arm(request.config.rootpath / "configs/arms/libero_panda.urdf")
    # As if the table were LIBERO's.
    first, *others = arm.joints
    T = se3.transform(np.eye(3), [0.0, 0.0, -0.912]) @ first.T_before_joint
    arm = replace(arm, joints=(replace(first, T_before_joint=T), *others))
    wide = robot(workspace=np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]]), arm=arm)
    one = EpisodeController(replace(planning_context(), robot=wide), INSTRUCTION, 7, 0)
    perception = Perception(entry().object_poses)
    observe(one, HAND, perception)
    assert one.state.status is Status.RUNNING
    caplog.set_level("INFO")
    moved = entry().object_poses["plate"].copy()
    moved[:2, 3] = [0.6, 0.3]
    perception.object_poses["plate"] = moved
    watch(one, perception, HAND, 8 * LOOK_AGAIN_STEPS)
    assert_allclose(one.state.plan.object_poses["plate"], entry().object_poses["plate"])
    assert "not believed: key pose" in caplog.text
    assert "beyond what the arm's joints reach" in caplog.text


def test_a_feasible_entry_is_preferred_to_a_better_one_that_is_not():
    too_low = [
        type(pose)(
            **{**vars(pose), "T_obj_ee": pose.T_obj_ee - np.array([*[[0] * 4] * 2, [0, 0, 0, 0.5], [0] * 4])}
        )
        for pose in entry().key_poses
    ]
    bad, good = entry(key_poses=too_low, quality=1.0, source="bad"), entry(quality=0.1, source="good")
    one = controller(bad, good)
    observe(one, HAND, Perception(entry().object_poses))
    assert one.state.status is Status.RUNNING
    assert [scored.entry.source for scored in one.state.ranked] == ["good", "bad"]


def test_a_missed_grasp_looks_again_and_goes_to_where_the_object_is_now():
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, 3)
    moved = entry().object_poses["bowl"].copy()
    moved[0, 3] += 0.05
    perception.object_poses["bowl"] = moved
    observe(one, Hand(HAND.T_world_ee, 0.0), perception)
    assert len(perception.asked) == 2
    assert one.state.index == 0
    assert_allclose(one.executor.targets[0].T_world_ee, moved @ entry().key_poses[0].T_obj_ee)


@pytest.mark.parametrize("off", [{"tracking": False}, {"execution": "open_loop"}])
def test_a_camera_fault_at_the_start_does_not_hold_up_what_never_looks_again(off):
    perception, one = Perception(entry().object_poses), controller(**off)
    perception.faults = {"observation.images.front": Fault("is black or blank", 1.0)}
    observe(one, HAND, perception)
    assert one.state.status is Status.RUNNING
    assert one.state.status is not Status.PAUSED
    perception, one = Perception(entry().object_poses), controller()
    perception.faults = {"observation.images.front": Fault("is black or blank", 1.0)}
    observe(one, HAND, perception)
    assert one.state.status is Status.PAUSED
    perception.faults = {}
    watch(one, perception, HAND, 2)
    assert one.state.status is not Status.PAUSED


def test_what_is_seen_here_and_there_is_waited_for():
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    for i in range(20):
        perception.object_poses["bowl"] = shifted(entry().object_poses["bowl"], 0.1 * (-1) ** i)
        watch(one, perception, HAND, 3)
    assert (one.state.status is Status.PAUSED) or one.state.status is Status.OBJECT_LOST
    assert not one.executor.next_action(HAND)[:6].any()


def test_without_tracking_nothing_is_looked_for_again():
    perception, one = Perception(entry().object_poses), controller(tracking=False)
    observe(one, HAND, perception)
    perception.asked.clear()
    perception.object_poses["bowl"] = shifted(entry().object_poses["bowl"], 0.10)
    watch(one, perception, HAND, 100)
    assert perception.asked == []


def test_the_open_loop_does_not_look_again():
    perception, one = Perception(entry().object_poses), controller(execution="open_loop")
    observe(one, HAND, perception)
    perception.asked.clear()
    for _ in range(100):
        if one.executor.next_action(HAND) is None:
            one.executor.query(HAND)
            one.executor.push_chunk(np.zeros((5, 7)))
        observe(one, HAND, perception)
    assert one.state.index > 1
    assert perception.asked == []


@pytest.mark.parametrize(
    ("instruction", "why"),
    [
        ("put the box on the plate", "it knows: put the bowl on the plate"),
        ("sing a song", "no verb I know in 'sing a song'.*it knows"),
        ("", "says nothing"),
    ],
)
def test_what_is_not_understood_holds_still_and_says_why_once(instruction, why, caplog):
    one, perception = controller(instruction=instruction), Perception({})
    for _ in range(10):
        observe(one, HAND, perception)
        np.testing.assert_array_equal(one.executor.next_action(HAND), [0, 0, 0, 0, 0, 0, -1])
    assert one.state.status is Status.NOT_UNDERSTOOD
    assert re.search(why, one.state.refusal)
    assert [record.getMessage() for record in caplog.records] == [f"not acting: {one.state.refusal}"]
    assert perception.asked == []


def test_noise_is_a_function_of_seed_episode_and_chunk_alone():
    shape, perception = (5, 7), Perception(entry().object_poses)
    others = [controller(shown=8 + i) for i in range(1, 4)]  # made before: no shared generator moves on
    first, again = controller(), controller()
    noise = first.noise(shape)
    for other in others:
        assert not np.allclose(other.noise(shape), noise)
    assert_allclose(again.noise(shape), noise, rtol=0)
    assert not np.allclose(controller(seed=1).noise(shape), noise)
    assert not np.allclose(controller(instruction="place the bowl on the plate").noise(shape), noise)
    observe(first, HAND, perception)
    observe(again, HAND, perception)
    first.executor.query(HAND)
    again.executor.query(HAND)
    assert not np.allclose(first.noise(shape), noise)
    assert_allclose(first.noise(shape), again.noise(shape), rtol=0)
    assert abs(float(controller().noise((100, 100)).mean())) < 0.05
    assert float(controller().noise((100, 100)).std()) == pytest.approx(1, abs=0.05)


def test_a_place_that_something_takes_is_free_once_that_is_gone():
    poses = entry().object_poses
    context = planning_context(points={"bowl": BALL, "mug": BALL}, hand_radius_m=0.05)
    one = EpisodeController(context, INSTRUCTION, 7, 0)
    targets = Plan(entry(), poses, HAND.T_world_ee).targets(context)
    at = {one.key_pose.phase: one.T_world_ee for one in targets}
    mug = at["release"] @ se3.inverse(at["grasp"]) @ poses["bowl"]
    perception = Perception({**poses, "mug": mug})
    observe(one, HAND, perception)
    assert one.state.status is Status.INFEASIBLE
    assert one.state.refusal == "the plate is taken: the mug stands where the bowl would"
    del perception.object_poses["mug"]
    watch(one, perception, HAND, 16 * LOOK_AGAIN_STEPS)
    assert (one.state.status, one.state.refusal) == (Status.RUNNING, "")
