from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from tests.geometry.strategies import transforms
from tests.memory.builders import entry, hand_pose, key_pose, robot

from lerobot_openspm.control import feasibility
from lerobot_openspm.control.between_parts import rise
from lerobot_openspm.control.feasibility import (
    TransferLimits,
    check_transfer,
    geometric_score,
    shape_deviation,
)
from lerobot_openspm.control.transfer import (
    RETREAT_M,
    Target,
    Turn,
    as_shown,
    transfer,
    transfer_pose,
    turn_about,
)
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import WORLD
from lerobot_openspm.types import Symmetry

HOME = hand_pose(0.0, 0.0, 0.3)


@given(transforms(), transforms(), transforms())
def test_the_papers_theorem_holds_for_any_rigid_motion(G, T_world_obj, T_world_ee):
    T_obj_ee = se3.inverse(T_world_obj) @ T_world_ee
    moved_obj = G @ T_world_obj
    moved_ee = transfer_pose(moved_obj, T_obj_ee)
    assert_allclose(se3.inverse(moved_obj) @ moved_ee, se3.inverse(T_world_obj) @ T_world_ee, atol=1e-9)
    assert_allclose(moved_ee, G @ T_world_ee, atol=1e-9)


def test_transfer_by_hand():
    # The object stands at (1, 0, 0), turned by 90 degrees: its x is the world's y.
    T = transfer_pose(se3.from_yaw([1.0, 0, 0], np.pi / 2), se3.from_yaw([0.2, 0.1, 0.3], 0.0))
    assert_allclose(T[:3, 3], [0.9, 0.2, 0.3], atol=1e-12)
    assert_allclose(se3.yaw_of(T), np.pi / 2)


def test_transfer_is_batched():
    T = se3.from_yaw(np.zeros((4, 3)), np.arange(4.0))
    assert_allclose(transfer_pose(T, T[1])[2], T[2] @ T[1])


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3, 3))
def test_moving_all_objects_moves_all_targets_alike(x, y, yaw):
    G = se3.from_yaw([x, y, 0.0], yaw)
    memory = entry()
    before = transfer(memory, memory.object_poses, {}, HOME)
    after = transfer(memory, {name: G @ T for name, T in memory.object_poses.items()}, {}, HOME)
    assert len(after) == len(memory.key_poses)
    for old, new in zip(before, after, strict=True):
        assert_allclose(new.T_world_ee, G @ old.T_world_ee, atol=1e-9)


def test_moving_one_object_moves_its_own_targets_alone():
    memory, G = entry(), se3.from_yaw([0.1, -0.2, 0.0], 0.7)
    object_poses = memory.object_poses | {"plate": G @ memory.object_poses["plate"]}
    before, after = transfer(memory, memory.object_poses, {}, HOME), transfer(memory, object_poses, {}, HOME)
    for old, new in zip(before, after, strict=True):
        moved = G if new.key_pose.anchor.place == "plate" else np.eye(4)
        assert_allclose(new.T_world_ee, moved @ old.T_world_ee, atol=1e-9)


@given(st.floats(-3, 3), st.floats(-0.02, 0.02), st.floats(-1, 1))
def test_a_turned_grasp_takes_a_round_object_from_another_side_and_puts_it_to_the_same_place(turn, x, y):
    memory, middle = entry(), np.array([x, 0.01])
    poses = memory.object_poses | {"bowl": se3.from_yaw([0.1, y, 0.0], 0.4)}
    turned = {0: Turn("bowl", poses["bowl"], middle, turn)}
    before, after = (transfer(memory, poses, {}, HOME, turns=turns) for turns in (None, turned))
    axis = se3.apply(poses["bowl"], np.array([[*middle, 0.0]]))[0]
    grasp = next(i for i, one in enumerate(before) if one.key_pose.phase == "grasp")
    about = se3.from_yaw(axis, turn) @ se3.from_yaw(-axis, 0.0)
    assert_allclose(after[grasp].T_world_ee, about @ before[grasp].T_world_ee, atol=1e-9)
    # The hand carries the axis with it, so it stands where it would have stood.
    for old, new in list(zip(before, after, strict=True))[grasp:-1]:
        carried = [
            one.T_world_ee @ se3.inverse(poses_at[grasp].T_world_ee) @ poses["bowl"]
            for one, poses_at in ((old, before), (new, after))
        ]
        at = [se3.apply(T, np.array([[*middle, 0.0]]))[0] for T in carried]
        assert_allclose(at[1], at[0], atol=1e-9)


