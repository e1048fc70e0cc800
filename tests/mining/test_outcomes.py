from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from tests.memory.builders import hand_pose, robot
from tests.mining.episodes import push
from tests.mining.test_anchors import SUB_TASKS, demonstrations, key_pose
from tests.perception.builders import model

from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.entry import WORLD
from lerobot_openspm.mining import objects
from lerobot_openspm.mining.anchors import Demonstration
from lerobot_openspm.mining.key_poses import find_key_poses
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.mining.outcomes import (
    LEAST_TOLERANCE_M,
    MOST_SPREAD_M,
    carried_to,
    outcomes,
    pushed_to,
)
from lerobot_openspm.types import DemonstrationScene, PoseEstimate, Symmetry

PUSH = parse_instruction("push the plate to the front of the stove")


def ends(shown, sub_tasks=SUB_TASKS):
    return [carried_to(one, sub_tasks) for one in shown]


def pushed(n, error_m=0.0, turned=0.0, seed=0):
    """Plates that are pushed to one place before the stove, wherever and however turned that stands."""
    rng, shown, ended = np.random.default_rng(seed), [], []
    for _ in range(n):
        stove = se3.from_yaw([*rng.uniform(-0.2, 0.2, 2), 0.0], rng.uniform(-turned, turned))
        plate = se3.from_yaw([0.4, rng.uniform(-0.2, 0.2), 0.0], 0.0)
        shown.append(Demonstration((), {"plate": plate, "stove": stove}))
        goal = se3.apply(stove, np.array([[0.22, 0.0, 0.0]]))[0] + error_m * rng.uniform(-1, 1, 3)
        ended.append({"plate": se3.from_yaw(goal, 0.0)})
    return shown, ended


def test_what_is_carried_ends_where_the_hand_lets_it_go():
    (shown,) = demonstrations(1)
    grasp, place = shown.key_poses
    expected = place.T_world_ee @ se3.inverse(grasp.T_world_ee) @ shown.object_poses["bowl"]
    assert_allclose(carried_to(shown, SUB_TASKS)["bowl"], expected, atol=1e-12)


def test_what_was_not_seen_at_the_start_has_no_end():
    (shown,) = demonstrations(1)
    unseen = Demonstration(shown.key_poses, {"plate": shown.object_poses["plate"]})
    assert carried_to(unseen, SUB_TASKS) == {}


ANGLES = np.linspace(0, 2 * np.pi, 72, endpoint=False)
# The rim of a plate whose frame's origin is beside its middle.
PLATE = {"plate": np.stack([0.07 * np.cos(ANGLES) + 0.04, 0.07 * np.sin(ANGLES), 0 * ANGLES], axis=-1)}


def hand_pushes(plate, *ways, start="behind", behind_m=0.07):
    """A demonstration in which the hand comes down behind a plate, or above it, and pushes it along ways."""
    middle = se3.apply(plate, np.array([[0.04, 0.0, 0.0]]))[0, :2]
    heading = ways[0] / np.linalg.norm(ways[0])
    hand = middle + (-behind_m if start == "behind" else 0.03) * heading
    points = [hand, *(hand + way for way in np.cumsum(ways, axis=0))]
    poses = tuple(key_pose("push" if i else "approach", hand_pose(*p, 0.02), 0) for i, p in enumerate(points))
    return Demonstration(poses, {"plate": plate, "stove": np.eye(4)}), points[-1]


@given(st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi), st.floats(0.05, 0.3))
def test_what_is_pushed_ends_just_ahead_of_the_hand(yaw, heading, metres):
    plate = se3.from_yaw([0.4, 0.1, 0.02], yaw)
    way = metres * np.array([np.cos(heading), np.sin(heading)])
    shown, _ = hand_pushes(plate, way)
    end = pushed_to(shown, PUSH, PLATE)["plate"]
    assert_allclose(end[:3, 3] - plate[:3, 3], [*way, 0.0], atol=1e-3)
    assert_allclose(end[:3, :3], plate[:3, :3], atol=1e-12)


def test_a_push_that_turns_leaves_the_object_ahead_of_its_last_stretch():
    plate = se3.from_yaw([0.4, 0.1, 0.02], 0.3)
    shown, hand = hand_pushes(plate, np.array([0.2, 0.0]), np.array([0.0, 0.1]))
    end = pushed_to(shown, PUSH, PLATE)["plate"]
    middle = se3.apply(end, np.array([[0.04, 0.0, 0.0]]))[0, :2]
    assert_allclose(middle - hand, [0.0, 0.07], atol=1e-3)


