"""Key poses that the arm's joints cannot reach: refused, or met another way."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import planning_context
from tests.geometry.test_arm import LIBERO
from tests.memory.builders import entry, hand_pose, key_pose, robot

from lerobot_openspm.control import feasibility
from lerobot_openspm.control.feasibility import MAX_JUMP_RAD, TransferLimits, find_stance
from lerobot_openspm.control.joint_room import FURTHER_M
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.transfer import RETREAT_M, transfer
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import load_arm
from lerobot_openspm.memory.compose import Candidate
from lerobot_openspm.memory.entry import WORLD, Anchor, Axis
from lerobot_openspm.memory.retrieval import Scored
from lerobot_openspm.types import Symmetry


@pytest.fixture
def panda(request):
    return load_arm(request.config.rootpath / LIBERO)


def scene(panda, yaw, x=-0.1, turn=0.0):
    """A context with a Panda, poses of a bowl and a plate that were turned together, and the hand's."""
    poses = {"bowl": se3.from_yaw([x, 0.1, 0.9], yaw), "plate": se3.from_yaw([-0.05, -0.1, 0.9], yaw)}
    context = planning_context(symmetries={"bowl": Symmetry(np.zeros(2), turn)})
    own = robot(workspace=np.array([[-2.0, -2.0, 0.0], [2.0, 2.0, 2.0]]), arm=panda)
    return replace(context, robot=own), poses, hand_pose(-0.2, 0.0, 1.17)


def chosen(context, poses, home):
    (shown,) = context.entries
    candidate = Candidate(shown, 1.0, (shown,), shown.key.sub_tasks)
    return context.choose(context.rank([candidate], poses, home), poses, home)


# What is round is grasped as it was shown, and put down with the hand as it is.
@pytest.mark.parametrize(("turn", "turned", "put"), [(0.0, 0, "kept"), (np.pi / 2, -90, "turned")])
def test_a_hand_that_the_joints_cannot_turn_so_far_is_turned_about_the_object(panda, turn, turned, put):
    # The last joint may turn by less, so that the hand cannot.
    *joints, last = panda.joints
    stiff = replace(panda, joints=(*joints, replace(last, limits=np.array([-0.5, 1.5]))))
    context, poses, home = scene(stiff, np.deg2rad(90), turn=turn)
    plan = Plan(context.entries[0], poses, home)
    assert not plan.followed(context)[1]
    _, (problem,) = replace(plan, stance=find_stance(context.robot, home)).followed(context)
    assert "beyond what the arm's joints reach" in problem
    plan, problems = chosen(context, poses, home)
    assert (round(np.rad2deg(plan.turned)), plan.put) == (turned, put)
    assert problems == plan.followed(context)[1] == []


def test_where_the_joints_do_not_reach_an_entry_the_next_one_is_taken(panda):
    *joints, last = panda.joints
    # Neither as it was shown nor the other way round.
    stiff = replace(panda, joints=(*joints, replace(last, limits=np.array([0.3, 1.3]))))
    context, poses, home = scene(stiff, np.deg2rad(90))
    context, (shown,) = replace(context, symmetries={}), context.entries
    quarter = se3.from_yaw(np.zeros(3), np.pi / 2)
    others = [
        replace(
            shown,
            key_poses=tuple(replace(pose, T_obj_ee=pose.T_obj_ee @ turn) for pose in shown.key_poses),
            source=source,
        )
        for turn, source in ((quarter, "a quarter"), (se3.inverse(quarter), "a quarter back"))
    ]
    ranked = [Scored(one, 1.0, 1.0, 1.0, 1.0) for one in (shown, *others)]
    assert "beyond what the arm's joints reach" in context.choose(ranked[:1], poses, home)[1][0]
    plan, problems = context.choose(ranked, poses, home)
    assert (plan.entry in others, problems) == (True, [])


@pytest.mark.parametrize(
    ("turn", "expected"), [(np.pi, [180]), (np.pi / 2, [90, -90, 180]), (2.0, []), (None, [])]
)
def test_grasps_are_turned_by_what_the_shape_allows(panda, turn, expected):
    context, poses, home = scene(panda, 0.0, turn=turn)
    if turn is None:
        context = replace(context, symmetries={})
    ways = Plan(context.entries[0], poses, home).turns(context)
    told = [(round(np.rad2deg(way.turned)), way.put) for way in ways]
    others = [(degrees, put) for degrees in expected for put in ("turned", "as_shown")]
    assert told == [(0, "turned"), *others]


def test_what_is_found_half_turned_is_grasped_as_it_was_shown_and_put_as_it_was_shown():
    # It looks the same so, and the hand that puts it there keeps its direction in the world.
    context, poses, home = scene(None, 0.0, turn=np.pi)
    (shown,) = context.entries
    taken, put = shown.key_poses[:4], shown.key_poses[4:]
    put = tuple(replace(pose, anchor=Anchor("plate", WORLD)) for pose in put)
    context = replace(context, entries=(replace(shown, key_poses=taken + put),))
    straight, problems = chosen(context, poses, home)
    assert (straight.turned, problems) == (0, [])
    flipped = poses | {"bowl": poses["bowl"] @ se3.from_yaw(np.zeros(3), np.pi)}
    plan, problems = chosen(context, flipped, home)
    assert (plan.turned, plan.put, problems) == (pytest.approx(np.pi), "as_shown", [])
    for own, before in zip(plan.targets(context), straight.targets(context), strict=True):
        assert_allclose(own.T_world_ee, before.T_world_ee, atol=1e-9)