def test_the_hand_leaves_what_it_did_before_as_shown_however_a_grasp_is_turned():
    memory = entry()
    leaves = key_pose("plate", hand_pose(0.0, 0.0, 0.3), "approach")
    memory = replace(memory, key_poses=(leaves, *memory.key_poses))
    turns = {0: Turn("bowl", memory.object_poses["bowl"], np.zeros(2), 1.0)}
    shown, turned = (transfer(memory, memory.object_poses, {}, HOME, turns=one) for one in (None, turns))
    assert_allclose(turned[0].T_world_ee, shown[0].T_world_ee)
    assert se3.distances(turned[1].T_world_ee, shown[1].T_world_ee)[1] == pytest.approx(1.0)


def test_an_anchor_with_the_worlds_axes_follows_the_place_and_not_the_turn():
    pose = key_pose("rack", hand_pose(0.1, 0.0, 0.2), "place", axes=WORLD)
    object_poses = {"rack": se3.from_yaw([0.3, 0.4, 0.0], 1.2)}
    target = transfer(entry(key_poses=[pose], object_poses=object_poses), object_poses, {}, HOME)[0]
    assert_allclose(target.T_world_ee, hand_pose(0.4, 0.4, 0.2), atol=1e-12)


def test_an_anchor_with_anothers_axes_follows_the_place_of_one_and_the_turn_of_the_other():
    pose = key_pose("plate", hand_pose(0.1, 0.0, 0.2), "place", axes="bowl")
    object_poses = {
        "plate": se3.from_yaw([0.3, 0.4, 0.0], 1.2),
        "bowl": se3.from_yaw([9.0, 9.0, 0.0], np.pi / 2),
    }
    target = transfer(entry(key_poses=[pose], object_poses=object_poses), object_poses, {}, HOME)[0]
    assert_allclose(target.T_world_ee, hand_pose(0.3, 0.5, 0.2, np.pi / 2), atol=1e-12)


@pytest.mark.parametrize(
    ("hand_yaw", "turned"), [(0.0, 0.2), (0.4, 0.2), (np.pi, 0.2 - np.pi), (-2.5, 0.2 - np.pi)]
)
def test_a_symmetric_object_is_met_from_the_side_that_turns_the_hand_least(hand_yaw, turned):
    pose = key_pose("box", hand_pose(0.05, 0.0, 0.1), "grasp", closed=True)
    object_poses = {"box": se3.from_yaw([0.2, 0.1, 0.0], 0.2)}
    memory = entry(key_poses=[pose], object_poses=object_poses)
    (target,) = transfer(memory, object_poses, {"box": np.pi}, hand_pose(0, 0, 0.3, hand_yaw))
    expected = se3.from_yaw([0.2, 0.1, 0.0], turned) @ pose.T_obj_ee
    assert_allclose(target.T_world_ee, expected, atol=1e-9)
    (fixed,) = transfer(memory, object_poses, {"box": 2 * np.pi}, hand_pose(0, 0, 0.3, hand_yaw))
    assert_allclose(fixed.T_world_ee, object_poses["box"] @ pose.T_obj_ee, atol=1e-12)


def test_one_choice_of_side_holds_for_all_key_poses_of_an_object():
    memory = entry()
    targets = transfer(memory, memory.object_poses, {"bowl": np.pi}, hand_pose(0, 0, 0.3, np.pi + 0.3))
    at_bowl = [t for t in targets if t.key_pose.anchor.place == "bowl"]
    turned = memory.object_poses["bowl"] @ se3.from_yaw(np.zeros(3), np.pi)
    for target in at_bowl:
        assert_allclose(target.T_world_ee, turned @ target.key_pose.T_obj_ee, atol=1e-9)


def test_contacts_and_the_arrivals_before_them_are_precise():
    targets = transfer(entry(), entry().object_poses, {}, HOME)
    assert [(t.key_pose.phase, t.precise) for t in targets] == [
        ("approach", False), ("approach", True), ("grasp", True), ("lift", False), ("pre-place", False),
        ("place", True), ("release", True), ("retreat", False),
    ]  # fmt: skip


def problems(*poses, hand=HOME):
    object_poses = {"bowl": np.eye(4)}
    key_poses = [key_pose("bowl", T, phase) for phase, T in poses]
    targets = transfer(entry(key_poses=key_poses, object_poses=object_poses), object_poses, {}, hand)
    return check_transfer(targets, hand, robot(), TransferLimits())


def test_key_poses_within_bounds_pass():
    assert problems(("approach", hand_pose(0, 0, 0.2)), ("grasp", hand_pose(0, 0, 0.0))) == []
    assert problems(("approach", hand_pose(0.55, 0.0, 0.2))) == []  # within the margin
    assert problems(("grasp", hand_pose(0, 0, -0.009))) == []