@pytest.mark.parametrize("first", [[], [np.array([0.01, 0.0])]], ids=["at once", "after a short stretch"])
def test_what_is_dragged_along_from_above_is_not_told(first):
    shown, _ = hand_pushes(se3.from_yaw([0.4, 0.1, 0.02], 0.0), *first, np.array([0.2, 0.0]), start="above")
    assert pushed_to(shown, PUSH, PLATE) == {}


@pytest.mark.parametrize("short", [0.005, 0.019])
def test_a_short_stretch_at_the_beginning_of_a_push_from_behind_does_not_hide_it(short):
    plate, axis = se3.from_yaw([0.4, 0.1, 0.02], 0.0), np.array([1.0, 0.0])
    # Shallower than the stretch, which passes its middle.
    strip = {"plate": PLATE["plate"] * [0.1, 1.0, 1.0] + [0.036, 0.0, 0.0]}
    shown, hand = hand_pushes(plate, short * axis, 0.2 * axis, behind_m=0.008)
    assert_allclose(pushed_to(shown, PUSH, strip)["plate"][0, 3], hand[0] - 0.033, atol=1e-3)


def test_what_is_dragged_back_after_a_push_is_not_told():
    plate = se3.from_yaw([0.4, 0.1, 0.02], 0.0)
    pushed, _ = hand_pushes(plate, np.array([0.1, 0.0]))
    there = se3.from_yaw([0.1, 0.0, 0.0], 0.0) @ plate
    for ways in ([np.array([0.1, 0.0])], [np.array([0.01, 0.0]), np.array([0.2, 0.0])]):
        dragged, _ = hand_pushes(there, *ways, start="above")
        both = replace(pushed, key_poses=pushed.key_poses + dragged.key_poses)
        assert pushed_to(both, PUSH, PLATE) == {}


@pytest.mark.parametrize("points", [{}, {"plate": np.zeros((0, 3))}], ids=["unknown", "without a surface"])
def test_the_end_of_a_push_needs_the_shape_of_what_is_pushed(points):
    shown, _ = hand_pushes(se3.from_yaw([0.4, 0.1, 0.02], 0.0), np.array([0.2, 0.0]))
    assert pushed_to(shown, PUSH, points) == {}


@pytest.mark.parametrize(("n_seen", "is_by_images"), [(0, False), (1, False), (2, True), (4, True)])
def test_most_final_pictures_or_none_tell_where_what_is_pushed_ends(monkeypatch, n_seen, is_by_images):
    task = "push the plate to the front of the stove"
    drawer, at = push(plate=(0.1, -0.1))
    episode = drawer.episode(0, task)
    item = MinedEpisode(episode, tuple(find_key_poses(episode, robot())), PUSH)
    stands, sprang = se3.from_yaw([0.1 - 0.04, -0.1 + 0.07, 0.0], 0.0), se3.from_yaw([0.3, 0.3, 0.0], 1.0)
    plate = replace(model("plate"), points=PLATE["plate"].astype(np.float32))
    scenes = [DemonstrationScene({"first": i}, (), {"last": i}) for i in range(4)]

    def seen(views, sought, segmenter):
        T, sure = (stands, 1.0) if "first" in views else (sprang, 1.0 if views["last"] < n_seen else 0.5)
        return {"plate": PoseEstimate("found", T, 1e-6 * np.eye(4), sure)}

    monkeypatch.setattr(objects, "detect", seen)
    found = objects.find_objects(scenes, [item] * 4, {"plate": plate}, np.random.default_rng(0))
    if is_by_images:
        assert [list(ends) for ends in found.ends] == [["plate"]] * n_seen + [[]] * (4 - n_seen)
        assert all(ends["plate"] is sprang for ends in found.ends[:n_seen])
    else:
        pushed = episode.T_world_ee[at["push"], :2, 3] - episode.T_world_ee[at["approach"], :2, 3]
        for ends in found.ends:
            assert_allclose(ends["plate"][:2, 3] - stands[:2, 3], pushed, atol=2e-3)


@pytest.mark.parametrize("n", [1, 3, 10])
def test_the_outcome_is_where_the_demonstrations_leave_the_target(n):
    shown, ended = pushed(n, error_m=0.005, turned=1.0)
    found = outcomes(shown, ended, PUSH)
    assert len(found) == n
    for demonstration, end, (outcome,) in zip(shown, ended, found, strict=True):
        assert outcome.target == "plate"
        assert outcome.anchor.place == "stove"
        assert_allclose(outcome.position, [0.22, 0, 0], atol=0.01)
        layout = {**demonstration.object_poses, **end}
        assert_allclose(outcome.place_shown(layout), end["plate"][:3, 3], atol=1e-12)
        assert outcome.is_met(layout)


