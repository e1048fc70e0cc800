import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.memory.builders import OPEN_WIDTH, entry, hand_pose, robot

from lerobot_openspm.control.checks import TransferLimits
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.control.planner import MOVED_M
from lerobot_openspm.control.planning_context import PlanningContext
from lerobot_openspm.control.scene import BLIND_S, GIVE_UP_S, LOOK_AGAIN_S
from lerobot_openspm.control.status import Status
from lerobot_openspm.control.strategies import ControlSettings
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.retrieval import ScoreWeights
from lerobot_openspm.perception.tracking.tracker import TrackStatus
from lerobot_openspm.types import Detections, Fault, Hand, PoseEstimate

HAND = Hand(hand_pose(0.0, 0.0, 0.3), OPEN_WIDTH)
INSTRUCTION = "put the bowl on the plate"
COVARIANCE = np.diag([1e-6, 1e-6, 1e-6, 1e-4])
STEP_S = 0.05
LOOK_AGAIN_STEPS = round(LOOK_AGAIN_S / STEP_S)


def knowledge(*entries, limits=None, execution="closed_loop_trc", **options):
    return PlanningContext(
        entries or (entry(),), {}, robot(), ScoreWeights(), limits or TransferLimits(),
        ControlSettings(execution=execution), **options,
    )  # fmt: skip


class Perception:
    """Sees the objects where it is told, and remembers what it was asked for."""

    def __init__(self, layout):
        self.layout, self.asked, self.confidence, self.visible, self.faults = dict(layout), [], 1.0, 1.0, {}

    def __call__(self, names, expected, time_s):
        self.asked.append(list(names))
        return Detections({name: self._estimate(name) for name in names}, self.faults)

    def _estimate(self, name):
        if name not in self.layout:
            return PoseEstimate("not_found", np.eye(4), COVARIANCE, 0.0, self.visible)
        return PoseEstimate("found", self.layout[name], COVARIANCE, self.confidence, self.visible)


def row(*entries, instruction=INSTRUCTION, seed=0, shown=7, **options):
    return EpisodeController(knowledge(*entries, **options), instruction, shown, seed)


def watch(one, eyes, hand, steps):
    """Let time pass, the hand standing still and nothing but chunks of zeros to do."""
    for _ in range(steps):
        if one.next_action(hand) is None:
            one.query(hand)
            one.executor.push_chunk(np.zeros((5, 7)))
        one.observe(hand, eyes)


def test_the_first_observation_makes_a_plan():
    eyes, one = Perception(entry().layout), row()
    assert one.status is Status.WAITING
    one.observe(HAND, eyes)
    assert one.status is Status.RUNNING
    assert eyes.asked == [["bowl", "plate"]]
    bowl = entry().layout["bowl"]
    assert_allclose(one.executor.plan[0].T_world_ee, bowl @ entry().key_poses[0].T_obj_ee)
    one.observe(HAND, eyes)
    assert len(eyes.asked) == 1
    assert one.next_action(HAND) is None  # a chunk is wanted


def test_an_object_that_is_not_found_is_looked_for_again_and_then_found():
    layout = entry().layout
    eyes, one = Perception({"bowl": layout["bowl"]}), row()
    for _ in range(LOOK_AGAIN_STEPS):
        one.observe(HAND, eyes)
        assert one.status is Status.OBJECT_NOT_FOUND
        assert one.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]
    assert len(eyes.asked) == 1
    eyes.layout = {"plate": layout["plate"]}  # what was seen once is remembered
    one.observe(HAND, eyes)
    assert len(eyes.asked) == 2
    assert one.status is Status.RUNNING


def test_key_poses_out_of_reach_are_infeasible():
    far = {name: T + np.array([[0, 0, 0, 3.0], *[[0] * 4] * 3]) for name, T in entry().layout.items()}
    one = row()
    one.observe(HAND, Perception(far))
    assert one.status is Status.INFEASIBLE
    assert one.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]


def test_a_feasible_entry_is_preferred_to_a_better_one_that_is_not():
    too_low = [
        type(pose)(
            **{**vars(pose), "T_obj_ee": pose.T_obj_ee - np.array([*[[0] * 4] * 2, [0, 0, 0, 0.5], [0] * 4])}
        )
        for pose in entry().key_poses
    ]
    bad, good = entry(key_poses=too_low, quality=1.0, source="bad"), entry(quality=0.1, source="good")
    one = row(bad, good)
    one.observe(HAND, Perception(entry().layout))
    assert one.status is Status.RUNNING
    assert [scored.entry.source for scored in one.planner.ranked] == ["good", "bad"]