@pytest.mark.parametrize(
    ("T", "word"),
    [
        (hand_pose(0.62, 0, 0.2), "0.120 m outside the demonstrated workspace"),
        (hand_pose(0, -0.62, 0.2), "0.120 m outside the demonstrated workspace"),
        (hand_pose(0, 0, 0.62), "0.120 m outside the demonstrated workspace"),
        (hand_pose(0, 0, -0.02), "0.020 m below the lowest demonstrated hand position"),
        (hand_pose(0, 0, 0.2, 3.0), "0.10 m and 3.00 rad from the one before"),
    ],
)
def test_each_check_names_the_key_pose_and_what_is_wrong(T, word):
    (problem,) = problems(("approach", hand_pose(0, 0, 0.3)), ("grasp", T))
    assert problem.startswith("key pose 1 (grasp at bowl)")
    assert word in problem


def test_a_jump_is_measured_from_the_key_pose_before_and_first_from_the_hand(monkeypatch):
    monkeypatch.setattr(feasibility, "MAX_JUMP_M", 0.25)
    far = problems(("approach", hand_pose(0, 0, 0.2)), ("grasp", hand_pose(0.3, 0, 0.2)))
    assert far == ["key pose 1 (grasp at bowl) is 0.30 m and 0.00 rad from the one before"]
    first = problems(("approach", hand_pose(0.3, 0, 0.3)), ("grasp", hand_pose(0.3, 0, 0.2)))
    assert first == ["key pose 0 (approach at bowl) is 0.30 m and 0.00 rad from the one before"]


def test_every_problem_is_listed():
    found = problems(("approach", hand_pose(0.9, 0, 0.2)), ("grasp", hand_pose(-0.1, 0, -0.1)))
    assert len(found) == 4  # outside, jump; below, jump


def test_a_scene_like_the_demonstrations_or_moved_as_a_whole_has_no_shape_deviation():
    memory, G = entry(), se3.from_yaw([0.1, 0.2, 0.0], 1.0)
    for object_poses in (memory.object_poses, {name: G @ T for name, T in memory.object_poses.items()}):
        assert shape_deviation(memory, transfer(memory, object_poses, {}, HOME)) == pytest.approx(0, abs=1e-6)


def test_another_way_through_free_space_counts_less_than_another_way_in_contact():
    def deviation(phase):
        poses = [
            key_pose("bowl", hand_pose(0, 0, 0.1), "approach"),
            key_pose("plate", hand_pose(0, 0, 0.1), phase),
        ]
        object_poses = {"bowl": np.eye(4), "plate": se3.from_yaw([0.2, 0, 0], 0.0)}
        memory = entry(key_poses=poses, object_poses=object_poses)
        longer = object_poses | {"plate": se3.from_yaw([0.3, 0, 0], 0.0)}
        return shape_deviation(memory, transfer(memory, longer, {}, HOME))

    assert deviation("push") == pytest.approx(0.1)
    assert 0 < deviation("pre-place") < 0.05


def test_a_cut_demonstration_ends_with_a_retreat_against_its_arrival():
    whole = entry()
    cut = entry(key_poses=whole.key_poses[:-1])
    targets = transfer(cut, cut.object_poses, {}, HOME)
    assert [target.key_pose.phase for target in targets[-2:]] == ["release", "retreat"]
    released, left = targets[-2].T_world_ee, targets[-1].T_world_ee
    # It came down from above, so it leaves upwards, turned as it was.
    assert_allclose(left[:3, 3] - released[:3, 3], [0, 0, RETREAT_M], atol=1e-9)
    assert_allclose(left[:3, :3], released[:3, :3], atol=1e-9)
    assert len(transfer(whole, whole.object_poses, {}, HOME)) == len(whole.key_poses)


def test_a_demonstration_cut_with_the_object_in_the_hand_ends_with_letting_go():
    memory = entry(key_poses=entry().key_poses[:6])
    assert memory.key_poses[-1].phase == "place"
    targets = transfer(memory, memory.object_poses, {}, HOME)
    assert [target.key_pose.phase for target in targets[-3:]] == ["place", "release", "retreat"]
    release, retreat = targets[-2:]
    assert_allclose(release.T_world_ee, targets[5].T_world_ee)
    assert release.key_pose.dwell
    assert not release.key_pose.closed
    assert not retreat.key_pose.closed
    assert release.key_pose.n_steps == targets[2].key_pose.n_steps  # as long as the fingers took to close


def test_what_is_not_to_be_put_anywhere_is_not_let_go():
    poses = [*entry().key_poses[:3], key_pose("bowl", hand_pose(0, 0, 0.3), "place", closed=True)]
    memory = entry("open the top drawer of the bowl", key_poses=poses)
    targets = transfer(memory, memory.object_poses, {}, HOME)
    assert "release" not in [target.key_pose.phase for target in targets]


