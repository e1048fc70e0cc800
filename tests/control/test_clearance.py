from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import HAND, Perception, controller, observe, planning_context
from tests.control.test_reach import chosen, scene
from tests.memory.builders import entry, hand_pose, pick_and_place

from lerobot_openspm.control.clearance import (
    BESIDE,
    CLEARANCE_M,
    SAG_SHARE,
    Way,
    lifted,
)
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.planning import MIN_SHOWN, MOST_IN_A_SCENE, USUAL_M
from lerobot_openspm.control.state import Status
from lerobot_openspm.control.transfer import Turn, transfer
from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.box.model import BoxModel

HOME = hand_pose(0.0, 0.0, 0.3)
RADIUS = 0.08


def pillar(x, y, height):
    """Points of a post on the table."""
    return np.column_stack([np.full(20, x), np.full(20, y), np.linspace(0, height, 20)])


def sag(length):
    """How far below the middle of a straight way of this length the hand may go, metres."""
    return SAG_SHARE * length


def over(top, start, goal, below=0.0):
    """How high the hand crosses what stands by the middle of a way between two poses ``(4, 4)``, metres."""
    return top + below + CLEARANCE_M + sag(float(np.linalg.norm((goal - start)[:2, 3])))


def heights(*points, start=(0.0, 0.0, 0.1), goal=(0.4, 0.0, 0.1), below=0.0, is_empty=False):
    way = Way(np.array(start), np.array(goal), below, is_empty)
    return way.height_over(np.concatenate(points), RADIUS)


def test_what_stands_beside_the_way_or_below_it_leaves_it_clear():
    assert heights(pillar(0.2, RADIUS + 0.01, 0.5)) is None
    assert heights(pillar(0.2, 0.0, 0.1 - CLEARANCE_M - sag(0.4) - 0.001)) is None
    assert heights(pillar(0.2, 0.0, 0.1 - CLEARANCE_M - sag(0.4) + 0.001)) is not None
    assert heights(pillar(-RADIUS - 0.01, 0.0, 0.5)) is None


def test_what_stands_in_the_way_is_crossed_above_its_top():
    assert_allclose(heights(pillar(0.2, 0.05, 0.25), pillar(0.3, 0.0, 0.1)), 0.25 + CLEARANCE_M + sag(0.4))


@pytest.mark.parametrize("length", [0.1, 0.4, 0.8])
def test_a_long_way_passes_higher_over_its_middle_than_over_its_ends(length):
    goal = (length, 0.0, 0.0)
    middle, end = (
        heights(pillar(x, RADIUS - 1e-9, 0.3), start=(0.0, 0.0, 0.0), goal=goal) for x in (length / 2, length)
    )
    assert_allclose(middle, 0.3 + CLEARANCE_M + sag(length))
    assert end == pytest.approx(0.3 + CLEARANCE_M)


def test_what_hangs_from_the_hand_has_to_clear_it_too():
    low = pillar(0.2, 0.0, 0.02)
    assert heights(low) is None
    assert_allclose(heights(low, below=0.04), 0.02 + 0.04 + CLEARANCE_M + sag(0.4))


def test_a_hand_that_passes_high_enough_where_the_object_stands_need_not_rise():
    # It comes down from 0.4 m to 0.1 m, and is still high above a post near its start.
    assert heights(pillar(0.02, 0.0, 0.2), start=(0, 0, 0.4), goal=(0.4, 0, 0.1)) is None
    assert heights(pillar(0.38, 0.0, 0.2), start=(0, 0, 0.4), goal=(0.4, 0, 0.1)) is not None


def test_what_an_empty_hand_leaves_behind_needs_no_room_but_what_it_would_go_through():
    low, beside = 0.1 - CLEARANCE_M + 0.001, RADIUS / BESIDE + 0.001
    for behind in (pillar(-0.001, 0.0, low), pillar(-0.001, beside, 0.5)):
        assert heights(behind, is_empty=True) is None
        assert heights(behind) is not None
        assert heights(behind + np.array([0.002, 0.0, 0.0]), is_empty=True) is not None
    for there in (pillar(-0.001, 0.0, 0.101), pillar(-0.001, beside - 0.002, 0.101)):
        assert_allclose(heights(there, is_empty=True), 0.101)


