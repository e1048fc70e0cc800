"""Of several like objects in a first frame, the one that the demonstration took hold of is its object."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from tests.memory.builders import robot
from tests.mining.episodes import pick_and_place, push
from tests.perception.builders import model, patch_model

from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.mining import objects as mining_objects
from lerobot_openspm.mining.key_poses import find_key_poses
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.mining.objects import contact_cues, detect_touched, place_touched
from lerobot_openspm.types import ContactCue, DemonstrationScene, PoseEstimate

ANGLES = np.linspace(0, 2 * np.pi, 40, endpoint=False)
RIM = np.column_stack([0.05 * np.cos(ANGLES), 0.05 * np.sin(ANGLES), np.full(40, 0.04)])
BOWL = replace(model("bowl"), points=RIM.astype(np.float32))
NEAR, FAR = se3.from_yaw([0.1, -0.2, 0.0], 0.3), se3.from_yaw([0.1, 0.1, 0.0], 0.0)
ELSEWHERE = se3.from_yaw([0.4, 0.4, 0.0], 0.0)
BELOW, LESS_BELOW = se3.from_yaw([0.1, -0.2, -0.04], 0.3), se3.from_yaw([0.1, -0.2, -0.035], 0.3)


def seen(*places, status=None):
    status = status or ("ambiguous" if len(places) > 1 else "found")
    return PoseEstimate(status, places[0], 1e-6 * np.eye(4), 1.0, others=tuple(places[1:]))


def touch(T, *, kind="grasp", name="bowl", by=(0.0, 0.0)):
    return ContactCue(name, np.array([*(T[:2, 3] + by), 0.03]), kind)


@pytest.mark.parametrize("status", ["found", "ambiguous"])
@pytest.mark.parametrize("places", [(NEAR, FAR), (FAR, NEAR), (FAR, se3.from_yaw([0.4, 0.4, 0], 0), NEAR)])
@pytest.mark.parametrize("kind", ["grasp", "contact", "release"])
def test_it_is_the_one_that_the_hand_went_to(places, status, kind):
    found = place_touched(BOWL, seen(*places, status=status), (touch(NEAR, kind=kind),))
    assert_array_equal(found, NEAR)


@given(st.integers(0, 2), st.floats(-0.03, 0.03), st.floats(-0.03, 0.03))
def test_whichever_of_three_is_grasped_anywhere_on_it_is_meant(meant, x, y):
    places = [se3.from_yaw([0.15 * i, 0.1 * (i % 2), 0.0], 0.5 * i) for i in range(3)]
    assert_array_equal(place_touched(BOWL, seen(*places), (touch(places[meant], by=(x, y)),)), places[meant])


def test_only_the_first_touch_tells_where_it_stood_at_first():
    again = touch(FAR)  # it was put down where another one stands, and taken again
    assert_array_equal(place_touched(BOWL, seen(FAR, NEAR), (touch(NEAR), again)), NEAR)


def test_other_objects_touches_tell_nothing():
    assert place_touched(BOWL, seen(NEAR, FAR), (touch(NEAR, name="plate"),)) is None
    assert_array_equal(place_touched(BOWL, seen(NEAR), ()), NEAR)


@pytest.mark.parametrize(
    ("first", "all_of_them", "kind", "expected"),
    [
        (seen(FAR), seen(FAR, NEAR), "grasp", (FAR, NEAR)),  # the hand went to another one
        (seen(NEAR), seen(FAR, NEAR), "grasp", (NEAR,)),
        (seen(BELOW), seen(NEAR), "grasp", (NEAR,)),  # it stands on something
        (seen(FAR), seen(FAR, BELOW), "grasp", (FAR, BELOW)),  # it is grasped by a knob that is not known
        (seen(BELOW), seen(LESS_BELOW), "grasp", (BELOW,)),  # hardly nearer
        (seen(FAR), seen(ELSEWHERE, FAR), "grasp", (FAR,)),  # there is none where the hand went
        (seen(FAR), seen(NEAR, status="not_found"), "grasp", (FAR,)),
        (seen(FAR, status="not_found"), seen(NEAR), "grasp", (NEAR,)),
        (seen(FAR), seen(FAR, NEAR), "contact", (FAR,)),  # it was pushed from beside it
        (seen(FAR), seen(FAR, NEAR), "release", (FAR,)),  # something was put there
    ],
)
def test_others_of_the_kind_are_sought_where_the_hand_went_elsewhere(
    first, all_of_them, kind, expected, monkeypatch
):
    def detect(views, objects, segmenter=None, told_apart=()):
        return {name: all_of_them if name in told_apart else first for name in objects}

    monkeypatch.setattr(mining_objects, "detect", detect)
    scene = DemonstrationScene({}, (touch(NEAR, kind=kind, by=(0.05, 0.0)),))
    found = detect_touched(scene, {"bowl": BOWL})["bowl"]
    assert_array_equal((found.T_world_obj, *found.others), expected)


def test_one_that_is_seen_where_the_hand_never_went_is_another_one():
    assert place_touched(BOWL, seen(FAR), (touch(NEAR),)) is None
    assert place_touched(BOWL, seen(FAR, status="not_found"), (touch(FAR),)) is None
    # Where its shape is not known, nor is how far its middle is from the hand.
    assert_array_equal(place_touched(patch_model("bowl"), seen(FAR), (touch(NEAR),)), FAR)


@pytest.mark.parametrize(
    ("relation", "touched"),
    [
        ("on", ["bowl", "plate"]),
        ("in", ["bowl", "plate"]),
        ("next to", ["bowl"]),
        ("to the left of", ["bowl"]),
    ],
)
def test_what_is_put_beside_a_thing_does_not_touch_it(relation, touched):
    task = f"put the bowl {relation} the plate"
    episode = pick_and_place()[0].episode(0, task)
    item = MinedEpisode(episode, tuple(find_key_poses(episode, robot())), parse_instruction(task))
    assert [cue.name for cue in contact_cues(item)] == touched


def test_a_demonstration_that_is_cut_before_the_hand_lets_go_would_have_let_go_there():
    task = "put the bowl on the plate"
    episode = pick_and_place()[0].episode(0, task)
    own = find_key_poses(episode, robot())
    place = next(i for i, pose in enumerate(own) if pose.phase == "place")
    item = MinedEpisode(episode, tuple(own[: place + 1]), parse_instruction(task))
    cue = contact_cues(item)[-1]
    assert (cue.name, cue.kind) == ("plate", "release")
    assert_array_equal(cue.point_world, own[place].T_world_ee[:3, 3])
    carrying = replace(item, key_poses=tuple(own[:place]))
    assert [cue.name for cue in contact_cues(carrying)] == ["bowl"]


@pytest.mark.parametrize(
    ("task", "touched"),
    [
        # It was shut at first, so that the hand lets go inside of it.
        ("open the drawer of the cabinet and put the bowl inside", ["cabinet", "bowl"]),
        ("put the bowl in the drawer of the cabinet", ["bowl", "cabinet"]),
    ],
)
def test_a_drawer_is_touched_where_it_stood_open_at_first(task, touched):
    episode = pick_and_place()[0].episode(0, task)
    sub_tasks = parse_instruction(task)
    own = find_key_poses(episode, robot())
    key_poses = [replace(pose, contact=pose.contact + 2 * i) for i in range(len(sub_tasks)) for pose in own]
    item = MinedEpisode(episode, tuple(key_poses), sub_tasks)
    kinds = [(cue.name, cue.kind) for cue in contact_cues(item)]
    assert [name for name, _ in kinds] == touched
    assert (("cabinet", "release") in kinds) == (len(sub_tasks) == 1)


@pytest.mark.parametrize(("task", "end"), [("close the drawer of the cabinet", 1), ("push the cabinet", 0)])
def test_what_is_closed_is_touched_where_it_is_shut(task, end):
    drawer, at = push()
    episode = drawer.episode(0, task)
    item = MinedEpisode(episode, tuple(find_key_poses(episode, robot())), parse_instruction(task))
    (cue,) = contact_cues(item)
    frame = at["push"] if end else at["approach"]
    # A demonstration that is cut when its goal is reached ends with the push.
    last = max(i for i, pose in enumerate(item.key_poses) if pose.phase == "push")
    cut = contact_cues(replace(item, key_poses=item.key_poses[: last + 1]))
    assert [one.name for one in cut] == ["cabinet"]
    assert (cue.name, cue.kind) == ("cabinet", "contact")
    assert np.linalg.norm(cue.point_world - episode.T_world_ee[frame - 1][:3, 3]) < 0.02


@pytest.mark.parametrize(
    ("task", "told_apart"),
    [
        ("put the bowl on the plate", set()),
        ("put the left bowl on the plate", {"bowl"}),
        ("put the bowl on the plate next to the box", {"plate"}),
        ("put both bowls on the plate", {"bowl"}),
    ],
)
def test_learning_is_told_of_what_pictures_may_show_several(task, told_apart, monkeypatch):
    told = []
    monkeypatch.setattr(mining_objects, "learn_objects", lambda *given: told.append(given[-1]) or ({}, {}))
    monkeypatch.setattr(mining_objects, "detect", lambda *_: {})
    episode = pick_and_place()[0].episode(0, task)
    item = MinedEpisode(episode, tuple(find_key_poses(episode, robot())), parse_instruction(task))
    scene = DemonstrationScene({}, contact_cues(item))
    mining_objects.find_objects([scene], [item], {}, np.random.default_rng(0))
    assert told == [told_apart]