def test_what_is_round_ends_where_its_middle_is_however_it_is_turned():
    shown, goals = pushed(5, turned=1.0)
    middle, rng = np.array([0.04, 0.01]), np.random.default_rng(0)
    ended = [
        {"plate": end["plate"] @ se3.from_yaw(np.zeros(3), yaw) @ se3.from_yaw([*-middle, 0.0], 0.0)}
        for end, yaw in zip(goals, rng.uniform(-3, 3, 5), strict=True)
    ]
    found = outcomes(shown, ended, PUSH, {"plate": Symmetry(middle, 0.0)})
    for one, end, goal, (outcome,) in zip(shown, ended, goals, found, strict=True):
        layout = {**one.object_poses, **end}
        assert_allclose(outcome.position, [0.22, 0, 0], atol=1e-9)
        assert_allclose(outcome.target_at(layout), goal["plate"][:3, 3], atol=1e-9)
        assert outcome.is_met(layout)
        assert outcome.tolerance_m == LEAST_TOLERANCE_M
    # By its frame's origin the demonstrations agree less.
    assert outcomes(shown, ended, PUSH)[0][0].tolerance_m > 2 * LEAST_TOLERANCE_M


def test_axes_are_those_in_which_the_demonstrations_agree():
    shown, ended = pushed(8, turned=1.0)
    assert all(outcome.anchor.axes == "stove" for (outcome,) in outcomes(shown, ended, PUSH))
    rng = np.random.default_rng(1)
    for one, end in zip(shown, ended, strict=True):
        one.object_poses["stove"][:3, :3] = se3.from_yaw(np.zeros(3), rng.uniform(-1, 1))[:3, :3]
        end["plate"][:3, 3] = one.object_poses["stove"][:3, 3] + [0.22, 0, 0]
    assert all(outcome.anchor.axes == WORLD for (outcome,) in outcomes(shown, ended, PUSH))


def test_an_object_beside_its_place_misses_the_outcome():
    shown, ended = pushed(5)
    outcome = outcomes(shown, ended, PUSH)[0][0]
    assert outcome.tolerance_m == LEAST_TOLERANCE_M
    layout = {**shown[0].object_poses, **ended[0]}
    for off, is_met in ((0.9, True), (1.1, False)):
        place = se3.from_yaw(ended[0]["plate"][:3, 3] + [off * LEAST_TOLERANCE_M, 0, 0], 0.0)
        assert outcome.is_met({**layout, "plate": place}) is is_met


def test_demonstrations_that_disagree_tell_no_outcome():
    shown, ended = pushed(5, error_m=4 * MOST_SPREAD_M)
    assert outcomes(shown, ended, PUSH) == [()] * 5


def test_an_outcome_that_hardly_any_demonstration_shows_is_not_known():
    shown, ended = pushed(5)
    assert outcomes(shown, [*ended[:2], {}, {}, {}], PUSH) == [()] * 5
    assert [len(one) for one in outcomes(shown, [*ended[:3], {}, {}], PUSH)] == [1, 1, 1, 0, 0]


def test_a_target_that_is_moved_on_has_one_outcome_the_last():
    twice = (*SUB_TASKS, *SUB_TASKS)
    shown = demonstrations(3)
    assert all([one.sub_task for one in found] == [1] for found in outcomes(shown, ends(shown), twice))


@pytest.mark.parametrize(("height", "is_met"), [(-0.05, True), (-0.07, False), (0.01, True), (0.03, False)])
def test_what_is_let_go_may_have_fallen_but_not_risen(height, is_met):
    shown, ended = pushed(5)
    outcome = outcomes(shown, ended, PUSH)[0][0]
    place = se3.from_yaw(ended[0]["plate"][:3, 3] + [0.0, 0.0, height], 0.0)
    assert outcome.is_met({**shown[0].object_poses, "plate": place}) is is_met


def test_a_landmark_that_is_carried_off_later_tells_no_outcome():
    tasks = parse_instruction("put the bowl on the plate and put the plate on the stove")
    layout = {
        name: se3.from_yaw([0.1 * i, 0.0, 0.0], 0.0) for i, name in enumerate(("bowl", "plate", "stove"))
    }
    ended = {"bowl": layout["plate"], "plate": layout["stove"]}
    (found,) = outcomes([Demonstration((), layout)], [ended], tasks)
    assert [outcome.target for outcome in found] == ["plate"]