@pytest.mark.parametrize("knows_load", [True, False])
def test_a_hand_that_carries_something_needs_room_behind_it_whatever_is_known_of_the_load(knows_load):
    shown = entry()
    poses = {"bowl": se3.from_yaw([-0.2, 0.0, 0.0], 0.0), "plate": se3.from_yaw([0.2, 0.0, 0.0], 0.0)}
    plain = transfer(shown, poses, {}, HOME)
    assert plain[3].key_pose.phase == "lift"
    x, y, z = plain[3].T_world_ee[:3, 3]
    points = {"post": pillar(x - 0.001, y + RADIUS / BESIDE + 0.005, z + 0.1)}
    points |= {"bowl": pillar(-0.2, 0.0, 0.05)} if knows_load else {}
    _, crossed = lifted(shown, plain, HOME, points, RADIUS / BESIDE)
    assert crossed == ["post"]


def carried_over(*posts):
    """Key poses that carry a bowl from the left to the plate on the right, with posts about."""
    shown = entry()
    poses = {"bowl": se3.from_yaw([-0.2, 0.0, 0.0], 0.0), "plate": se3.from_yaw([0.2, 0.0, 0.0], 0.0)}
    points = {f"post {i}": post for i, post in enumerate(posts)} | {"bowl": pillar(-0.2, 0.0, 0.05)}
    plain = transfer(shown, poses, {}, HOME)
    higher, crossed = lifted(shown, plain, HOME, points, RADIUS)
    assert bool(crossed) == (len(higher.key_poses) > len(shown.key_poses))
    return plain, transfer(higher, poses, {}, HOME)


def test_nothing_changes_where_nothing_is_in_the_way():
    plain, targets = carried_over(pillar(0.0, 0.3, 0.4))
    assert len(targets) == len(plain)


def test_a_carried_object_is_lifted_over_a_post_and_then_goes_on_as_shown():
    plain, targets = carried_over(pillar(0.1, 0.0, 0.2))
    assert len(targets) == len(plain) + 2
    rise, across = targets[4], targets[5]
    assert [rise.key_pose.phase, across.key_pose.phase] == ["pre-place", "pre-place"]
    below = 0.03  # the bowl was grasped 3 cm above the table
    for one in (rise, across):
        assert_allclose(one.T_world_ee[2, 3], over(0.2, plain[3].T_world_ee, plain[4].T_world_ee, below))
        assert one.key_pose.closed
        assert not one.precise
    # Straight up from where it was lifted to, straight down to where it was to go.
    assert_allclose(rise.T_world_ee[:2, 3], plain[3].T_world_ee[:2, 3])
    assert_allclose(across.T_world_ee[:2, 3], plain[4].T_world_ee[:2, 3])
    kept = (*targets[:4], *targets[6:])
    assert_allclose([one.T_world_ee for one in kept], [one.T_world_ee for one in plain])


def test_an_empty_hand_comes_down_beyond_a_post_on_its_first_way():
    plain, targets = carried_over(pillar(-0.1, BESIDE * RADIUS - 0.01, 0.25))
    assert targets[0].key_pose.phase == "approach"
    assert_allclose(targets[0].T_world_ee[:2, 3], plain[0].T_world_ee[:2, 3])
    assert_allclose(targets[0].T_world_ee[2, 3], over(0.25, HOME, plain[0].T_world_ee))


@pytest.mark.parametrize("is_half_turned", [False, True])
def test_a_hand_that_begins_too_low_rises_where_it_is_and_crosses_at_one_height(is_half_turned):
    low, post = hand_pose(-0.3, 0.0, 0.1), pillar(0.0, 0.0, 0.25)
    poses = {name: se3.from_yaw([x, 0.0, 0.0], 0.7) for name, x in (("bowl", 0.2), ("plate", 0.4))}
    context = planning_context(points={"post": post}, hand_radius_m=0.05)
    plan = Plan(entry(), poses | {"post": np.eye(4)}, low, is_half_turned=is_half_turned)
    plain = plan.targets(context)
    rise, across, *rest = context.clear(plan).targets(context)
    height = over(0.25, low, plain[0].T_world_ee)
    for one, below in ((rise, low), (across, plain[0].T_world_ee)):
        assert_allclose(one.T_world_ee[:3, 3], [*below[:2, 3], height], atol=1e-9)
        assert_allclose(one.T_world_ee[:3, :3], plain[0].T_world_ee[:3, :3], atol=1e-9)
    assert_allclose([one.T_world_ee for one in rest], [one.T_world_ee for one in plain], atol=1e-9)


PLACES = {"bowl": (-0.2, 0.2), "plate": (0.2, 0.0), "cup": (-0.2, -0.2), "tray": (0.2, 0.3)}


def two_sub_tasks():
    """Key poses that put a bowl on a plate and then a cup on a tray, and where these are."""
    poses = {name: se3.from_yaw([*place, 0.0], 0.0) for name, place in PLACES.items()}
    shown = entry("put the bowl on the plate and put the cup on the tray", object_poses=poses)
    later = (replace(pose, sub_task=1) for pose in pick_and_place("cup", "tray"))
    return replace(shown, key_poses=(*pick_and_place("bowl", "plate"), *later)), poses


