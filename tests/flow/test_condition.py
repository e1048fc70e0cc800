from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from tests.geometry.strategies import rotvecs, transforms, vectors

from lerobot_openspm.flow.condition import (
    CONDITION_DIM,
    Query,
    encode,
    progress,
    to_model_frame,
    to_world_frame,
)
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import PHASES


def query(T_world_ee, T_world_target, tau=0.25, closed=1.0, opening=0.5, phase="grasp"):
    return Query(
        T_world_ee, T_world_target, np.asarray(tau), np.asarray(closed), np.asarray(opening),
        np.asarray(PHASES.index(phase)),
    )  # fmt: skip


@given(transforms(), transforms(), transforms())
def test_the_equivariant_condition_does_not_see_where_the_whole_scene_is(G, T_ee, T_target):
    assume(se3.distances(T_target, T_ee)[1] < np.pi - 0.01)  # at half a turn the axis has two signs
    here, moved = query(T_ee, T_target), query(G @ T_ee, G @ T_target)
    assert_allclose(encode(moved, "equivariant"), encode(here, "equivariant"), atol=1e-5)


def test_the_papers_condition_sees_where_the_whole_scene_is():
    T_ee, T_target = se3.from_yaw([0.1, 0, 0.2], 0.1), se3.from_yaw([0.3, 0.2, 0.1], 0.5)
    for G in (se3.from_yaw([0.1, 0, 0], 0.0), se3.from_yaw([0, 0, 0], 0.5)):
        moved = encode(query(G @ T_ee, G @ T_target), "paper")
        assert not np.allclose(moved, encode(query(T_ee, T_target), "paper"))


@given(transforms(), transforms(), vectors(), rotvecs())
def test_an_answer_of_the_equivariant_model_turns_with_the_scene(G, T_target, shift, turn):
    answer = np.concatenate([shift, turn, [1.0]])
    here = to_world_frame(answer, T_target, "equivariant")
    moved = to_world_frame(answer, G @ T_target, "equivariant")
    R = G[:3, :3]
    assert_allclose(moved, np.concatenate([R @ here[:3], R @ here[3:6], [1.0]]), atol=1e-9)


@given(transforms(), transforms(), st.sampled_from(list(CONDITION_DIM)))
def test_executing_a_turned_answer_in_a_turned_scene_leads_to_the_turned_place(G, T_ee, conditioning):
    """The whole loop: what the model answers in its frame moves the hand alike, wherever the scene is."""
    T_target = T_ee @ se3.transform(se3.exp_so3([0.2, 0.1, 0.4]), [0.1, 0.2, 0.3])
    answer = to_model_frame(np.append(se3.increment(T_ee, T_target), 1.0), T_target, "equivariant")
    step = to_world_frame(answer, G @ T_target, "equivariant")[:6]
    assert_allclose(se3.apply_increment(G @ T_ee, step), G @ T_target, atol=1e-7)


@given(transforms(), st.sampled_from(list(CONDITION_DIM)), st.integers(0, 5))
def test_the_two_frames_of_actions_are_inverse(T_target, conditioning, seed):
    actions = np.random.default_rng(seed).normal(size=(5, 7))
    assert_allclose(
        to_world_frame(to_model_frame(actions, T_target, conditioning), T_target, conditioning),
        actions,
        atol=1e-9,
    )
    if conditioning == "paper":
        assert_allclose(to_model_frame(actions, T_target, conditioning), actions, rtol=0)


def test_model_frame_by_hand():
    # The target is turned by 90 degrees about z: the world's x is its -y, the world's y its x.
    T_target = se3.from_yaw([5.0, 6.0, 7.0], np.pi / 2)
    world = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, -1.0]
    model = [2.0, -1.0, 3.0, 0.2, -0.1, 0.3, -1.0]
    assert_allclose(to_model_frame(world, T_target, "equivariant"), model, atol=1e-12)
    assert_allclose(to_world_frame(model, T_target, "equivariant"), world, atol=1e-12)


