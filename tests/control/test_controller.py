import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.memory.builders import OPEN_WIDTH, entry, hand_pose, robot

from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.control.feasibility import TransferLimits
from lerobot_openspm.control.plan import MOVED_M
from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.control.scene import LOOK_AGAIN_S
from lerobot_openspm.control.state import Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import load_arm
from lerobot_openspm.perception.tracking.tracker import TrackStatus
from lerobot_openspm.types import Detections, Fault, Hand, PoseEstimate

HAND = Hand(hand_pose(0.0, 0.0, 0.3), OPEN_WIDTH)
INSTRUCTION = "put the bowl on the plate"
COVARIANCE = np.diag([1e-6, 1e-6, 1e-6, 1e-4])
STEP_S = 0.05
LOOK_AGAIN_STEPS = round(LOOK_AGAIN_S / STEP_S)


def planning_context(*entries, limits=None, execution="closed_loop_trc", **options):
    return PlanningContext(
        entries or (entry(),), {}, robot(), limits or TransferLimits(), execution, **options
    )


class Perception:
    """Sees the objects where it is told, and remembers what it was asked for."""

    def __init__(self, object_poses):
        self.object_poses, self.asked, self.faults = dict(object_poses), [], {}
        self.confidence = self.visible = 1.0

    def __call__(self, names, expected, time_s):
        self.asked.append(list(names))
        return Detections({name: self._estimate(name) for name in names}, self.faults)

    def _estimate(self, name):
        if name not in self.object_poses:
            return PoseEstimate("not_found", np.eye(4), COVARIANCE, 0.0, self.visible)
        return PoseEstimate("found", self.object_poses[name], COVARIANCE, self.confidence, self.visible)


def controller(*entries, instruction=INSTRUCTION, seed=0, shown=7, **options):
    return EpisodeController(planning_context(*entries, **options), instruction, shown, seed)


def observe(one, hand, perception):
    """One control step without its action, as the policy does it."""
    look = one.advance(hand)
    while look is not None:
        look = one.take_in(look, perception(look.names, look.expected, look.time_s), hand)


def watch(one, perception, hand, steps):
    """Let time pass, the hand standing still and nothing but chunks of zeros to do."""
    for _ in range(steps):
        if one.executor.next_action(hand) is None:
            one.executor.query(hand)
            one.executor.push_chunk(np.zeros((5, 7)))
        observe(one, hand, perception)


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
    assert one.executor.next_action(HAND) is None  # a chunk is wanted


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


def shifted(T, x):
    return se3.transform(T[:3, :3], T[:3, 3] + [x, 0.0, 0.0])


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
    perception, one = Perception(entry().object_poses), controller()
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
    assert one.executor.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]
    perception.object_poses["bowl"] = bowl
    watch(one, perception, HAND, 10)
    assert one.state.status is Status.RUNNING
    assert one.state.status is not Status.PAUSED
    assert one.executor.next_action(HAND) is None or np.isfinite(one.executor.next_action(HAND)).all()


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
