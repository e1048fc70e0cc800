"""Pushes are carried over along their way: from where the target is to where it should end."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from tests.control.acting import HAND, Perception, controller, observe, shifted, watch
from tests.memory.builders import entry, hand_pose, key_pose, robot

from lerobot_openspm.control.executor import MAX_ATTEMPTS, Executor
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.control.pushes import push_paths
from lerobot_openspm.control.scene import LEFT_BEHIND_M, OUTRUN_M
from lerobot_openspm.control.state import EpisodeState, Status
from lerobot_openspm.control.strategies import CORRECTION_SHARE
from lerobot_openspm.control.transfer import Target, transfer, turn_about
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import Anchor, Outcome
from lerobot_openspm.perception.tracking.tracker import TrackStatus
from lerobot_openspm.types import Hand, Symmetry

INSTRUCTION = "push the plate to the front of the stove"
LAYOUT = {"plate": se3.from_yaw([0.3, 0.1, 0.0], 0.0), "stove": se3.from_yaw([-0.1, 0.0, 0.0], 0.0)}
GOAL = np.array([0.22, 0.0, 0.0])
# The hand leads the plate by this much: it drags it by its rim.
LEAD_M = 0.07
# The middle of a plate whose frame lies beside it.
BESIDE = np.array([0.04, 0.0])


def push(goal=GOAL, shown=GOAL, middle=(0.0, 0.0)):
    """A plate that is dragged from where it stands to a place before the stove."""
    start = se3.apply(LAYOUT["plate"], np.array([[*middle, 0.0]]))[0]
    end = se3.apply(LAYOUT["stove"], shown[None])[0]
    way = (end - start) / np.linalg.norm(end - start)
    inside, done = start + 0.03 * way, end + LEAD_M * way

    def at(name, point, z):
        T_world_ee = hand_pose(point[0], point[1], z)
        return se3.inverse(LAYOUT[name]) @ T_world_ee

    poses = (
        key_pose("plate", at("plate", inside, 0.1), "approach", closed=True),
        key_pose("plate", at("plate", inside, 0.02), "approach", closed=True),
        key_pose("stove", at("stove", done, 0.02), "push", closed=True),
        key_pose("stove", at("stove", done, 0.12), "retreat", closed=True),
    )
    outcome = Outcome(0, "plate", Anchor("stove", "stove"), goal, shown, 0.02, middle)
    return entry(INSTRUCTION, poses, LAYOUT, outcomes=(outcome,))


def ends(memory, object_poses):
    """Where the hand enters the plate and where it stops pushing, (3,) each."""
    targets = transfer(memory, object_poses, {}, HAND.T_world_ee)
    return targets[1].T_world_ee[:3, 3], targets[2].T_world_ee[:3, 3]


def test_in_the_demonstrated_scene_the_hand_does_what_was_demonstrated():
    memory = push()
    for target, pose in zip(transfer(memory, LAYOUT, {}, HAND.T_world_ee), memory.key_poses, strict=True):
        assert_allclose(target.T_world_ee, pose.anchor.frame(LAYOUT) @ pose.T_obj_ee, atol=1e-12)


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_from_wherever_the_plate_stands_the_hand_leads_it_to_its_place(x, y, yaw):
    object_poses = {
        "plate": se3.from_yaw([0.4 + x, y, 0.0], 2.0),
        "stove": LAYOUT["stove"] @ se3.from_yaw([0.0, 0.0, 0.0], yaw),
    }
    goal = se3.apply(object_poses["stove"], GOAL[None])[0]
    way = (goal - object_poses["plate"][:3, 3])[:2]
    if np.linalg.norm(way) < 0.01:
        return
    inside, done = ends(push(), object_poses)
    lead = way / np.linalg.norm(way)
    assert_allclose(inside[:2], object_poses["plate"][:2, 3] + 0.03 * lead, atol=1e-9)
    assert_allclose(done[:2], goal[:2] + LEAD_M * lead, atol=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 1.0, 2.5])
def test_a_round_thing_is_pushed_to_its_place_however_it_was_found_turned(yaw):
    round_plate = {"plate": Symmetry(BESIDE, 0.0)}
    context = PlanningContext((), {"plate": 2 * np.pi, "stove": 2 * np.pi}, robot(), symmetries=round_plate)
    memory = push(middle=(BESIDE[0], BESIDE[1]))
    now = LAYOUT | {"plate": LAYOUT["plate"] @ turn_about(BESIDE, yaw)}
    plan = Plan(memory, now, HAND.T_world_ee)
    for target, expected in zip(
        plan.targets(context), transfer(memory, LAYOUT, {}, HAND.T_world_ee), strict=True
    ):
        assert_allclose(target.T_world_ee, expected.T_world_ee, atol=1e-9)
    goal = se3.apply(LAYOUT["stove"], GOAL[None])[0]
    (outcome,) = memory.outcomes
    # On its way it turned once more.
    ended = now | {"plate": se3.from_yaw(goal, 2.0) @ se3.from_yaw([*-BESIDE, 0.0], 0.0)}
    assert outcome.is_met(plan.as_if_in_place(ended, round_plate))
    # What is put on it afterwards is judged as it was shown.
    shown = plan.as_if_in_place(ended, round_plate)["plate"]
    assert_allclose(shown[:3, :3], LAYOUT["plate"][:3, :3], atol=1e-9)
    beside = now | {"plate": se3.from_yaw([0.03, 0.0, 0.0], 0.0) @ ended["plate"]}
    assert not outcome.is_met(plan.as_if_in_place(beside, round_plate))


def test_the_height_of_a_push_is_that_of_what_stands_still():
    object_poses = {**LAYOUT, "plate": se3.from_yaw([0.3, 0.1, 0.006], 0.0)}
    inside, done = ends(push(), object_poses)
    assert_allclose([inside[2], done[2]], 0.02, atol=1e-12)


def test_a_demonstration_that_stopped_short_is_pushed_to_where_the_others_end():
    short = GOAL + np.array([0.015, 0.0, 0.0])
    _, done = ends(push(GOAL, short), LAYOUT)
    _, expected = ends(push(), LAYOUT)
    assert_allclose(done, expected, atol=1e-3)


def test_a_plate_that_is_almost_there_is_not_turned_about():
    memory, goal = push(), se3.apply(LAYOUT["stove"], GOAL[None])[0]
    object_poses = {**LAYOUT, "plate": se3.from_yaw(goal + np.array([0.001, -0.001, 0.0]), 0.0)}
    inside, _ = ends(memory, object_poses)
    shown, _ = ends(memory, LAYOUT)
    assert_allclose(inside - object_poses["plate"][:3, 3], shown - LAYOUT["plate"][:3, 3], atol=1e-9)


def test_a_push_without_a_known_outcome_ends_where_the_demonstration_did():
    memory = push()
    unknown = entry(INSTRUCTION, memory.key_poses, LAYOUT)
    object_poses = {**LAYOUT, "plate": se3.from_yaw([0.3, -0.2, 0.0], 0.0)}
    _, done = ends(unknown, object_poses)
    assert_allclose(done, ends(memory, LAYOUT)[1], atol=1e-12)


@pytest.mark.parametrize("phase", ["push", "open", "turn"])
def test_a_hand_that_strays_while_it_pushes_is_led_back_to_its_way(phase):
    executor = Executor("closed_loop_trc", robot(), EpisodeState())
    memory = replace(push().key_poses[2], phase=phase)
    path = push_paths(push(), LAYOUT)[0] if phase == "push" else None
    start, end = hand_pose(0.3, 0.0, 0.02), hand_pose(0.1, 0.0, 0.02)
    executor.begin([Target(end, memory, precise=True, push=path)], Hand(start, 0.0))
    strayed = Hand(hand_pose(0.2, 0.004, 0.028), 0.0)
    assert executor.next_action(strayed) is None, "the flow model gives the way"
    executor.push_chunk(np.tile([-0.5, 0.3, 0.3, 0, 0, 0.1, 1.0], (5, 1)))
    action = executor.next_action(strayed)
    assert action[0] == -0.5, "along the way the flow model decides"
    assert_allclose(action[3:], [0, 0, 0.1, 1.0])
    if phase == "push":
        back = -CORRECTION_SHARE * np.array([0.004, 0.008]) / robot().metres_per_action
        assert_allclose(action[1:3], back)
    else:  # a drawer or a knob leads the hand
        assert_allclose(action[1:3], 0.3)


@given(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-1, 1), st.floats(-1, 1))
def test_an_action_that_leads_back_to_the_way_stays_within_bounds(y, z, along, across):
    executor = Executor("closed_loop_trc", robot(), EpisodeState())
    memory, path = push().key_poses[2], push_paths(push(), LAYOUT)[0]
    start, end = hand_pose(0.3, 0.0, 0.02), hand_pose(0.1, -0.1, 0.02)
    executor.begin([Target(end, memory, precise=True, push=path)], Hand(start, 0.0))
    executor.push_chunk(np.array([[along, across, 0.0, 0.0, 0.0, 0.0, 1.0]]))
    action = executor.next_action(Hand(hand_pose(0.2, -0.05 + y, 0.02 + z), 0.0))
    assert np.abs(action[:3]).max() <= 1 + 1e-9


def turning_push():
    """A push that turns on its way, with nothing known of where the plate ends."""
    approach, contact, end, _ = push().key_poses
    corner = key_pose("plate", contact.T_obj_ee @ se3.from_yaw([0.0, 0.1, 0.0], 0.0), "push", closed=True)
    return entry(INSTRUCTION, (approach, contact, corner, end), LAYOUT)


def test_where_a_push_turns_the_hand_passes_by():
    targets = transfer(turning_push(), LAYOUT, {}, HAND.T_world_ee)
    assert [target.precise for target in targets[:4]] == [False, True, False, True]


def test_a_plate_goes_along_around_the_turn_of_a_push_and_is_let_go_at_its_end():
    perception, one = Perception(LAYOUT), controller(turning_push(), instruction=INSTRUCTION)
    observe(one, HAND, perception)
    perception.visible = 0.0
    ends = [target.T_world_ee for target in one.executor.targets]
    one.executor.begin(one.executor.targets, HAND, 1)
    for index, is_held in ((1, True), (2, True), (3, False)):
        watch(one, perception, Hand(ends[index], 0.0), 1)
        assert one.state.index == index + 1
        assert (one.scene.tracker.held == {"plate"}) is is_held, index
        assert_allclose(one.executor.targets[2].T_world_ee, ends[2], atol=1e-9)


def test_what_is_pushed_goes_along_and_not_what_the_hand_began_relative_to():
    approach, contact, corner, end = turning_push().key_poses
    T_plate, T_stove = LAYOUT["plate"], LAYOUT["stove"]
    of_stove = replace(
        contact, anchor=Anchor("stove", "stove"), T_obj_ee=se3.inverse(T_stove) @ T_plate @ contact.T_obj_ee
    )
    memory = entry(INSTRUCTION, (approach, of_stove, corner, end), LAYOUT)
    perception, one = Perception(LAYOUT), controller(memory, instruction=INSTRUCTION)
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, 1)
    watch(one, perception, Hand(one.executor.targets[1].T_world_ee, 0.0), 1)
    assert one.scene.tracker.held == {"plate"}


def test_a_plate_that_the_hand_has_not_reached_yet_is_not_left_behind():
    for gone, is_fetched in ((0.5 * OUTRUN_M, False), (3 * OUTRUN_M, True)):
        perception, one = Perception(LAYOUT), controller(turning_push(), instruction=INSTRUCTION)
        observe(one, HAND, perception)
        contact = one.executor.targets[1].T_world_ee
        one.executor.begin(one.executor.targets, HAND, 1)
        watch(one, perception, Hand(contact, 0.0), 1)
        assert one.scene.tracker.held == {"plate"}
        ahead = contact.copy()
        ahead[1, 3] += gone
        watch(one, perception, Hand(ahead, 0.0), 12)
        assert (one.state.index < 2) is is_fetched, gone


def test_a_hand_that_is_on_its_way_to_the_plate_has_not_outrun_it():
    approach, contact, corner, end = turning_push().key_poses
    far = replace(contact, T_obj_ee=hand_pose(0.0, -0.2, 0.02))
    memory = entry(INSTRUCTION, (approach, far, corner, end), LAYOUT)
    perception, one = Perception(LAYOUT), controller(memory, instruction=INSTRUCTION)
    observe(one, HAND, perception)
    met = one.executor.targets[1].T_world_ee
    one.executor.begin(one.executor.targets, HAND, 1)
    watch(one, perception, Hand(met, 0.0), 1)
    assert one.scene.tracker.held == {"plate"}
    nearer = met.copy()
    nearer[1, 3] += 1.5 * OUTRUN_M
    watch(one, perception, Hand(nearer, 0.0), 12)
    assert one.state.attempts == 0


def test_where_a_push_turns_the_place_of_meeting_is_not_told_by_its_end():
    outcome = push().outcomes[0]
    straight, turning = push(), replace(turning_push(), outcomes=(outcome,))
    for memory, known in ((straight, True), (turning, False)):
        targets = transfer(memory, LAYOUT, {}, HAND.T_world_ee)
        pushes = [target for target in targets if target.key_pose.phase == "push"]
        assert all((target.push is not None) is known for target in pushes)


def test_what_a_push_leads_to_is_watched_beyond_a_turn():
    approach, contact, _, end = turning_push().key_poses
    corner = replace(end, T_obj_ee=end.T_obj_ee @ se3.from_yaw([0.1, 0.0, 0.0], 0.0))
    memory = entry(INSTRUCTION, (approach, contact, corner, end), LAYOUT)
    perception, one = Perception(LAYOUT), controller(memory, instruction=INSTRUCTION)
    observe(one, HAND, perception)
    here = Hand(one.executor.targets[2].T_world_ee, 0.0)
    shown = one.executor.targets[3].T_world_ee
    one.executor.begin(one.executor.targets, here, 3)
    one.scene.tracker.hold("plate", here.T_world_ee)
    perception.object_poses["stove"] = shifted(LAYOUT["stove"], 0.04)
    del perception.object_poses["plate"]
    watch(one, perception, here, 10)
    assert_allclose(one.executor.targets[3].T_world_ee, shifted(shown, 0.04), atol=2e-3)


def pushing(one, perception, ahead_m):
    """The hand during a push, so far ahead of where it entered the plate."""
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, 1)
    inside = one.executor.targets[1].T_world_ee
    observe(one, Hand(inside, 0.0), perception)
    assert one.executor.target.key_pose.phase == "push"
    way = one.executor.target.T_world_ee[:3, 3] - inside[:3, 3]
    T = inside.copy()
    T[:3, 3] += ahead_m * way / np.linalg.norm(way)
    return Hand(T, 0.0)


@pytest.mark.parametrize("yaw", [0.0, 1.0, 2.5])
def test_the_plate_goes_along_from_where_the_hand_meets_its_rim_however_it_is_turned(yaw):
    now = LAYOUT | {"plate": LAYOUT["plate"] @ turn_about(BESIDE, yaw)}
    perception = Perception(now)
    shown = push(middle=(BESIDE[0], BESIDE[1]))
    one = controller(shown, instruction=INSTRUCTION, symmetries={"plate": Symmetry(BESIDE, 0.0)})
    hand = pushing(one, perception, 0.5 * (LEAD_M - 0.03))
    watch(one, perception, hand, 1)
    assert one.scene.tracker.held == frozenset()
    hand = pushing(one, perception, LEAD_M - 0.03 + 0.001)
    watch(one, perception, hand, 1)
    assert one.scene.tracker.held == {"plate"}


def test_a_plate_that_slides_under_the_hand_is_pushed_on_and_one_left_behind_is_fetched():
    for behind, is_fetched in ((0.4 * LEFT_BEHIND_M, False), (3 * LEFT_BEHIND_M, True)):
        perception, one = Perception(LAYOUT), controller(push(), instruction=INSTRUCTION)
        hand = pushing(one, perception, LEAD_M - 0.03 + 0.1)
        watch(one, perception, hand, 1)
        met = hand.T_world_ee[:3, 3].copy()
        way = se3.apply(LAYOUT["stove"], GOAL[None])[0] - LAYOUT["plate"][:3, 3]
        way /= np.linalg.norm(way)
        perception.object_poses["plate"] = se3.from_yaw([*(met - (LEAD_M + behind) * way)[:2], 0.0], 0.0)
        watch(one, perception, hand, 20)
        assert one.state.status is Status.RUNNING
        assert (one.state.index < 2) is is_fetched, behind


def done(one, perception, end):
    """The push, finished, with the plate where it is told, looked at once."""
    observe(one, HAND, perception)
    last = one.executor.targets[-1]
    perception.object_poses["plate"] = end
    one.scene.tracker.forget(["plate"])
    one.executor.begin(one.executor.targets, HAND, len(one.executor.targets) - 1)
    hand = Hand(last.T_world_ee, 0.0)
    watch(one, perception, hand, 1)
    return hand


def test_a_plate_in_its_place_is_a_success():
    perception, one = Perception(LAYOUT), controller(push(), instruction=INSTRUCTION)
    goal = se3.from_yaw(se3.apply(LAYOUT["stove"], GOAL[None])[0], 0.0)
    done(one, perception, goal)
    assert one.state.status is Status.DONE
    assert one.state.succeeded is True


def test_a_plate_that_stopped_short_is_pushed_on_until_attempts_are_used_up():
    perception, one = Perception(LAYOUT), controller(push(), instruction=INSTRUCTION)
    goal = se3.from_yaw(se3.apply(LAYOUT["stove"], GOAL[None])[0], 0.0)
    hand = done(one, perception, shifted(goal, 0.05))
    for attempt in range(1, MAX_ATTEMPTS + 1):
        assert one.state.status is Status.RUNNING
        assert one.state.attempts == attempt
        assert one.state.index == 0
        inside = one.executor.targets[1].T_world_ee[:3, 3]
        assert_allclose(inside[:2], goal[:2, 3] + [0.05 - 0.03, 0.0], atol=2e-3)
        one.executor.begin(one.executor.targets, HAND, 3)
        hand = Hand(one.executor.targets[-1].T_world_ee, 0.0)
        watch(one, perception, hand, 10)
    assert one.state.status is Status.NO_PROGRESS
    assert one.state.succeeded is False


def test_what_cannot_be_seen_in_the_end_is_done_and_not_known():
    perception, one = Perception(LAYOUT), controller(push(), instruction=INSTRUCTION)
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, 3)
    perception.visible = 0.0
    watch(one, perception, Hand(one.executor.targets[-1].T_world_ee, 0.0), 40)
    assert one.state.status is Status.DONE
    assert one.state.succeeded is None
    assert one.scene.tracker.status("plate") is TrackStatus.HIDDEN
    asked = len(perception.asked)
    watch(one, perception, Hand(one.executor.targets[-1].T_world_ee, 0.0), 40)
    assert len(perception.asked) == asked, "it is not looked for on and on"


def landmark_push():
    """A push whose key poses all belong to the stove, where the plate should end."""

    def of_stove(pose):
        T_world_ee = pose.anchor.frame(LAYOUT) @ pose.T_obj_ee
        return replace(
            pose, anchor=Anchor("stove", "stove"), T_obj_ee=se3.inverse(LAYOUT["stove"]) @ T_world_ee
        )

    return replace(push(), key_poses=tuple(of_stove(pose) for pose in push().key_poses))


def test_what_is_pushed_is_looked_for_although_no_key_pose_belongs_to_it():
    perception, one = Perception(LAYOUT), controller(landmark_push(), instruction=INSTRUCTION)
    observe(one, HAND, perception)
    assert set(perception.asked[0]) == {"plate", "stove"}
    perception.object_poses["plate"] = moved = shifted(LAYOUT["plate"], 0.05)
    watch(one, perception, HAND, 12)
    assert_allclose(one.state.plan.object_poses["plate"], moved, atol=2e-3)
    phases = [pose.phase for pose in landmark_push().key_poses]
    for index, phase in enumerate(phases):
        is_before = phase == "approach"
        assert ("plate" in one.state.plan.objects(index, ())) is is_before, "the hand meets it in the push"


def test_a_push_by_its_landmark_alone_begins_beside_the_plate_wherever_it_stands():
    object_poses = {**LAYOUT, "plate": se3.from_yaw([0.25, -0.15, 0.0], 0.0)}
    for scene in (LAYOUT, object_poses):
        found, expected = (ends(memory, scene) for memory in (landmark_push(), push()))
        assert_allclose(found, expected, atol=1e-9)


def test_a_plate_that_no_key_pose_belongs_to_and_that_is_not_found_does_not_hold_up_its_push():
    perception = Perception({"stove": LAYOUT["stove"]})
    one = controller(landmark_push(), instruction=INSTRUCTION)
    observe(one, HAND, perception)
    assert one.state.status is Status.RUNNING
    perception.object_poses["plate"] = LAYOUT["plate"]
    watch(one, perception, HAND, 6)
    assert "plate" in one.state.plan.object_poses, "it is taken up when it is seen"
