from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.memory.builders import hand_pose

from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.entry import WORLD, Anchor
from lerobot_openspm.mining.anchors import (
    Demonstration,
    align_symmetric,
    consensus,
    firmness,
    qualities,
    roles,
)
from lerobot_openspm.mining.key_poses import KeyPose

SUB_TASKS = parse_instruction("put the bowl on the plate")
CONTACT_OF = {"approach": 0, "grasp": 0, "lift": 1, "pre-place": 1, "place": 1, "release": 1, "retreat": 2}
GRASP, PLACE = (0, "grasp", 0), (1, "place", 0)


def key_pose(phase, T_world_ee, contact=None):
    contact = CONTACT_OF[phase] if contact is None else contact
    return KeyPose(0, T_world_ee, phase, 1.0, False, 0.0, 1, False, contact)


def scene(rng):
    return {
        "bowl": se3.from_yaw([*rng.uniform(-0.3, 0.0, 2), 0.0], rng.uniform(-1.5, 1.5)),
        "plate": se3.from_yaw([*rng.uniform(0.0, 0.3, 2), 0.0], rng.uniform(-1.5, 1.5)),
    }


def demonstrations(n, place_axes="plate", seed=0, error_m=0.0):
    """The hand grasps at a fixed pose in the bowl's frame and places at one over the plate."""
    rng, made = np.random.default_rng(seed), []
    for _ in range(n):
        layout = scene(rng)
        wobble = se3.transform(np.eye(3), error_m * rng.normal(size=3))
        T_place = Anchor("plate", place_axes).frame(layout)
        poses = (
            key_pose("grasp", layout["bowl"] @ wobble @ hand_pose(0.04, 0.01, 0.02, 0.3)),
            key_pose("place", T_place @ wobble @ hand_pose(0.02, -0.05, 0.05, 0.7)),
        )
        made.append(Demonstration(poses, layout))
    return made


@pytest.mark.parametrize("axes", ["plate", WORLD, "bowl"])
@pytest.mark.parametrize("error_m", [0.0, 0.002])
def test_anchors_are_where_the_demonstrations_agree(axes, error_m):
    anchors = consensus(demonstrations(8, axes, error_m=error_m), SUB_TASKS)
    assert anchors == {GRASP: Anchor("bowl", "bowl"), PLACE: Anchor("plate", axes)}


def test_the_instruction_is_overruled_by_many_demonstrations():
    # The hand "places" at a fixed pose from the bowl, whatever the instruction calls the landmark.
    rng, made = np.random.default_rng(1), []
    for _ in range(8):
        layout = scene(rng)
        made.append(Demonstration((key_pose("place", layout["bowl"] @ hand_pose(0, 0.1, 0.1)),), layout))
    assert consensus(made, SUB_TASKS) == {PLACE: Anchor("bowl", "bowl")}


@pytest.mark.parametrize("axes", ["plate", WORLD, "bowl"])
def test_one_demonstration_follows_the_instruction(axes):
    anchors = consensus(demonstrations(1, axes), SUB_TASKS)
    assert anchors == {GRASP: Anchor("bowl", "bowl"), PLACE: Anchor("plate", "plate")}


@pytest.mark.parametrize(
    ("phase", "place"),
    [
        ("approach", "bowl"), ("grasp", "bowl"), ("lift", "bowl"),
        ("pre-place", "plate"), ("place", "plate"), ("release", "plate"), ("retreat", "plate"),
    ],
)  # fmt: skip
def test_what_the_instruction_suggests_for_each_phase(phase, place):
    layout = scene(np.random.default_rng(0))
    (anchor,) = consensus(
        [Demonstration((key_pose(phase, hand_pose(0, 0, 0.2)),), layout)], SUB_TASKS
    ).values()
    assert anchor == Anchor(place, place)


def test_the_second_sub_task_has_its_own_objects():
    sub_tasks = parse_instruction("open the top drawer and put the bowl on the plate")
    layout = scene(np.random.default_rng(0)) | {"cabinet": se3.from_yaw([0.2, -0.3, 0], 0.2)}
    poses = (
        key_pose("grasp", hand_pose(0.2, -0.3, 0.1), 0),
        key_pose("open", hand_pose(0.1, -0.3, 0.1), 1),
        key_pose("retreat", hand_pose(0.1, -0.3, 0.2), 2),
        key_pose("grasp", hand_pose(0, 0, 0.1), 2),
        key_pose("release", hand_pose(0.1, 0.1, 0.1), 3),
    )
    anchors = consensus([Demonstration(poses, layout)], sub_tasks)
    assert [anchors[role].place for role in roles(poses)] == [
        "cabinet",
        "cabinet",
        "cabinet",
        "bowl",
        "plate",
    ]


def test_objects_that_the_instruction_does_not_name_are_no_anchors():
    made = [Demonstration(d.key_poses, d.object_poses | {"cup": np.eye(4)}) for d in demonstrations(6)]
    fixed = [
        Demonstration((*d.key_poses[:1], key_pose("place", hand_pose(0.1, 0.1, 0.1))), d.object_poses)
        for d in made
    ]
    assert all("cup" not in anchor.objects for anchor in consensus(fixed, SUB_TASKS).values())


def test_an_object_that_is_never_found_gives_no_anchor():
    blind = [Demonstration(d.key_poses, {}) for d in demonstrations(3)]
    assert consensus(blind, SUB_TASKS) == {}
    half = [Demonstration(d.key_poses, {"bowl": d.object_poses["bowl"]}) for d in demonstrations(3)]
    assert {anchor.place for anchor in consensus(half, SUB_TASKS).values()} == {"bowl"}