def score(object_poses, memory=None):
    return geometric_score(memory or entry(), object_poses, {}, HOME, robot(), TransferLimits())


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.3, 0.3))
def test_a_scene_arranged_like_the_entrys_own_scores_one_wherever_it_is(x, y, yaw):
    G = se3.from_yaw([x, y, 0.0], yaw)
    assert score({name: G @ T for name, T in entry().object_poses.items()}) == pytest.approx(1)


def test_an_object_that_is_missing_or_out_of_reach_scores_nothing(monkeypatch):
    object_poses = entry().object_poses
    assert score({"bowl": object_poses["bowl"]}) == 0
    assert score(object_poses | {"plate": se3.from_yaw([3.0, 0, 0], 0.0)}) == 0
    monkeypatch.setattr(feasibility, "MAX_JUMP_M", 0.05)
    assert score(object_poses) == 0


def test_the_less_like_the_entrys_own_arrangement_the_less_it_scores():
    object_poses = entry().object_poses
    shifts = [0.0, 0.05, 0.15, 0.3]
    scores = [
        score(object_poses | {"plate": se3.from_yaw([-d, 0, 0], 0.0) @ object_poses["plate"]}) for d in shifts
    ]
    assert scores == sorted(scores, reverse=True)
    assert len(set(scores)) == 4
    turned = score(object_poses | {"plate": object_poses["plate"] @ se3.from_yaw(np.zeros(3), 0.5)})
    assert 0 < turned < 1


def test_objects_that_no_key_pose_is_relative_to_make_no_difference():
    object_poses = entry().object_poses
    assert score(object_poses | {"mug": se3.from_yaw([0.3, 0.3, 0], 1.0)}) == score(object_poses)


def test_what_can_be_done_at_all_scores_something(monkeypatch):
    # A drawer that opens another way round from where the hand comes from: far from alike, yet possible.
    pull = key_pose("cabinet", hand_pose(0.3, 0.0, 0.1), "open", closed=True)
    take = key_pose("handle", hand_pose(0.0, 0.0, 0.1), "grasp", closed=True)
    memory = entry(key_poses=[take, pull], object_poses={"cabinet": np.eye(4), "handle": np.eye(4)})
    here = {"cabinet": np.eye(4), "handle": se3.from_yaw([-0.4, 0.0, 0.0], 2.0)}
    monkeypatch.setattr(feasibility, "MAX_JUMP_M", 9)
    monkeypatch.setattr(feasibility, "MAX_JUMP_RAD", 9)
    assert 0 < score(here, memory) < 0.01


def test_a_round_thing_is_grasped_and_put_as_it_was_shown_however_it_is_turned():
    memory = entry()
    turned = {
        **memory.object_poses,
        "bowl": memory.object_poses["bowl"] @ turn_about(np.array([0.02, 0.01]), 2.5),
    }
    for turn, stays in ((0.0, True), (np.pi, False)):
        poses = as_shown(memory, turned, {"bowl": Symmetry(np.array([0.02, 0.01]), turn)})
        own = transfer(memory, poses, {}, HOME)
        shown = transfer(memory, memory.object_poses, {}, HOME)
        same = [np.allclose(a.T_world_ee, b.T_world_ee) for a, b in zip(own, shown, strict=True)]
        assert all(same) == stays
    # What is only put something on is turned as it is.
    poses = as_shown(memory, turned, {"plate": Symmetry(np.zeros(2), 0.0)})
    assert poses["plate"] is turned["plate"]


@pytest.mark.parametrize(
    ("turned", "height", "ends_at"),
    [
        (0.3, 0.5, [0.1, 0.2, 0.5]),  # straight up
        (0.3, 0.21, None),  # as high already
        (1.2, 0.5, [-0.3, 0.0, 0.5]),  # turned otherwise: back to where the episode began
        (1.2, 0.21, [-0.3, 0.0, 0.21]),
    ],
)
def test_a_part_ends_as_high_and_turned_as_the_episode_began(turned, height, ends_at):
    last = Target(hand_pose(0.1, 0.2, 0.2), entry().key_poses[-1], precise=False)
    T_start = hand_pose(-0.3, 0.0, height, turned)
    ends = rise(last, T_start)
    if ends_at is None:
        assert ends == ()
        return
    assert np.allclose(ends[0].T_world_ee[:3, 3], ends_at)
    R_end = (T_start if turned > 1 else last.T_world_ee)[:3, :3]
    assert np.allclose(ends[0].T_world_ee[:3, :3], R_end)
    # Back about there will do; straight up goes all the way.
    assert (ends[0].passing_m > last.passing_m) == (turned > 1)
