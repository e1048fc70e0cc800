"""What moves during an episode is noticed and followed."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import (
    HAND,
    LOOK_AGAIN_STEPS,
    Perception,
    controller,
    observe,
    planning_context,
    shifted,
    watch,
)
from tests.memory.builders import OPEN_WIDTH, entry

from lerobot_openspm.control.plan import MOVED_M
from lerobot_openspm.control.scene import SceneState
from lerobot_openspm.control.state import Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.tracking.tracker import FALLEN_M, FALLING_S, TrackStatus
from lerobot_openspm.types import Hand, PoseEstimate


def advanced(one, perception, index):
    """The controller, brought to a key pose as if the hand had got there."""
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, index - 1)
    before = one.executor.targets[index - 1]
    hand = Hand(before.T_world_ee, before.key_pose.opening)
    perception.asked.clear()
    observe(one, hand, perception)
    assert one.state.index == index
    return hand


def grasping(one, perception):
    """The hand, once it has closed around the bowl."""
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, 2)
    grasp = one.executor.targets[2]
    hand = Hand(grasp.T_world_ee, grasp.key_pose.opening)
    watch(one, perception, hand, grasp.key_pose.n_steps + 1)
    assert one.state.index == 3
    return hand


def test_at_every_key_pose_what_was_not_touched_is_looked_for_again():
    perception, one = Perception(entry().object_poses), controller()
    advanced(one, perception, 1)
    assert perception.asked == [["bowl", "plate"]]
    perception, one = Perception(entry().object_poses), controller()
    advanced(one, perception, 4)  # the bowl is in the hand
    assert perception.asked == [["plate"]]


def test_fingers_that_move_are_not_looked_past():
    perception, one = Perception(entry().object_poses), controller()
    advanced(one, perception, 2)
    assert one.executor.target.key_pose.dwell
    assert perception.asked == []


@pytest.mark.parametrize(("shift", "follows"), [(0.03, True), (-0.03, True), (0.004, True), (0.0015, False)])
def test_key_poses_follow_an_object_that_has_moved(shift, follows):
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    before = one.executor.targets
    perception.object_poses["plate"] = shifted(entry().object_poses["plate"], shift)
    watch(one, perception, HAND, 20)
    assert one.state.status is Status.RUNNING
    for old, new in zip(before, one.executor.targets, strict=True):
        expected = shift if follows and new.key_pose.anchor.place == "plate" else 0.0
        # What is seen next to its place is averaged with what was seen before; what jumped is not.
        assert_allclose(new.T_world_ee[0, 3] - old.T_world_ee[0, 3], expected, atol=MOVED_M)


def test_what_jumped_is_noticed_within_half_a_second_and_the_queued_chunk_is_dropped():
    perception, one = Perception(entry().object_poses), controller(execution="closed_loop")
    observe(one, HAND, perception)
    one.executor.push_chunk(np.full((5, 7), 0.5))
    one.executor.next_action(HAND)
    perception.object_poses["bowl"] = moved = shifted(entry().object_poses["bowl"], 0.10)
    for _ in range(10):  # half a second
        one.executor.push_chunk(np.full((5, 7), 0.5))
        observe(one, HAND, perception)
        if np.allclose(one.executor.targets[0].T_world_ee, moved @ entry().key_poses[0].T_obj_ee):
            break
    else:
        pytest.fail("not noticed within ten steps")
    assert one.executor.next_action(HAND) is None, "the old chunk leads to where the bowl was"


def test_seen_elsewhere_once_is_not_believed_yet():
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    before = [target.T_world_ee for target in one.executor.targets]
    perception.object_poses["plate"] = shifted(entry().object_poses["plate"], 0.10)
    watch(one, perception, HAND, LOOK_AGAIN_STEPS)
    assert one.scene.tracker.status("plate") is TrackStatus.AMBIGUOUS
    perception.object_poses = entry().object_poses
    watch(one, perception, HAND, 10)
    assert one.scene.tracker.status("plate") is TrackStatus.TRACKED
    assert_allclose([target.T_world_ee for target in one.executor.targets], before, atol=1e-9)


def test_an_object_that_jumps_under_the_hand_is_approached_from_above_again():
    perception, one = Perception(entry().object_poses), controller()
    advanced(one, perception, 1)  # above the bowl, on the way down
    perception.object_poses["bowl"] = shifted(entry().object_poses["bowl"], 0.10)
    watch(one, perception, HAND, 10)
    assert one.state.index == 0


def test_an_object_that_jumps_is_approached_from_where_the_hand_is():
    first, *others = entry().key_poses
    far = replace(first, T_obj_ee=se3.from_yaw([-0.3, 0.0, 0.1], 0.0) @ first.T_obj_ee)
    perception, one = Perception(entry().object_poses), controller(entry(key_poses=(far, first, *others)))
    hand = advanced(one, perception, 2)  # above the bowl, on the way down
    perception.object_poses["bowl"] = shifted(entry().object_poses["bowl"], 0.05)
    watch(one, perception, hand, 10)
    assert one.state.index == 1


def test_the_landmark_that_jumps_does_not_send_a_held_object_back():
    perception, one = Perception(entry().object_poses), controller(thin())
    hand = grasping(one, perception)
    one.executor.begin(one.executor.targets, hand, 5)  # over the plate, on the way down
    perception.object_poses["plate"] = shifted(entry().object_poses["plate"], 0.10)
    watch(one, perception, hand, 10)
    assert one.state.index == 4
    assert one.executor.targets[4].key_pose.phase == "pre-place"
    assert one.scene.tracker.held == {"bowl"}, "it is still in the hand, and would be missed"
    perception.object_poses["bowl"] = shifted(entry().object_poses["bowl"], -0.12)
    watch(one, perception, hand, 10)
    assert one.scene.tracker.held == frozenset()
    assert one.state.index == 0


def test_what_the_fingers_feel_is_in_the_hand_whatever_is_seen():
    perception, one = Perception(entry().object_poses), controller()
    hand = grasping(one, perception)
    index = one.state.index
    perception.object_poses["bowl"] = shifted(entry().object_poses["bowl"], -0.12)
    watch(one, perception, hand, 40)
    assert one.scene.tracker.held == {"bowl"}
    assert one.state.index >= index


def thin():
    """An entry whose object is too thin to be felt between the fingers."""
    poses = (replace(pose, opening=0.0) if pose.closed else pose for pose in entry().key_poses)
    return replace(entry(), key_poses=tuple(poses))


def test_a_dropped_object_that_was_not_felt_is_fetched_from_where_it_fell():
    perception, one = Perception(entry().object_poses), controller(thin())
    hand = grasping(one, perception)
    assert one.scene.tracker.held == {"bowl"}
    perception.object_poses["bowl"] = fallen = shifted(entry().object_poses["bowl"], -0.12)
    watch(one, perception, hand, 10)
    assert one.scene.tracker.held == frozenset()
    assert one.state.index == 0
    assert_allclose(one.executor.targets[0].T_world_ee, fallen @ entry().key_poses[0].T_obj_ee, atol=1e-9)
    assert one.state.attempts == 0, "it was not the grasp's fault"


@pytest.mark.parametrize("glimpse", [{"confidence": 0.85}, {"visible": 0.3}])
def test_a_glimpse_past_the_hand_is_not_believed(glimpse):
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    before = [target.T_world_ee for target in one.executor.targets]
    perception.object_poses["plate"] = shifted(entry().object_poses["plate"], 0.03)
    vars(perception).update(glimpse)
    watch(one, perception, HAND, 40)
    assert len(perception.asked) > 5
    assert_allclose([target.T_world_ee for target in one.executor.targets], before)
    assert one.scene.tracker.status("plate") is TrackStatus.HIDDEN


def test_a_place_out_of_reach_is_not_believed():
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    before = [target.T_world_ee for target in one.executor.targets]
    perception.object_poses["plate"] = shifted(entry().object_poses["plate"], 3.0)
    watch(one, perception, HAND, 20)
    assert one.state.status is Status.RUNNING
    assert_allclose([target.T_world_ee for target in one.executor.targets], before, atol=1e-9)


def test_what_is_missing_may_be_in_the_hand_unless_something_else_is():
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    hand = Hand(HAND.T_world_ee, OPEN_WIDTH / 3)
    told = one.scene.why_missing(["plate"], hand)
    assert told.endswith("the fingers are around something, which may be it")
    one.scene.tracker.hold("bowl", HAND.T_world_ee)
    assert "fingers" not in one.scene.why_missing(["plate"], hand)


def test_what_is_gone_is_waited_for_then_lost_and_taken_up_again_when_it_is_back():
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    bowl = perception.object_poses.pop("bowl")
    watch(one, perception, HAND, 18)  # nine tenths of a second
    assert one.scene.tracker.status("bowl") is TrackStatus.STALE
    assert one.state.status is Status.PAUSED
    assert one.executor.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]
    watch(one, perception, HAND, 60)
    assert one.scene.tracker.status("bowl") is TrackStatus.LOST
    assert one.state.status is Status.OBJECT_LOST
    assert one.state.refusal.startswith("cannot find the bowl")
    assert one.executor.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]
    perception.object_poses["bowl"] = bowl
    watch(one, perception, HAND, 10)
    assert (one.state.status, one.state.refusal) == (Status.RUNNING, "")
    assert one.state.status is not Status.PAUSED
    assert one.executor.next_action(HAND) is None or np.isfinite(one.executor.next_action(HAND)).all()


@pytest.mark.parametrize(("share", "is_loaded"), [(0.5, True), (1.0, False)])
def test_what_the_fingers_are_around_is_left_out_until_all_is_seen(share, is_loaded):
    # The plate is seen, and the bowl may be in the hand.
    perception, one = Perception({"plate": entry().object_poses["plate"]}), controller()
    hand, looks = Hand(HAND.T_world_ee, share * HAND.opening), []
    for _ in range(12):
        look = one.advance(hand)
        while look is not None:
            looks.append(look.is_loaded)
            look = one.take_in(look, perception(look.names, look.expected, look.time_s), hand)
    assert len(looks) > 1
    assert set(looks) == {is_loaded}


def test_what_hides_behind_the_hand_is_not_lost():
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    perception.object_poses, perception.visible = {}, 0.2
    watch(one, perception, HAND, 100)
    assert one.state.status is Status.RUNNING
    assert one.scene.tracker.status("bowl") is TrackStatus.HIDDEN


@pytest.mark.parametrize("step_s", [0.01, 0.05, 0.1, 0.3])
def test_how_soon_a_jump_is_noticed_does_not_hang_on_the_robots_rate(step_s):
    perception, one = Perception(entry().object_poses), controller(step_s=step_s)
    observe(one, HAND, perception)
    perception.object_poses["bowl"] = moved = shifted(entry().object_poses["bowl"], 0.10)
    watch(one, perception, HAND, max(2, int(0.5 / step_s + 1e-9)))
    assert_allclose(one.executor.targets[0].T_world_ee, moved @ entry().key_poses[0].T_obj_ee)


def test_what_fell_from_high_up_is_looked_for_anywhere_once_it_has_come_to_rest():
    scene, found = (
        SceneState(planning_context()),
        PoseEstimate("found", np.eye(4), np.eye(4) * 1e-6, 1.0),
    )
    scene.tracker.look({"bowl": found}, HAND.T_world_ee, 0.0)
    assert scene.look(["bowl"], HAND).expected.keys() == {"bowl"}
    scene.tracker.hold("bowl", HAND.T_world_ee)
    T_high = se3.transform(HAND.T_world_ee[:3, :3], HAND.T_world_ee[:3, 3] + [0.0, 0.0, 2 * FALLEN_M])
    scene.doubt({"bowl"}, Hand(T_high, OPEN_WIDTH))
    falling = scene.look(["bowl", "plate"], HAND)
    assert (falling.names, dict(falling.expected)) == (("plate",), {})
    for _ in range(round(FALLING_S / scene._context.step_s) + 1):
        scene.predict()
    fallen = scene.look(["bowl", "plate"], HAND)
    assert (fallen.names, dict(fallen.expected)) == (("bowl", "plate"), {})
    scene.tracker.look({"bowl": found}, HAND.T_world_ee, 0.0)
    assert scene.look(["bowl"], HAND).expected.keys() == {"bowl"}
