"""Where the arm's joints have no room, the hand is led away from its base."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import planning_context
from tests.geometry.test_arm import LIBERO
from tests.memory.builders import hand_pose, robot

from lerobot_openspm.control.feasibility import find_stance
from lerobot_openspm.control.joint_room import ABOVE_M, OUT_M, ROOM_RAD, led_out, ways_out
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import load_arm
from lerobot_openspm.memory.entry import CONTACT_PHASES
from lerobot_openspm.types import Symmetry

HOME = hand_pose(-0.2, 0.0, 1.17)
NEAR, FAR = [-0.41, 0.2, 0.9], [-0.1, 0.1, 0.9]


@pytest.fixture(scope="module")
def panda(request):
    return load_arm(request.config.rootpath / LIBERO)


def planned(panda, bowl, turned=0.0, is_half_turned=False):
    """A context with a Panda, and a plan to carry a bowl from a place to a plate in front of the arm."""
    context = planning_context(symmetries={"bowl": Symmetry(np.zeros(2), np.pi)})
    wide = robot(workspace=np.array([[-2.0, -2.0, 0.0], [2.0, 2.0, 2.0]]), arm=panda)
    context = replace(context, robot=wide)
    poses = {"bowl": se3.from_yaw(bowl, -0.3 + turned), "plate": se3.from_yaw([-0.05, -0.1, 0.9], -0.3)}
    plan = Plan(context.entries[0], poses, HOME, turned=turned, is_half_turned=is_half_turned)
    return context, replace(plan, stance=find_stance(context.robot, HOME))


def room(panda, T_world_ee, start):
    angles = panda.onwards(T_world_ee, start, start)
    assert_allclose(panda.miss(T_world_ee, angles), 0.0, atol=1e-3)
    return panda.room(angles)


@pytest.mark.parametrize(("turned", "is_half_turned"), [(0.0, False), (np.pi, False), (np.pi, True)])
def test_close_to_the_base_the_hand_passes_by_further_out(panda, turned, is_half_turned):
    context, plan = planned(panda, NEAR, turned, is_half_turned)
    before = plan.targets(context)
    out = ways_out(before[: len(plan.entry.key_poses)], panda, plan.stance)
    assert out
    led = replace(plan, entry=led_out(plan.entry, before, out))
    after = iter(led.targets(context))
    for i, target in enumerate(before):
        T, here = target.T_world_ee, next(after)
        if i - 1 in out and i not in out and target.key_pose.phase == "approach":
            # From further out it goes to above what it takes hold of, and straight down.
            assert not here.precise
            assert_allclose(here.T_world_ee[:3, 3] - T[:3, 3], [0.0, 0.0, ABOVE_M], atol=1e-9)
            here = next(after)
        assert_allclose(here.T_world_ee[:3, 3] - T[:3, 3], out.get(i, np.zeros(3)), atol=1e-9)
        assert_allclose(here.T_world_ee[:3, :3], T[:3, :3], atol=1e-9)
        assert here.precise == target.precise
        if i in out:
            assert target.key_pose.phase not in CONTACT_PHASES
            assert room(panda, T, plan.stance) < ROOM_RAD
            assert room(panda, here.T_world_ee, plan.stance) >= ROOM_RAD - 0.01
            ahead = (T[:3, 3] - panda.base)[:2]
            assert out[i][:2] @ ahead == pytest.approx(np.linalg.norm(out[i]) * np.linalg.norm(ahead))
            assert np.linalg.norm(out[i]) <= max(OUT_M) + 1e-9
    assert next(after, None) is None


def test_where_the_joints_have_room_nothing_changes(panda):
    context, plan = planned(panda, FAR)
    assert ways_out(plan.targets(context), panda, plan.stance) == {}
    assert context.clear(plan) is plan


def test_a_plan_is_led_out_where_the_arm_is_known(panda):
    context, plan = planned(panda, NEAR)
    key_poses = context.clear(plan).entry.key_poses
    assert len(key_poses) > len(plan.entry.key_poses)
    assert context.clear(replace(plan, stance=None)).entry.key_poses == plan.entry.key_poses


def test_where_no_place_further_out_has_room_the_hand_goes_as_it_was_shown(panda):
    *joints, last = panda.joints
    stiff = replace(panda, joints=(*joints, replace(last, limits=last.limits * 0.0 + [0.6, 1.0])))
    context, plan = planned(stiff, NEAR)
    assert plan.stance is not None
    assert ways_out(plan.targets(context), stiff, plan.stance) == {}


def test_a_way_out_that_cannot_be_followed_is_not_taken_and_that_is_said(panda, caplog, monkeypatch):
    context, plan = planned(panda, NEAR)
    monkeypatch.setattr("lerobot_openspm.control.feasibility.MAX_JUMP_M", 0.01)
    assert context.clear(plan) is plan
    assert "a joint comes near its limit on the way to approach at bowl" in caplog.text