def test_the_equivariant_condition_by_hand():
    # The hand is 0.1 m in the world's x and 0.3 rad about z from a target that is turned by 90 degrees.
    T_target = se3.from_yaw([1.0, 0.0, 0.0], np.pi / 2)
    T_ee = se3.from_yaw([1.1, 0.0, 0.0], np.pi / 2 + 0.3)
    condition = encode(query(T_ee, T_target, 0.25, 1.0, 0.5, "grasp"), "equivariant")
    p, w = np.array([0.0, -0.1, 0.0]), np.array([0.0, 0.0, 0.3])
    scales = [p / 0.2, w / 1.0, np.tanh(p / 0.03), np.tanh(p / 0.006), np.tanh(w / 0.1)]
    phase = [float(name == "grasp") for name in PHASES]
    assert_allclose(condition, np.concatenate([*scales, [0.25, 1.0, 0.5], phase]), atol=1e-9)


def test_the_papers_condition_by_hand():
    T_target = se3.from_yaw([1.0, 0.0, 0.0], np.pi / 2)
    T_ee = se3.from_yaw([1.1, 0.0, 0.0], np.pi / 2)
    condition = encode(query(T_ee, T_target), "paper")
    assert_allclose(condition[0:9], [5.5, 0, 0, 0, 1, 0, -1, 0, 0], atol=1e-12)  # position / 0.2 m, columns
    assert_allclose(condition[9:18], [5.0, 0, 0, 0, 1, 0, -1, 0, 0], atol=1e-12)
    # From the hand, the target lies towards its +y: (T_ee)^-1 T_target.
    assert_allclose(condition[18:24], [0, 0.5, 0, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("conditioning", CONDITION_DIM)
@pytest.mark.parametrize("batch", [(), (1,), (4,), (2, 3)])
def test_conditions_are_batched(conditioning, batch):
    rng = np.random.default_rng(0)
    T = se3.transform(se3.exp_so3(rng.normal(size=(2, *batch, 3))), rng.normal(size=(2, *batch, 3)))
    numbers = rng.uniform(size=(3, *batch))
    whole = Query(T[0], T[1], *numbers, rng.integers(len(PHASES), size=batch))
    out = encode(whole, conditioning)
    assert out.shape == (*batch, CONDITION_DIM[conditioning])
    for i in np.ndindex(*batch):
        alone = Query(*(np.asarray(getattr(whole, name))[i] for name in Query.__dataclass_fields__))
        assert_allclose(out[i], encode(alone, conditioning))


@pytest.mark.parametrize("conditioning", CONDITION_DIM)
@pytest.mark.parametrize(
    "change", [{"progress": 0.5}, {"closed": 0.0}, {"opening": 0.1}, {"phase": PHASES.index("lift")}]
)
def test_everything_that_is_asked_shows_in_the_condition(conditioning, change):
    asked = query(np.eye(4), se3.from_yaw([0.1, 0, 0], 0.2))
    changed = replace(asked, **{name: np.asarray(value) for name, value in change.items()})
    assert not np.allclose(encode(asked, conditioning), encode(changed, conditioning))


@given(transforms(), transforms(), transforms())
def test_progress_lies_between_zero_and_one(start, here, target):
    assert 0 <= progress(start, here, target) <= 1
    assert progress(start, target, target) == pytest.approx(1, abs=1e-3)
    if se3.distance(start, target) > 2e-3:
        assert progress(start, start, target) == pytest.approx(0, abs=1e-9)


def test_progress_grows_towards_the_target_and_stands_still_in_a_pause():
    start = se3.from_yaw([0, 0, 0], 0.0)
    step = np.array([0.04, 0, 0, 0, 0, 0.1])
    path = np.stack([se3.apply_increment(start, k / 10 * step) for k in [0, 1, 2, 2, 5, 9, 10]])
    assert_allclose(progress(start, path, path[-1]), [0, 0.1, 0.2, 0.2, 0.5, 0.9, 1.0], atol=1e-9)
    assert progress(start, start, start) == 1  # a segment of no length lies behind