def test_the_hand_rises_turned_as_it_grasped_also_where_it_puts_unturned():
    poses = {name: se3.from_yaw([*place, 0.0], 0.0) for name, place in PLACES.items()}
    shown = entry(key_poses=pick_and_place(), object_poses=poses)
    turns = {0: Turn("bowl", poses["bowl"], np.zeros(2), np.deg2rad(120), put="as_shown")}
    plain = transfer(shown, poses, {}, HOME, turns=turns)
    middle = (poses["bowl"][:2, 3] + poses["plate"][:2, 3]) / 2
    higher, crossed = lifted(shown, plain, HOME, {"post": pillar(*middle, 0.4)}, RADIUS)
    assert crossed == ["post"]
    targets = transfer(higher, poses, {}, HOME, turns=turns)
    i = next(i for i, one in enumerate(targets) if one.key_pose.phase == "pre-place")
    lift, rise, across = targets[i - 1 : i + 2]
    assert rise.key_pose.anchor.place == "bowl"
    assert_allclose(rise.T_world_ee[:3, :3], lift.T_world_ee[:3, :3], atol=1e-9)
    assert_allclose(rise.T_world_ee[:2, 3], lift.T_world_ee[:2, 3], atol=1e-9)
    assert se3.distances(rise.T_world_ee, across.T_world_ee)[1] > 1


@pytest.mark.parametrize("sub_task", [0, 1])
def test_the_hand_rises_where_it_leaves_one_sub_task_however_a_grasp_is_turned(sub_task):
    shown, poses = two_sub_tasks()
    turns = {
        sub_task: Turn(
            ("bowl", "cup")[sub_task], poses[("bowl", "cup")[sub_task]], np.zeros(2), np.deg2rad(90)
        )
    }
    plain = transfer(shown, poses, {}, HOME, turns=turns)
    higher, crossed = lifted(shown, plain, HOME, {"post": pillar(0.0, -0.1, 0.4)}, RADIUS)
    assert crossed == ["post"]
    targets = transfer(higher, poses, {}, HOME, turns=turns)
    first = next(i for i, one in enumerate(targets) if one.key_pose.phase == "retreat")
    leaves, rise, across = targets[first : first + 3]
    assert_allclose(rise.T_world_ee[:2, 3], leaves.T_world_ee[:2, 3])
    assert_allclose(rise.T_world_ee[:3, :3], leaves.T_world_ee[:3, :3])
    height = over(0.4, leaves.T_world_ee, across.T_world_ee)
    assert_allclose([rise.T_world_ee[2, 3], across.T_world_ee[2, 3]], height)
    assert rise.key_pose.sub_task == 0
    assert across.key_pose.sub_task == 1


def test_what_was_put_down_stands_there_and_no_longer_where_it_was():
    shown, poses = two_sub_tasks()
    tall = {"bowl": pillar(*PLACES["bowl"], 0.4)}
    for tray, crossed in ((0.3, []), (0.2, ["bowl"])):
        # The cup goes from the left over where the bowl was, or to the right over the plate.
        cup, goal = ((-0.2, 0.0), (-0.2, 0.4)) if not crossed else ((0.2, -0.2), (0.2, tray))
        now = poses | {"cup": se3.from_yaw([*cup, 0.0], 0.0), "tray": se3.from_yaw([*goal, 0.0], 0.0)}
        assert lifted(shown, transfer(shown, now, {}, HOME), HOME, tall, RADIUS)[1] == crossed


def test_a_box_is_in_the_way_of_what_runs_through_the_middle_of_its_side():
    box = BoxModel("crate", np.array([0.4, 0.3, 0.2]), 0.0, np.pi, 0.0, 0.9)
    top = 0.2 + CLEARANCE_M + sag(0.4)
    assert_allclose(heights(se3.apply(se3.from_yaw([0.2, 0.0, 0.0], 0.3), box.points)), top)


def wide(x, height):
    """Points of something 40 cm wide on the table."""
    return np.concatenate([pillar(x + dx, 0.0, height) for dx in np.linspace(-0.2, 0.2, 21)])