@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_a_handle_is_on_one_side_only_whatever_its_object_turns_into(turn):
    shown, poses = drawer(-0.05)
    context, _, home = scene(None, 0.0)
    context = replace(context, entries=(shown,), symmetries={"cabinet": Symmetry(np.zeros(2), turn)})
    assert Plan(shown, poses, home).turns(context) == [Plan(shown, poses, home)]
    turned = {"cabinet": poses["cabinet"] @ se3.from_yaw(np.zeros(3), 0.4)}
    (handle, *_) = Plan(shown, turned, home).targets(context)
    assert_allclose(handle.T_world_ee, turned["cabinet"] @ shown.key_poses[0].T_obj_ee, atol=1e-9)


def middle_at(targets, index, bowl):
    """Where the hand has the bowl's axis ``(1, 3)`` at a key pose."""
    grasp = next(one for one in targets if one.key_pose.phase == "grasp")
    return se3.apply(targets[index].T_world_ee @ se3.inverse(grasp.T_world_ee) @ bowl, np.zeros((1, 3)))


def test_what_is_round_is_put_with_the_hand_as_it_is_where_it_would_turn_too_far():
    # The plate lies turned by nearly half a turn from how it lay, seen from the bowl.
    context, poses, home = scene(None, 0.0)
    poses["plate"] = poses["plate"] @ se3.from_yaw(np.zeros(3), 3.0)
    plan, problems = chosen(context, poses, home)
    assert problems == []
    assert (plan.turned, plan.put) == (0, "kept")
    own, turned = plan.targets(context), Plan(plan.entry, poses, home).targets(context)
    (grasp, place), (turned_grasp, turned_place) = ((one[2], one[5]) for one in (own, turned))
    assert se3.distances(grasp.T_world_ee, place.T_world_ee)[1] < MAX_JUMP_RAD
    assert se3.distances(turned_grasp.T_world_ee, turned_place.T_world_ee)[1] > MAX_JUMP_RAD
    assert_allclose(*(middle_at(one, 5, poses["bowl"]) for one in (own, turned)), atol=1e-9)


@pytest.mark.parametrize("grasp", [0.0, 0.5])
@pytest.mark.parametrize(
    ("put", "turns_with"), [("turned", (True, True)), ("as_shown", (False, True)), ("kept", (True, False))]
)
def test_what_is_round_is_put_with_the_hand_turned_in_three_ways(grasp, put, turns_with):
    context, poses, home = scene(None, 0.0)
    plan = Plan(context.entries[0], poses, home)
    poses["plate"] = plan.entry.object_poses["plate"] @ se3.from_yaw(np.zeros(3), 2.0)
    way = replace(plan, turned=grasp, put=put)
    own, shown = way.targets(context), transfer(plan.entry, plan.entry.object_poses, {}, home)
    for i, turn in ((2, grasp), (5, np.dot(turns_with, (grasp, 2.0)))):
        R = own[i].T_world_ee[:3, :3] @ shown[i].T_world_ee[:3, :3].T
        assert_allclose(R, se3.from_yaw(np.zeros(3), turn)[:3, :3], atol=1e-9)
    assert_allclose(*(middle_at(one, 5, poses["bowl"]) for one in (own, plan.targets(context))), atol=1e-9)


def test_a_grasp_within_reach_stays_as_shown(panda):
    assert chosen(*scene(panda, 0.0))[0].turned == 0


@pytest.mark.parametrize(
    ("x", "turned", "stretched"), [(0.08, 0, False), (0.11, 90, False), (0.14, 120, True)]
)
def test_a_grasp_that_stretches_the_arm_out_is_turned_while_another_one_does_not(panda, x, turned, stretched):
    context, poses, home = scene(panda, 0.0, x=x)
    as_shown = replace(Plan(context.entries[0], poses, home), stance=find_stance(context.robot, home))
    assert (as_shown.reach_left(context) < FURTHER_M[0]) == (x > 0.1)
    plan, problems = chosen(context, poses, home)
    assert problems == plan.followed(context)[1] == []
    assert round(np.rad2deg(plan.turned)) == turned
    assert (plan.reach_left(context) < FURTHER_M[0]) == stretched
    assert plan.reach_left(context) >= as_shown.reach_left(context)


def test_an_arm_that_is_stretched_on_its_way_to_a_grasp_is_stretched(panda):
    context, poses, home = scene(panda, 0.0, x=0.04)
    plan = replace(Plan(context.entries[0], poses, home), stance=find_stance(context.robot, home))
    assert plan.reach_left(context) == FURTHER_M[0]
    further = se3.from_yaw([0.06, 0.0, 0.0], 0.0)
    poses_out = [
        replace(one, T_obj_ee=further @ one.T_obj_ee) if i == 1 else one
        for i, one in enumerate(plan.entry.key_poses)
    ]
    assert poses_out[1].phase == "approach"
    out = replace(plan, entry=replace(plan.entry, key_poses=tuple(poses_out)))
    assert 0 <= out.reach_left(context) < FURTHER_M[0]


