"""What would be in the hand, or in the way of its load, where it takes hold and lets go."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import planning_context
from tests.control.test_clearance import HOME, RADIUS, pillar, two_sub_tasks
from tests.control.test_going_back import KINDS, ON_PLATE, handle
from tests.control.test_reach import chosen, scene
from tests.memory.builders import entry

from lerobot_openspm.control.clearance import crowding, taken
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.planning import FEW_POINTS
from lerobot_openspm.control.transfer import transfer
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.compose import Candidate
from lerobot_openspm.memory.retrieval import Scored
from lerobot_openspm.types import Symmetry


def at_key_pose(context, poses, home, phase, along):
    """Key poses, and the pose of a post beside the hand at one, ``along`` (x, y) in its frame, metres."""
    targets = Plan(context.entries[0], poses, home).targets(context)
    T = next(one.T_world_ee for one in targets if one.key_pose.phase == phase)
    place = se3.apply(T, np.array([[*along, 0.0]]))[0]
    return targets, se3.from_yaw([*place[:2], T[2, 3] - 0.1], 0.0)


SPARSE = pillar(0.0, 0.0, 0.25)
POST = np.tile(SPARSE, (2, 1))


@pytest.mark.parametrize("phase", ["grasp", "release"])
@pytest.mark.parametrize(
    ("along", "is_crowded"),
    [((0.0, 0.1), True), ((0.0, -0.1), True), ((0.05, 0.0), False), ((0.0, 0.12), False)],
)
def test_a_hand_is_wide_along_the_axis_over_which_its_fingers_open(phase, along, is_crowded):
    context, poses, home = scene(None, 0.3)
    (shown,) = context.entries
    targets, place = at_key_pose(context, poses, home, phase, along)
    post = se3.apply(place, POST)
    assert bool(crowding(shown, targets, {"post": post}, RADIUS)) == is_crowded
    # What it takes hold of, and what its key poses belong to, it is to be at.
    assert not crowding(shown, targets, {"bowl" if phase == "grasp" else "plate": post}, RADIUS)
    assert not crowding(
        shown, [one for one in targets if one.key_pose.phase == "approach"], {"post": post}, RADIUS
    )
    # The same thing by another name.
    bowl = se3.apply(poses["bowl"], POST)
    assert not crowding(shown, targets, {"bowl": bowl, "black bowl": bowl}, RADIUS)


def test_what_was_put_down_crowds_the_hand_where_it_was_put():
    shown, poses = two_sub_tasks()
    bowl = {"bowl": se3.apply(poses["bowl"], POST)}
    targets = transfer(shown, poses, {}, HOME)
    grasps = [one.T_world_ee for one in targets if one.key_pose.phase == "grasp"]
    let_go = next(one.T_world_ee for one in targets if one.key_pose.phase == "release")
    for beside, is_crowded in ((grasps[0], False), (let_go, True)):
        # The cup is taken right beside where the bowl was, or where it was put.
        x, y = (beside[:3, 3] - grasps[1][:3, 3] + 0.09 * grasps[1][:3, 1])[:2]
        now = poses | {"cup": se3.from_yaw([x, y, 0.0], 0.0) @ poses["cup"]}
        found = crowding(shown, transfer(shown, now, {}, HOME), bowl, RADIUS)
        assert bool(found) == is_crowded


def test_a_grasp_beside_another_object_is_turned_about_a_round_object(caplog):
    context, poses, home = scene(None, 0.0)
    _, place = at_key_pose(context, poses, home, "grasp", (0.0, 0.09))
    context, poses = replace(context, points={"post": POST}, hand_radius_m=RADIUS), poses | {"post": place}
    plan, problems = chosen(context, poses, home)
    assert problems == []
    assert plan.turned != 0
    assert not crowding(plan.entry, plan.targets(context), {"post": se3.apply(place, POST)}, RADIUS)
    assert not caplog.records
    # Without a symmetry there is no other grasp.
    plan, problems = chosen(replace(context, symmetries={}), poses, home)
    assert (plan.turned, problems) == (0, [])
    (record,) = caplog.records
    assert "hand or load may touch the post where it takes hold or lets go" in record.getMessage()


@pytest.mark.parametrize(("post", "is_turned"), [(POST, True), (SPARSE, False)])
def test_a_grasp_is_not_turned_for_few_points_of_another_object(post, is_turned):
    context, poses, home = scene(None, 0.0)
    _, place = at_key_pose(context, poses, home, "grasp", (0.0, 0.09))
    context, poses = replace(context, points={"post": post}, hand_radius_m=RADIUS), poses | {"post": place}
    shown = Plan(context.entries[0], poses, home)
    found = crowding(shown.entry, shown.targets(context), {"post": se3.apply(place, post)}, RADIUS)
    assert found["post"] > 0
    assert (found["post"] > FEW_POINTS) == is_turned
    assert (chosen(context, poses, home)[0].turned != 0) == is_turned


def test_the_other_one_of_a_kind_is_kept_clear_of_like_any_other_thing(caplog):
    context, poses, home = scene(None, 0.0)
    context = replace(context, points={"bowl": POST}, hand_radius_m=RADIUS)
    _, beside = at_key_pose(context, poses, home, "grasp", (0.0, 0.09))
    ranked = [Scored(context.entries[0], 1.0, 1.0, 1.0, 1.0)]
    assert context.choose(ranked, poses, home)[0].turned == 0
    assert context.choose(ranked, poses, home, {"bowl": (beside,)})[0].turned != 0
    between = (poses["bowl"][:3, 3] + poses["plate"][:3, 3]) / 2
    plan = Plan(context.entries[0], poses, home, not_meant={"bowl": (se3.from_yaw(between, 0.0),)})
    assert len(context.clear(plan).entry.key_poses) > len(plan.entry.key_poses)
    assert "go" not in caplog.text


def test_where_another_entry_grasps_from_elsewhere_it_is_taken_if_it_means_the_same():
    context, poses, home = scene(None, 0.0)
    context = replace(context, symmetries={})
    shown = context.entries[0]
    _, place = at_key_pose(context, poses, home, "grasp", (0.0, 0.09))
    context = replace(context, points={"post": POST}, hand_radius_m=RADIUS)
    quarter = se3.from_yaw(np.zeros(3), np.pi / 2)
    turned = replace(
        shown,
        key_poses=tuple(replace(pose, T_obj_ee=pose.T_obj_ee @ quarter) for pose in shown.key_poses),
        source="turned",
    )
    other = replace(
        turned, key=replace(turned.key, sub_tasks=(replace(turned.key.sub_tasks[0], target="cup"),))
    )
    for second, source in ((turned, "turned"), (other, shown.source)):
        both = [
            Candidate(one, 1.0 - i / 10, (one,), one.key.sub_tasks) for i, one in enumerate((shown, second))
        ]
        found = poses | {"post": place}
        plan, problems = context.choose(context.rank(both, found, home), found, home)
        assert (plan.entry.source, problems) == (source, [])


def test_what_is_out_of_reach_is_not_exchanged_for_another_thing():
    shown, other = entry(), entry("put the mug on the plate")
    context = planning_context(shown, other)
    poses = {**shown.object_poses, "mug": shown.object_poses["bowl"], "bowl": se3.from_yaw([5.0, 0, 0], 0.0)}
    both = [Candidate(one, 1.0, (one,), one.key.sub_tasks) for one in (shown, other)]
    ranked = sorted(context.rank(both, poses, HOME), key=lambda one: one.entry is other)
    plan, problems = context.choose(ranked, poses, HOME)
    assert plan.entry is shown
    assert problems


def overhang(beside, height):
    """A board over the plate that ends ``beside`` metres from its middle, on the side of negative x."""
    x, y = np.meshgrid(np.linspace(-0.2, beside, 30), np.linspace(-0.1, 0.1, 20))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])


def disc(radius=0.05):
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-radius, radius, 21)] * 2))
    inside = np.hypot(x, y) <= radius
    return np.column_stack([x, y, np.zeros_like(x)])[inside]


@pytest.mark.parametrize(("height", "is_in_the_way"), [(0.15, True), (0.01, False), (0.6, False)])
def test_what_a_load_comes_down_through_is_in_its_way(height, is_in_the_way):
    context, poses, home = scene(None, 0.0)
    targets = Plan(context.entries[0], poses, home).targets(context)
    points = {
        "bowl": se3.apply(poses["bowl"], disc()),
        "board": se3.apply(poses["plate"], overhang(0.1, height)),
    }
    found = crowding(context.entries[0], targets, points, 0.01)
    assert ("board" in found) == is_in_the_way
    assert "board" not in crowding(context.entries[0], targets, {"board": points["board"]}, 0.01)


def test_a_load_of_many_points_is_compared_in_little_time_and_memory():
    context, poses, home = scene(None, 0.0)
    targets = Plan(context.entries[0], poses, home).targets(context)
    points = {
        "bowl": se3.apply(poses["bowl"], disc()),
        "board": se3.apply(poses["plate"], overhang(0.1, 0.15)),
    }
    few = crowding(context.entries[0], targets, points, 0.01)
    many = {name: np.tile(own, (200, 1)) for name, own in points.items()}
    assert crowding(context.entries[0], targets, many, 0.01) == {"board": 200 * few["board"]}


@pytest.mark.parametrize(("beside", "metres"), [(-0.12, 0.0), (-0.085, 0.01), (-0.08, 0.02), (0.2, 0.0)])
def test_a_load_is_put_down_beside_what_overhangs_its_place_no_further_than_counts_as_there(beside, metres):
    context, poses, home = scene(None, 0.0)
    shown = replace(context.entries[0], outcomes=(ON_PLATE,))
    points = {"bowl": disc(), "board": overhang(beside, 0.15)}
    context = replace(context, entries=(shown,), points=points, hand_radius_m=0.01, symmetries={})
    poses = poses | {"board": poses["plate"]}
    plan, problems = chosen(context, poses, home)
    assert problems == []
    assert np.hypot(*plan.aside) == pytest.approx(metres)
    straight = replace(plan, aside=(0.0, 0.0)).targets(context)
    for target, before in zip(plan.targets(context), straight, strict=True):
        is_put = target.key_pose.phase in ("pre-place", "place", "release", "retreat")
        aside = [*plan.aside, 0.0] if is_put else np.zeros(3)
        assert_allclose(target.T_world_ee[:3, 3] - before.T_world_ee[:3, 3], aside, atol=1e-12)


@pytest.mark.parametrize("is_round", [True, False])
def test_what_is_put_on_something_round_is_turned_clear_of_what_stands_beside_it(is_round):
    context, poses, home = scene(None, 0.0)
    shown = replace(context.entries[0], outcomes=(ON_PLATE,))
    # The bowl's frame is at its rim, and it cannot be grasped from another side.
    middle = np.array([0.0, 0.05])
    symmetries = {"bowl": Symmetry(middle, 2.0)} | ({"plate": Symmetry(np.zeros(2), 0.0)} if is_round else {})
    context = replace(context, entries=(shown,), symmetries=symmetries)
    _, place = at_key_pose(context, poses, home, "release", (0.0, 0.09))
    context, poses = replace(context, points={"post": POST}, hand_radius_m=RADIUS), poses | {"post": place}
    plan, problems = chosen(context, poses, home)
    assert (bool(plan.around), any(plan.aside), problems) == (is_round, not is_round, [])
    assert not crowding(plan.entry, plan.targets(context), {"post": se3.apply(place, POST)}, RADIUS)
    own, straight = plan.targets(context), replace(plan, around=0.0).targets(context)
    T_ee_load = se3.inverse(own[2].T_world_ee) @ poses["bowl"]
    axis = np.array([[*middle, 0.0]])
    for i, (target, before) in enumerate(zip(own, straight, strict=True)):
        turn = plan.around if i >= 4 else 0.0
        ends, ended = target.T_world_ee @ T_ee_load, before.T_world_ee @ T_ee_load
        assert_allclose(ends[:3, :3], se3.from_yaw(np.zeros(3), turn)[:3, :3] @ ended[:3, :3], atol=1e-9)
        if target.key_pose.phase != "retreat":
            assert_allclose(se3.apply(ends, axis), se3.apply(ended, axis), atol=1e-9)
    # The hand backs off as it was shown, turned with what it let go of.
    backs = [se3.inverse(one[-2].T_world_ee) @ one[-1].T_world_ee for one in (own, straight)]
    assert_allclose(*backs, atol=1e-9)
    # It is where it should be, its frame turned about its middle or not.
    ended = plan.as_if_in_place({"bowl": own[5].T_world_ee @ T_ee_load}, symmetries)
    unturned = replace(plan, around=0.0, aside=(0.0, 0.0)).targets(context)[5].T_world_ee @ T_ee_load
    assert_allclose(se3.apply(ended["bowl"], axis), se3.apply(unturned, axis), atol=1e-9)


def test_a_place_keeps_its_way_to_be_put_at_until_it_moves_and_not_where_it_turns():
    context, poses, home = scene(None, 0.0)
    shown = replace(context.entries[0], outcomes=(ON_PLATE,))
    plan = replace(Plan(shown, poses, home), around=1.0)
    turned = {"plate": poses["plate"] @ se3.from_yaw(np.zeros(3), 2.0)}
    moved = {"plate": se3.from_yaw([0.05, 0.0, 0.0], 0.0) @ poses["plate"]}
    assert [plan.following(there).around for there in (turned, moved)] == [1.0, 0.0]


@pytest.mark.parametrize("middle", [(0.0, 0.0), (0.0, 0.05)])
def test_a_box_that_is_grasped_turned_and_put_as_shown_is_where_it_should_be(middle):
    context, poses, home = scene(None, 0.0)
    shown = replace(context.entries[0], outcomes=(ON_PLATE,))
    symmetries = {"bowl": Symmetry(np.array(middle), np.pi)}
    context = replace(context, entries=(shown,), symmetries=symmetries)
    plan = Plan(shown, poses, home)
    ends: list[np.ndarray] = []
    for way in (plan, replace(plan, turned=np.pi), replace(plan, turned=np.pi, put="as_shown")):
        targets = way.targets(context)
        end = targets[5].T_world_ee @ se3.inverse(targets[2].T_world_ee) @ poses["bowl"]
        ends.append(se3.apply(end, np.array([[*middle, 0.0]])))
    assert_allclose(ends[1], ends[0], atol=1e-9)
    assert_allclose(ends[2], ends[0], atol=1e-9)


def test_a_handle_is_no_load():
    cabinet = {"cabinet": np.eye(4)}
    shown = handle(KINDS["slide"])
    targets = transfer(shown, cabinet, {}, HOME)
    points = {"cabinet": pillar(0.1, 0.0, 0.3), "vase": pillar(0.1, 0.0, 0.6)}
    assert crowding(shown, targets, points, RADIUS) == crowding(
        shown, targets, {"vase": points["vase"]}, RADIUS
    )


def test_what_was_put_aside_is_where_it_should_be_until_its_place_moves():
    context, poses, home = scene(None, 0.0)
    shown = replace(context.entries[0], outcomes=(ON_PLATE,))
    plan = replace(Plan(shown, poses, home), aside=(0.02, 0.0))
    ended = poses | {"bowl": se3.from_yaw([0.02, 0.0, 0.0], 0.0) @ poses["plate"]}
    assert_allclose(plan.as_if_in_place(ended, {})["bowl"], poses["plate"], atol=1e-12)
    assert_allclose(plan.as_if_in_place(ended, {})["plate"], poses["plate"], atol=1e-12)
    # What is pushed was not put aside.
    pushed = replace(plan, entry=replace(shown, key_poses=shown.key_poses[3:]))
    assert pushed.otherwise_put(context) == []
    assert_allclose(pushed.as_if_in_place(ended, {})["bowl"], ended["bowl"])
    for name, metres, aside in (("plate", 0.01, 0.02), ("plate", 0.05, 0.0), ("bowl", 0.05, 0.02)):
        there = {name: se3.from_yaw([metres, 0.0, 0.0], 0.0) @ poses[name]}
        followed = plan.following(there)
        assert followed.aside == (aside, 0.0)
        assert_allclose(followed.object_poses[name], there[name])


@pytest.mark.parametrize(
    ("beside", "is_taken"), [((0.0, 0.0, 0.0), True), ((0.0, 0.06, 0.0), False), ((0.0, 0.0, 0.5), False)]
)
def test_a_place_where_something_stands_already_is_refused_by_name(beside, is_taken):
    context, poses, home = scene(None, 0.0)
    shown = replace(context.entries[0], outcomes=(ON_PLATE,))
    mug = np.concatenate([disc() + np.array([0.0, 0.0, z]) for z in np.linspace(0.0, 0.1, 11)])
    points = {"bowl": disc(), "mug": mug}
    context = replace(context, entries=(shown,), points=points, hand_radius_m=RADIUS, symmetries={})
    targets = Plan(shown, poses, home).targets(context)
    (grasp,), (release,) = (
        [t for t in targets if t.key_pose.phase == phase] for phase in ("grasp", "release")
    )
    T_end = release.T_world_ee @ se3.inverse(grasp.T_world_ee) @ poses["bowl"]
    found = poses | {"mug": se3.from_yaw(T_end[:3, 3] + [*beside], 0.0)}
    plan, problems = chosen(context, found, home)
    assert problems == (["the plate is taken: the mug stands where the bowl would"] if is_taken else [])
    assert plan.entry is shown


@pytest.mark.parametrize(("scale", "is_taken"), [(0.3, True), (1.1, False)])
def test_what_lies_flat_in_the_middle_of_a_place_takes_it_but_not_that_place_by_another_name(scale, is_taken):
    context, poses, home = scene(None, 0.0)
    shown = replace(context.entries[0], outcomes=(ON_PLATE,))
    targets = Plan(shown, poses, home).targets(context)
    (grasp,), (release,) = (
        [t for t in targets if t.key_pose.phase == phase] for phase in ("grasp", "release")
    )
    T_end = release.T_world_ee @ se3.inverse(grasp.T_world_ee) @ poses["bowl"]
    plate = 3 * disc() + se3.apply(se3.inverse(poses["plate"]), T_end[:3, 3])
    points = {"bowl": disc(), "plate": plate, "cheese": scale * (plate - plate.mean(0)) + plate.mean(0)}
    context = replace(context, entries=(shown,), points=points, hand_radius_m=RADIUS, symmetries={})
    _, problems = chosen(context, poses | {"cheese": poses["plate"]}, home)
    assert ("the plate is taken: the cheese stands where the bowl would" in problems) == is_taken


def test_a_place_where_another_of_the_kind_stands_is_taken_and_the_next_entry_puts_it_elsewhere():
    context, poses, home = scene(None, 0.0)
    shown = context.entries[0]
    key_poses = tuple(
        replace(pose, T_obj_ee=se3.from_yaw([0.0, 0.08, 0.0], 0.0) @ pose.T_obj_ee)
        if pose.anchor.place == "plate"
        else pose
        for pose in shown.key_poses
    )
    other = replace(shown, key_poses=key_poses, source="aside")
    context = replace(context, entries=(shown, other))
    both = [Candidate(one, 1.0 - i / 10, (one,), one.key.sub_tasks) for i, one in enumerate((shown, other))]
    ranked = context.rank(both, poses, home)
    targets = Plan(shown, poses, home).targets(context)
    (grasp,), (release,) = (
        [t for t in targets if t.key_pose.phase == phase] for phase in ("grasp", "release")
    )
    there = {"bowl": (release.T_world_ee @ se3.inverse(grasp.T_world_ee) @ poses["bowl"],)}
    assert context.choose(ranked, poses, home)[0].entry is shown
    assert context.choose(ranked, poses, home, there)[0].entry is other
    plan, problems = context.choose(ranked[:1], poses, home, there)
    assert (plan.entry, problems) == (shown, ["the plate is taken: another bowl stands there"])


def test_what_lies_in_a_basket_takes_no_place():
    context, poses, home = scene(None, 0.0)
    shown = context.entries[0]
    put_in = tuple(replace(one, relation="in") for one in shown.key.sub_tasks)
    targets = Plan(shown, poses, home).targets(context)
    (grasp,), (release,) = (
        [t for t in targets if t.key_pose.phase == phase] for phase in ("grasp", "release")
    )
    there = {"bowl": (release.T_world_ee @ se3.inverse(grasp.T_world_ee) @ poses["bowl"],)}
    assert taken(shown, targets, poses, {}, there)
    assert not taken(replace(shown, key=replace(shown.key, sub_tasks=put_in)), targets, poses, {}, there)


def test_what_goes_into_a_basket_is_not_put_beside_its_place():
    """Beside it is the basket's wall."""
    context, poses, home = scene(None, 0.0)
    (on,) = context.entries
    (sub_task,) = on.key.sub_tasks
    into = replace(on, key=replace(on.key, sub_tasks=(replace(sub_task, relation="in"),)))
    asides = [
        [way.aside for way in Plan(replace(entry, outcomes=(ON_PLATE,)), poses, home).otherwise_put(context)]
        for entry in (on, into)
    ]
    assert any(aside != (0.0, 0.0) for aside in asides[0])
    assert all(aside == (0.0, 0.0) for aside in asides[1])