def test_a_missed_grasp_looks_again_and_goes_to_where_the_object_is_now():
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    one.executor.begin(one.executor.plan, HAND, 3)
    moved = entry().layout["bowl"].copy()
    moved[0, 3] += 0.05
    eyes.layout["bowl"] = moved
    one.observe(Hand(HAND.T_world_ee, 0.0), eyes)
    assert len(eyes.asked) == 2
    assert one.executor.index == 0
    assert_allclose(one.executor.plan[0].T_world_ee, moved @ entry().key_poses[0].T_obj_ee)


def advanced(one, eyes, index):
    """The row, brought to a key pose as if the hand had got there."""
    one.observe(HAND, eyes)
    one.executor.begin(one.executor.plan, HAND, index - 1)
    before = one.executor.plan[index - 1]
    hand = Hand(before.T_world_ee, before.key_pose.opening)
    eyes.asked.clear()
    one.observe(hand, eyes)
    assert one.executor.index == index
    return hand


def grasping(one, eyes):
    """The hand, once it has closed around the bowl."""
    one.observe(HAND, eyes)
    one.executor.begin(one.executor.plan, HAND, 2)
    grasp = one.executor.plan[2]
    hand = Hand(grasp.T_world_ee, grasp.key_pose.opening)
    watch(one, eyes, hand, grasp.key_pose.n_steps + 1)
    assert one.executor.index == 3
    return hand


def shifted(T, x):
    return se3.transform(T[:3, :3], T[:3, 3] + [x, 0.0, 0.0])


def test_at_every_key_pose_what_was_not_touched_is_looked_for_again():
    eyes, one = Perception(entry().layout), row()
    advanced(one, eyes, 1)
    assert eyes.asked == [["bowl", "plate"]]
    eyes, one = Perception(entry().layout), row()
    advanced(one, eyes, 4)  # the bowl is in the hand
    assert eyes.asked == [["plate"]]


def test_fingers_that_move_are_not_looked_past():
    eyes, one = Perception(entry().layout), row()
    advanced(one, eyes, 2)
    assert one.executor.target.key_pose.dwell
    assert eyes.asked == []


@pytest.mark.parametrize(("shift", "follows"), [(0.03, True), (-0.03, True), (0.004, True), (0.0015, False)])
def test_key_poses_follow_an_object_that_has_moved(shift, follows):
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    before = one.executor.plan
    eyes.layout["plate"] = shifted(entry().layout["plate"], shift)
    watch(one, eyes, HAND, 20)
    assert one.status is Status.RUNNING
    for old, new in zip(before, one.executor.plan, strict=True):
        expected = shift if follows and new.key_pose.anchor.place == "plate" else 0.0
        # What is seen next to its place is averaged with what was seen before; what jumped is not.
        assert_allclose(new.T_world_ee[0, 3] - old.T_world_ee[0, 3], expected, atol=MOVED_M)


def test_what_jumped_is_noticed_within_half_a_second_and_the_queued_chunk_is_dropped():
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    one.executor.push_chunk(np.full((5, 7), 0.5))
    one.next_action(HAND)
    eyes.layout["bowl"] = moved = shifted(entry().layout["bowl"], 0.10)
    for _ in range(10):  # half a second
        one.executor.push_chunk(np.full((5, 7), 0.5))
        one.observe(HAND, eyes)
        if np.allclose(one.executor.plan[0].T_world_ee, moved @ entry().key_poses[0].T_obj_ee):
            break
    else:
        pytest.fail("not noticed within ten steps")
    assert one.next_action(HAND) is None, "the old chunk leads to where the bowl was"


def test_seen_elsewhere_once_is_not_believed_yet():
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    before = [target.T_world_ee for target in one.executor.plan]
    eyes.layout["plate"] = shifted(entry().layout["plate"], 0.10)
    watch(one, eyes, HAND, LOOK_AGAIN_STEPS)
    assert one.scene.tracker.status("plate") is TrackStatus.AMBIGUOUS
    eyes.layout = entry().layout
    watch(one, eyes, HAND, 10)
    assert one.scene.tracker.status("plate") is TrackStatus.TRACKED
    assert_allclose([target.T_world_ee for target in one.executor.plan], before, atol=1e-9)


def test_an_object_that_jumps_under_the_hand_is_approached_from_above_again():
    eyes, one = Perception(entry().layout), row()
    advanced(one, eyes, 1)  # above the bowl, on the way down
    eyes.layout["bowl"] = shifted(entry().layout["bowl"], 0.10)
    watch(one, eyes, HAND, 10)
    assert one.executor.index == 0


