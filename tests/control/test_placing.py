"""Putting things onto landmarks that are turned, and hands that go the other way round."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.memory.builders import entry, hand_pose, key_pose, robot

from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.control.transfer import HALF_TURN, transfer, turn_about
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import WORLD, Anchor, Outcome
from lerobot_openspm.memory.retrieval import Scored
from lerobot_openspm.types import Symmetry

HOME = hand_pose(0.0, 0.0, 0.3)
SHOWN = {"bowl": se3.from_yaw([0.2, 0.1, 0.0], 0.0), "plate": se3.from_yaw([0.0, -0.2, 0.0], 0.0)}
# The bowl is taken by its rim, at 5 cm beside its middle, and belongs 3 cm behind the landmark's middle.
BESIDE, BEHIND = np.array([0.0, 0.05, 0.03]), np.array([-0.03, 0.0, 0.0])


def placed(with_outcome=True, middle=(0.0, 0.0), axes=WORLD):
    key_poses = (
        key_pose("bowl", hand_pose(*BESIDE), "grasp", closed=True),
        key_pose("plate", hand_pose(*(BESIDE + BEHIND)), "place", closed=True, axes=axes),
    )
    ends = BEHIND + np.array([*middle, 0.0])
    outcome = Outcome(0, "bowl", Anchor("plate", "plate"), ends, ends, 0.02, middle)
    return entry(key_poses=key_poses, object_poses=SHOWN, outcomes=(outcome,) if with_outcome else ())


@pytest.mark.parametrize("yaw", [0.0, 1.0, np.pi])
def test_what_is_carried_ends_on_the_same_side_of_a_landmark_however_it_is_turned(yaw):
    now = SHOWN | {"plate": se3.from_yaw([0.1, -0.1, 0.0], yaw)}
    grasp, place = transfer(placed(), now, {"bowl": 0.0}, HOME)[:2]
    T_ee_bowl = se3.inverse(grasp.T_world_ee) @ now["bowl"]
    ends = (place.T_world_ee @ T_ee_bowl)[:3, 3]
    assert_allclose(ends, se3.apply(now["plate"], BEHIND[None])[0], atol=1e-9)
    # The hand keeps its direction in the world.
    assert_allclose(place.T_world_ee[:3, :3], grasp.T_world_ee[:3, :3], atol=1e-9)


@pytest.mark.parametrize("put", ["turned", "as_shown", "kept"])
@pytest.mark.parametrize("landmark_yaw", [0.0, 1.0])
@pytest.mark.parametrize("yaw", [0.0, 1.0, 2.5])
def test_a_round_thing_is_where_it_should_be_however_it_and_its_place_are_turned(yaw, landmark_yaw, put):
    middle = (0.0, 0.08)  # its frame lies at its rim
    round_bowl = {"bowl": Symmetry(np.array(middle), 0.0)}
    context = PlanningContext((), {"bowl": 2 * np.pi, "plate": 2 * np.pi}, robot(), symmetries=round_bowl)
    now = {
        "bowl": SHOWN["bowl"] @ turn_about(np.array(middle), yaw),
        "plate": se3.from_yaw([0.1, -0.1, 0.0], landmark_yaw),
    }
    for axes in (WORLD, "plate"):
        plan = Plan(placed(middle=middle, axes=axes), now, HOME, turned=0.5, put=put)
        grasp, place = plan.targets(context)[:2]
        ended = now | {"bowl": place.T_world_ee @ se3.inverse(grasp.T_world_ee) @ now["bowl"]}
        (outcome,) = plan.entry.outcomes
        assert_allclose(outcome.target_at(ended), outcome.place(now), atol=1e-9)
        assert outcome.is_met(plan.as_if_in_place(ended, round_bowl))
        beside = ended | {"bowl": se3.from_yaw([0.03, 0.0, 0.0], 0.0) @ ended["bowl"]}
        assert not outcome.is_met(plan.as_if_in_place(beside, round_bowl))


def test_where_it_ends_is_not_known_the_key_pose_stands_as_it_is():
    now = SHOWN | {"plate": se3.from_yaw([0.1, -0.1, 0.0], np.pi)}
    place = transfer(placed(with_outcome=False), now, {"bowl": 0.0}, HOME)[1]
    assert_allclose(place.T_world_ee[:3, 3], now["plate"][:3, 3] + BESIDE + BEHIND, atol=1e-9)


@pytest.mark.parametrize(("yaw", "is_half_turned"), [(0.5, False), (3.1, True)])
def test_a_hand_that_cannot_turn_so_far_goes_the_other_way_round(yaw, is_half_turned):
    context = PlanningContext((), {"bowl": 2 * np.pi, "plate": 2 * np.pi}, robot())
    memory, now = entry(), SHOWN | {"bowl": se3.from_yaw([0.2, 0.1, 0.0], yaw)}
    now["plate"] = se3.from_yaw([0.0, -0.2, 0.0], yaw)
    plan, problems = context.choose([Scored(memory, 1.0, 1.0, 1.0, 1.0)], now, HOME)
    assert plan.is_half_turned is is_half_turned
    assert not problems
    assert not plan.followed(context)[1]
    usual = Plan(memory, now, HOME).targets(context)
    turn = HALF_TURN if is_half_turned else np.eye(4)
    for target, other in zip(plan.targets(context), usual, strict=True):
        assert_allclose(target.T_world_ee, other.T_world_ee @ turn, atol=1e-9)