def test_roles_are_counted_from_the_contact_backwards():
    poses = [key_pose(phase, np.eye(4)) for phase in ("approach", "approach", "approach", "grasp", "lift")]
    assert roles(poses) == [
        (0, "approach", 2),
        (0, "approach", 1),
        (0, "approach", 0),
        (0, "grasp", 0),
        (1, "lift", 0),
    ]
    assert roles(poses[1:]) == roles(poses)[1:]


def test_the_outlier_among_the_demonstrations_has_the_lowest_quality():
    made = demonstrations(7, error_m=0.001)
    grasp, place = made[3].key_poses
    shifted = key_pose("grasp", grasp.T_world_ee @ se3.from_yaw([0.03, 0.0, 0.0], 0.0))
    made[3] = Demonstration((shifted, place), made[3].object_poses)
    scores = qualities(made, consensus(made, SUB_TASKS))
    assert int(np.argmin(scores)) == 3
    assert scores[3] < 0.5 < min(score for i, score in enumerate(scores) if i != 3)
    assert all(0 <= score <= 1 for score in scores)


HELD = (("approach", False, 0.08), ("grasp", True, 0.01), ("lift", True, 0.01), ("place", True, 0.01))


def held(*changed, opened=0.08):
    """Key poses of something that is carried; by number, some with the fingers at another opening."""
    openings = {0: opened, **dict(changed)}
    return [
        replace(key_pose(phase, np.eye(4)), closed=closed, opening=openings.get(i, opening))
        for i, (phase, closed, opening) in enumerate(HELD)
    ]


@pytest.mark.parametrize(
    ("poses", "expected"),
    [
        (held(), 1.0),
        (held((2, 0.0086)), 1.0),
        (held((3, 0.00675)), 0.5),
        (held((2, 0.004), (3, 0.01)), 0.0),
        # What is this thin is not felt, and an opening is told in any unit.
        (held((1, 0.0023), (2, 0.001), (3, 0.001)), 1.0),
        (held((1, 1.0), (2, 1.0), (3, 0.675), opened=8.0), 0.5),
        (held((1, 0.23), (2, 0.1), (3, 0.1), opened=8.0), 1.0),
        ([], 1.0),
    ],
)
def test_what_slipped_in_the_fingers_was_not_held_firmly(poses, expected):
    assert firmness(poses) == pytest.approx(expected)


def test_a_handle_may_slip_and_what_is_let_go_is_not_held():
    grasp, lift = held()[1:3]
    for phase in ("open", "turn"):
        handle = replace(lift, phase=phase, opening=0.002)
        assert firmness([grasp, handle]) == 1.0
        assert firmness([grasp, replace(lift, opening=0.002), handle]) == 0.0
    gone = replace(lift, phase="release", closed=False, opening=0.08)
    assert firmness([grasp, gone, replace(lift, opening=0.002)]) == 1.0


def test_a_demonstration_in_which_it_slipped_counts_less():
    made = demonstrations(4)
    shown = [replace(one, key_poses=tuple(held())) for one in made]
    shown[2] = replace(shown[2], key_poses=tuple(held((3, 0.00675))))
    assert_allclose(qualities(shown, {}), [1.0, 1.0, 0.5, 1.0])


def test_demonstrations_that_agree_and_single_ones_are_perfect():
    for n in (1, 4):
        made = demonstrations(n)
        assert_allclose(qualities(made, consensus(made, SUB_TASKS)), 1.0, atol=1e-6)


@pytest.mark.parametrize("period", [np.pi, np.pi / 2])
def test_symmetric_objects_are_turned_so_that_demonstrations_agree(period):
    made = demonstrations(6)
    turned = [
        Demonstration(
            d.key_poses, d.object_poses | {"bowl": se3.yaw_equivalents(d.object_poses["bowl"], period)[i % 2]}
        )
        for i, d in enumerate(made)
    ]
    aligned = align_symmetric(turned, {"bowl": period})
    for d, true in zip(aligned, made, strict=True):
        assert_allclose(d.object_poses["bowl"], true.object_poses["bowl"], atol=1e-9)
        assert_allclose(d.object_poses["plate"], true.object_poses["plate"])
        assert d.key_poses == true.key_poses
    # Without symmetry nothing is turned, and a body of revolution has nothing to turn.
    for periods in ({}, {"bowl": 2 * np.pi}, {"bowl": 0.0}):
        for d, same in zip(align_symmetric(turned, periods), turned, strict=True):
            assert_allclose(d.object_poses["bowl"], same.object_poses["bowl"])


def test_where_a_push_turns_says_nothing_against_a_demonstration():
    sub_tasks = parse_instruction("push the plate to the front of the bowl")
    rng, made = np.random.default_rng(3), []
    for _ in range(8):
        layout = scene(rng)
        turn = layout["bowl"] @ hand_pose(*rng.uniform(-0.015, 0.015, 2), 0.02)
        end = layout["bowl"] @ hand_pose(0.1, 0.0, 0.02)
        made.append(Demonstration((key_pose("push", turn, 0), key_pose("push", end, 0)), layout))
    assert_allclose(qualities(made, consensus(made, sub_tasks)), 1.0, atol=1e-6)


def test_a_symmetric_object_is_turned_by_where_a_push_ends_and_not_by_where_it_turns():
    end = hand_pose(0.06, 0.0, 0.02)
    other_way_round = se3.from_yaw([0.0, 0.0, 0.0], np.pi) @ end
    layout = {"plate": np.eye(4)}
    first = Demonstration((key_pose("push", end, 0),), layout)
    second = Demonstration((key_pose("push", other_way_round, 0), key_pose("push", end, 0)), layout)
    for made in ([first, second], [second, first]):
        aligned = align_symmetric(made, {"plate": np.pi})
        assert_allclose(aligned[0].object_poses["plate"], aligned[1].object_poses["plate"], atol=1e-9)