def test_a_hand_that_leaves_a_large_object_for_its_other_side_rises_over_it_all():
    shown, poses = two_sub_tasks()
    # The plate, on which the bowl is put, is between the hand and the cup.
    poses |= {"plate": se3.from_yaw([0.5, -0.2, 0.0], 0.0), "cup": se3.from_yaw([-0.1, -0.2, 0.0], 0.0)}
    plain = transfer(shown, poses, {}, HOME)
    small, large = pillar(0.5, -0.2, 0.25), wide(0.35, 0.25) - [0.0, 0.2, 0.0]
    assert lifted(shown, plain, HOME, {"plate": small}, RADIUS)[1] == []
    higher, crossed = lifted(shown, plain, HOME, {"plate": np.concatenate([small, large])}, RADIUS)
    assert crossed == ["plate"]
    phases = [(one.phase, one.anchor.place, one.sub_task) for one in higher.key_poses]
    assert ("retreat", "plate", 0) in phases[phases.index(("retreat", "plate", 0)) + 1 :]


FOOT = {name: np.zeros((1, 3)) for name in ("bowl", "plate")}
AMONG = {
    "bowl": se3.from_yaw([-0.2, 0.0, 0.0], 0.0),
    "plate": se3.from_yaw([0.2, 0.0, 0.0], 0.0),
    "post": se3.from_yaw([0.0, 0.0, 0.0], 0.0),
}


def moved_by(metres, *names):
    """Everything a little aside of its usual place, and some of it by so much more, along the table."""
    aside = {name: 0.01 + metres * (name in names) for name in AMONG}
    return {name: se3.transform(np.eye(3), [0.0, aside[name], 0.0]) @ T for name, T in AMONG.items()}


@pytest.mark.parametrize(
    ("poses", "shown", "rises"),
    [
        (moved_by(0.0), [AMONG] * MIN_SHOWN, False),
        (moved_by(USUAL_M, "bowl"), [AMONG] * MIN_SHOWN, True),
        (moved_by(USUAL_M, "post"), [AMONG] * MIN_SHOWN, True),
        (moved_by(0.0), [AMONG] * (MIN_SHOWN - 1), True),
        (moved_by(0.0), [AMONG] * MIN_SHOWN + [moved_by(USUAL_M, "post")], True),
    ],
    ids=["all is as shown", "bowl elsewhere", "post elsewhere", "rarely shown", "post moved about"],
)
def test_what_stands_as_ever_is_not_in_the_way_that_was_shown(poses, shown, rises):
    entries = [entry(object_poses=one) for one in shown]
    context = planning_context(*entries, points={"post": pillar(0.0, 0.0, 0.2), **FOOT}, hand_radius_m=0.05)
    plan = Plan(entries[0], poses, hand_pose(-0.2, 0.0, 0.3))
    assert (context.clear(plan) is not plan) == rises


@pytest.mark.parametrize(("known", "asked"), [(MOST_IN_A_SCENE, MOST_IN_A_SCENE), (MOST_IN_A_SCENE + 1, 2)])
def test_what_may_stand_in_the_way_is_looked_for_unless_too_much_is_known(known, asked):
    names = ["bowl", "plate", *(f"thing {i}" for i in range(known - 2))]
    look = controller(points={name: pillar(0, 0, 0.1) for name in names}).advance(HAND)
    assert look is not None
    assert set(look.names) == set(names[:asked])


def test_the_hand_of_an_episode_rises_over_what_it_was_not_asked_about():
    # Between the hand and the bowl.
    shown = entry()
    bowl = shown.object_poses["bowl"][:3, 3]
    post = se3.from_yaw([*((HAND.T_world_ee[:3, 3] + bowl) / 2)[:2], 0.0], 0.0)
    sees, points = Perception({**shown.object_poses, "post": post}), {"post": pillar(0, 0, 0.28)}
    for radius, more in ((0.0, 0), (RADIUS, 1)):
        one = controller(shown, points=points, hand_radius_m=radius / BESIDE)
        observe(one, HAND, sees)
        assert one.state.status is Status.RUNNING
        assert one.state.used == ((shown,),)
        assert (len(one.state.plan.entry.key_poses) > len(shown.key_poses)) == bool(more)


def test_a_way_that_cannot_be_lifted_is_gone_straight_and_that_is_said(caplog):
    context, poses, home = scene(None, 0.0)
    high = np.array([[-2.0, -2.0, 0.0], [2.0, 2.0, 1.2]])
    # The post is higher than the hand was ever shown.
    between = (poses["bowl"][:3, 3] + poses["plate"][:3, 3]) / 2
    post = {"post": pillar(0.0, 0.0, 0.6)}
    context = replace(context, robot=replace(context.robot, workspace=high), points=post, hand_radius_m=0.03)
    plan, problems = chosen(context, poses | {"post": se3.from_yaw(between, 0.0)}, home)
    assert problems == []
    assert context.clear(plan) is plan
    (record,) = caplog.records
    assert "the post may be in the way" in record.getMessage()
    assert "outside the demonstrated workspace" in record.getMessage()