def test_the_landmark_that_jumps_does_not_send_a_held_object_back():
    eyes, one = Perception(entry().layout), row()
    hand = grasping(one, eyes)
    one.executor.begin(one.executor.plan, hand, 5)  # over the plate, on the way down
    eyes.layout["plate"] = shifted(entry().layout["plate"], 0.10)
    watch(one, eyes, hand, 10)
    assert one.executor.index == 4
    assert one.executor.plan[4].key_pose.phase == "pre-place"
    assert one.scene.tracker.held == {"bowl"}, "it is still in the hand, and would be missed"
    eyes.layout["bowl"] = shifted(entry().layout["bowl"], -0.12)
    watch(one, eyes, hand, 10)
    assert one.scene.tracker.held == frozenset()
    assert one.executor.index == 0


def test_a_dropped_object_is_fetched_from_where_it_fell():
    eyes, one = Perception(entry().layout), row()
    hand = grasping(one, eyes)
    assert one.scene.tracker.held == {"bowl"}
    eyes.layout["bowl"] = fallen = shifted(entry().layout["bowl"], -0.12)
    watch(one, eyes, hand, 10)
    assert one.scene.tracker.held == frozenset()
    assert one.executor.index == 0
    assert_allclose(one.executor.plan[0].T_world_ee, fallen @ entry().key_poses[0].T_obj_ee, atol=1e-9)
    assert one.executor.attempts == 0, "it was not the grasp's fault"


@pytest.mark.parametrize("glimpse", [{"confidence": 0.85}, {"visible": 0.3}])
def test_a_glimpse_past_the_hand_is_not_believed(glimpse):
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    before = [target.T_world_ee for target in one.executor.plan]
    eyes.layout["plate"] = shifted(entry().layout["plate"], 0.03)
    vars(eyes).update(glimpse)
    watch(one, eyes, HAND, 40)
    assert len(eyes.asked) > 5
    assert_allclose([target.T_world_ee for target in one.executor.plan], before)
    assert one.scene.tracker.status("plate") is TrackStatus.HIDDEN


def test_a_place_out_of_reach_is_not_believed():
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    before = [target.T_world_ee for target in one.executor.plan]
    eyes.layout["plate"] = shifted(entry().layout["plate"], 3.0)
    watch(one, eyes, HAND, 20)
    assert one.status is Status.RUNNING
    assert_allclose([target.T_world_ee for target in one.executor.plan], before, atol=1e-9)


def test_what_is_gone_is_waited_for_then_lost_and_taken_up_again_when_it_is_back():
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    bowl = eyes.layout.pop("bowl")
    watch(one, eyes, HAND, 18)  # nine tenths of a second
    assert one.scene.tracker.status("bowl") is TrackStatus.STALE
    assert one.status is Status.PAUSED
    assert one.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]
    watch(one, eyes, HAND, 60)
    assert one.scene.tracker.status("bowl") is TrackStatus.LOST
    assert one.status is Status.OBJECT_LOST
    assert one.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]
    eyes.layout["bowl"] = bowl
    watch(one, eyes, HAND, 10)
    assert one.status is Status.RUNNING
    assert one.status is not Status.PAUSED
    assert one.next_action(HAND) is None or np.isfinite(one.next_action(HAND)).all()


def test_what_hides_behind_the_hand_is_not_lost():
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    eyes.layout, eyes.visible = {}, 0.2
    watch(one, eyes, HAND, 100)
    assert one.status is Status.RUNNING
    assert one.scene.tracker.status("bowl") is TrackStatus.HIDDEN


@pytest.mark.parametrize("step_s", [0.01, 0.05, 0.1, 0.3])
def test_how_soon_a_jump_is_noticed_does_not_hang_on_the_robots_rate(step_s):
    eyes, one = Perception(entry().layout), row(step_s=step_s)
    one.observe(HAND, eyes)
    eyes.layout["bowl"] = moved = shifted(entry().layout["bowl"], 0.10)
    watch(one, eyes, HAND, max(2, int(0.5 / step_s + 1e-9)))
    assert_allclose(one.executor.plan[0].T_world_ee, moved @ entry().key_poses[0].T_obj_ee)


@pytest.mark.parametrize("off", [{"tracking": False}, {"execution": "open_loop"}])
def test_a_camera_fault_at_the_start_does_not_hold_up_what_never_looks_again(off):
    eyes, one = Perception(entry().layout), row(**off)
    eyes.faults = {"observation.images.front": Fault("is black or blank", 1.0)}
    one.observe(HAND, eyes)
    assert one.status is Status.RUNNING
    assert one.status is not Status.PAUSED
    eyes, one = Perception(entry().layout), row()
    eyes.faults = {"observation.images.front": Fault("is black or blank", 1.0)}
    one.observe(HAND, eyes)
    assert one.status is Status.PAUSED
    eyes.faults = {}
    watch(one, eyes, HAND, 2)
    assert one.status is not Status.PAUSED