def test_what_is_out_of_reach_from_all_sides_is_refused(panda):
    context, poses, home = scene(panda, 0.0, x=0.9)
    assert chosen(context, poses, home)[1]


def test_where_the_joints_are_known_they_tell_the_reach_and_not_where_the_demonstrations_went(panda):
    context, poses, home = scene(panda, 0.0)
    small = replace(context.robot, workspace=np.array([[-0.1, -0.1, 0.0], [0.0, 0.0, 2.0]]))
    poses["plate"] = se3.from_yaw([-0.05, -0.25, 0.9], 0.0)
    assert chosen(replace(context, robot=small), poses, home)[1] == []
    _, problems = chosen(replace(context, robot=replace(small, arm=None)), poses, home)
    assert "outside the demonstrated workspace" in problems[0]


def test_an_arm_that_does_not_fit_the_scene_is_named_once_and_refuses_nothing(panda, caplog):
    # LIBERO's other suites have the robot on the floor.
    first, *others = panda.joints
    lower = replace(first, T_before_joint=se3.transform(np.eye(3), [0, 0, -0.912]) @ first.T_before_joint)
    context, poses, home = scene(replace(panda, joints=(lower, *others)), 0.0)
    for _ in range(2):
        assert chosen(context, poses, home)[1] == []
    (record,) = caplog.records
    assert record.getMessage().startswith("the arm does not fit: its joints miss even where the hand is now")
    assert "--policy.arm=FILE" in record.getMessage()


def test_a_key_pose_that_no_turn_moves_ends_the_search(panda, monkeypatch):
    context, poses, home = scene(panda, 0.0)
    shown = context.entries[0]
    # The second sub-task grasps nothing that turns into itself, and is out of reach.
    poses |= {"cup": se3.from_yaw([0.9, 0.0, 0.9], 0.0)}
    reach = replace(shown.key_poses[0], sub_task=1, anchor=Anchor("cup", "cup"))
    far = replace(shown, key_poses=(*shown.key_poses, reach), object_poses=poses)
    asked = []
    monkeypatch.setattr(type(panda), "misses", counted(type(panda).misses, asked))
    context = replace(context, limits=TransferLimits(), entries=(far,))
    monkeypatch.setattr(feasibility, "MAX_JUMP_M", 2.0)
    plan, (problem,) = chosen(context, poses, home)
    assert plan.entry is far
    assert "at cup" in problem
    assert len(asked) == 3  # either way round, and to say what is wrong


def counted(function, calls):
    def call(*args):
        calls.append(args)
        return function(*args)

    return call


def drawer(x):
    """A drawer of LIBERO that is pulled towards where the arm is stretched, x metres from the table's middle.

    The demonstration ends with the drawer open; backing off is of our own.
    """
    hand = se3.transform(se3.exp_so3([1.57, -0.035, -0.035]), np.zeros(3))
    poses = [
        key_pose("cabinet", se3.transform(np.eye(3), p) @ hand, phase, phase != "approach", axis=axis)
        for p, phase, axis in (
            ([0.018, 0.035, -0.002], "approach", None),
            ([0.003, 0.0, 0.002], "approach", None),
            ([0.0, 0.0, 0.0], "grasp", None),
            ([0.003, 0.154, 0.0], "open", Axis("slide", np.array([0.0, 1.0, 0.0]), 0.154)),
        )
    ]
    poses_now = {"cabinet": se3.from_yaw([x, -0.133, 1.014], 0.0)}
    return entry("open the top drawer of the cabinet", poses, poses_now), poses_now


@pytest.mark.parametrize(("x", "backs_off"), [(-0.05, RETREAT_M), (0.04, RETREAT_M / 2), (0.07, 0.0)])
def test_the_hand_backs_off_as_far_as_the_arm_reaches(panda, x, backs_off):
    shown, poses = drawer(x)
    context, _, _ = scene(panda, 0.0)
    context = replace(context, entries=(shown,))
    plan, problems = chosen(context, poses, hand_pose(-0.22, -0.01, 1.177))
    assert problems == plan.followed(context)[1] == []
    opened, *left = plan.targets(context)[3:]
    nearer = replace(plan, object_poses={"cabinet": se3.from_yaw([-0.05, -0.133, 1.014], 0.0)})
    assert nearer.followed(context)[0].retreat_m == RETREAT_M
    gone = [se3.distances(opened.T_world_ee, one.T_world_ee)[0] for one in left]
    assert_allclose(gone, [backs_off] if backs_off else [], atol=1e-9)


def test_a_drawer_that_cannot_be_opened_all_the_way_is_refused(panda):
    shown, poses = drawer(0.08)
    context, _, _ = scene(panda, 0.0)
    _, (problem,) = chosen(replace(context, entries=(shown,)), poses, hand_pose(-0.22, -0.01, 1.177))
    assert "(open at cabinet)" in problem