def test_what_is_seen_here_and_there_is_waited_for():
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    for i in range(20):
        eyes.layout["bowl"] = shifted(entry().layout["bowl"], 0.1 * (-1) ** i)
        watch(one, eyes, HAND, 3)
    assert (one.status is Status.PAUSED) or one.status is Status.OBJECT_LOST
    assert not one.next_action(HAND)[:6].any()


def test_without_tracking_nothing_is_looked_for_again():
    eyes, one = Perception(entry().layout), row(tracking=False)
    one.observe(HAND, eyes)
    eyes.asked.clear()
    eyes.layout["bowl"] = shifted(entry().layout["bowl"], 0.10)
    watch(one, eyes, HAND, 100)
    assert eyes.asked == []


def test_a_broken_camera_is_gone_without_for_half_a_second_then_held_still_for_then_given_up(caplog):
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    seconds = 0.0
    while one.status in (Status.RUNNING, Status.PAUSED) and seconds < 5:
        eyes.faults = {"observation.images.front": Fault("is black or blank", seconds)}
        watch(one, eyes, HAND, 1)
        # The clock runs in the camera watch; here it is looked at as soon as there is a fault to see.
        held_still = one.status in (Status.PAUSED, Status.CAMERA_FAULT)
        assert held_still == (seconds >= BLIND_S) or seconds < LOOK_AGAIN_S
        seconds += STEP_S
    assert seconds == pytest.approx(GIVE_UP_S + STEP_S)
    assert one.status is Status.CAMERA_FAULT
    assert "observation.images.front" in caplog.text
    assert one.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]
    eyes.faults = {}
    watch(one, eyes, HAND, 50)
    assert one.status is Status.CAMERA_FAULT, "a person has to look at it first"


def test_a_camera_that_recovers_in_time_is_forgiven():
    eyes, one = Perception(entry().layout), row()
    one.observe(HAND, eyes)
    eyes.faults = {"observation.images.front": Fault("is frozen", 1.0)}
    watch(one, eyes, HAND, 6)
    assert one.status is Status.PAUSED
    eyes.faults = {}
    watch(one, eyes, HAND, 6)
    assert one.status is Status.RUNNING


def test_the_open_loop_does_not_look_again():
    eyes, one = Perception(entry().layout), row(execution="open_loop")
    one.observe(HAND, eyes)
    eyes.asked.clear()
    for _ in range(100):
        if one.next_action(HAND) is None:
            one.query(HAND)
            one.executor.push_chunk(np.zeros((5, 7)))
        one.observe(HAND, eyes)
    assert one.executor.index > 1
    assert eyes.asked == []


@pytest.mark.parametrize(
    ("instruction", "why"),
    [
        ("put the box on the plate", "it knows: put the bowl on the plate"),
        ("sing a song", "no verb I know in 'sing a song'.*it knows"),
        ("", "says nothing"),
    ],
)
def test_what_is_not_understood_holds_still_and_says_why_once(instruction, why, caplog):
    one, eyes = row(instruction=instruction), Perception({})
    for _ in range(10):
        one.observe(HAND, eyes)
        np.testing.assert_array_equal(one.next_action(HAND), [0, 0, 0, 0, 0, 0, -1])
    assert one.status is Status.NOT_UNDERSTOOD
    assert re.search(why, one.refusal)
    assert [record.getMessage() for record in caplog.records] == [f"not acting: {one.refusal}"]
    assert eyes.asked == []


def test_noise_is_a_function_of_seed_episode_and_chunk_alone():
    shape, eyes = (5, 7), Perception(entry().layout)
    others = [row(shown=8 + i) for i in range(1, 4)]  # made before: no shared generator moves on
    first, again = row(), row()
    noise = first.noise(shape)
    for other in others:
        assert not np.allclose(other.noise(shape), noise)
    assert_allclose(again.noise(shape), noise, rtol=0)
    assert not np.allclose(row(seed=1).noise(shape), noise)
    assert not np.allclose(row(instruction="place the bowl on the plate").noise(shape), noise)
    first.observe(HAND, eyes)
    again.observe(HAND, eyes)
    first.query(HAND)
    again.query(HAND)
    assert not np.allclose(first.noise(shape), noise)
    assert_allclose(first.noise(shape), again.noise(shape), rtol=0)
    assert abs(float(row().noise((100, 100)).mean())) < 0.05
    assert float(row().noise((100, 100)).std()) == pytest.approx(1, abs=0.05)
