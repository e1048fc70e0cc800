"""Where the arm's joints have no room, the hand is led away from its base."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import planning_context
from tests.geometry.test_arm import LIBERO
from tests.memory.builders import hand_pose, key_pose, robot

from lerobot_openspm.control.feasibility import find_stance
from lerobot_openspm.control.joint_room import OUT_M, ROOM_RAD, ways_out
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.strategies import CORRECTION_STEPS, OUTWARD_STEPS, Approach, ClosedLoopTRC
from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import load_arm
from lerobot_openspm.memory.entry import Axis
from lerobot_openspm.types import Hand, Symmetry

HOME = hand_pose(-0.2, 0.0, 1.17)
NEAR, FAR = [-0.41, 0.2, 0.9], [-0.1, 0.1, 0.9]


@pytest.fixture(scope="module")
def panda(request):
    return load_arm(request.config.rootpath / LIBERO)


def planned(panda, bowl, plate=FAR, turned=0.0, is_half_turned=False):
    """A context with a Panda, and a plan to carry a bowl from a place to a plate."""
    context = planning_context(symmetries={"bowl": Symmetry(np.zeros(2), np.pi / 2)})
    wide = robot(workspace=np.array([[-2.0, -2.0, 0.0], [2.0, 2.0, 2.0]]), arm=panda)
    context = replace(context, robot=wide)
    yaw = -0.3 - turned - np.pi * is_half_turned  # so that the hand is turned as it is at home
    poses = {"bowl": se3.from_yaw(bowl, yaw), "plate": se3.from_yaw(plate, yaw)}
    plan = Plan(context.entries[0], poses, HOME, turned=turned, is_half_turned=is_half_turned)
    return context, replace(plan, stance=find_stance(context.robot, HOME))


def room(panda, T_world_ee, start):
    angles = panda.onwards(T_world_ee, start, start)
    assert_allclose(panda.miss(T_world_ee, angles), 0.0, atol=1e-3)
    return panda.room(angles)


@pytest.mark.parametrize(("turned", "is_half_turned"), [(0.0, False), (np.pi, False), (0.0, True)])
def test_close_to_the_base_the_hand_rises_further_out_with_what_it_has_grasped(panda, turned, is_half_turned):
    context, plan = planned(panda, NEAR, FAR, turned, is_half_turned)
    led = context.clear(plan)
    assert led.out
    for i, (here, was) in enumerate(zip(led.targets(context), plan.targets(context), strict=True)):
        away = here.T_world_ee[:3, 3] - was.T_world_ee[:3, 3]
        assert_allclose(away, led.out.get(i, np.zeros(3)), atol=1e-9)
        assert_allclose(here.T_world_ee[:3, :3], was.T_world_ee[:3, :3], atol=1e-9)
        if i in led.out:
            assert here.key_pose.phase == "lift"
            assert room(panda, was.T_world_ee, plan.stance) < ROOM_RAD
            assert room(panda, here.T_world_ee, plan.stance) >= ROOM_RAD - 0.01
            ahead = (was.T_world_ee[:3, 3] - panda.base)[:2]
            assert away[:2] @ ahead == pytest.approx(np.linalg.norm(away) * np.linalg.norm(ahead))
            assert np.linalg.norm(away) <= max(OUT_M) + 1e-9


def test_where_it_arrives_close_to_the_base_the_hand_goes_as_it_was_shown(panda):
    context, plan = planned(panda, FAR, NEAR)
    rooms = [room(panda, one.T_world_ee, plan.stance) for one in plan.targets(context)]
    assert min(rooms) < ROOM_RAD
    assert context.clear(plan) is plan


def test_where_the_joints_have_room_or_are_not_known_nothing_changes(panda):
    context, plan = planned(panda, FAR)
    assert context.clear(plan) is plan
    context, plan = planned(panda, NEAR)
    unknown = replace(plan, stance=None)
    assert context.clear(unknown) is unknown


def test_a_grasp_from_another_side_is_led_out_anew(panda):
    context, plan = planned(panda, NEAR)
    led = context.clear(plan)
    other = context.otherwise(replace(led, shifts={0: 0.012}), 0)
    assert other.shifts == {}
    assert other.turned != led.turned
    assert other.out
    straight = replace(other, out={}).targets(context)
    for i, by in other.out.items():
        T = straight[i].T_world_ee
        ahead = (T[:3, 3] - panda.base)[:2]
        assert by[:2] @ ahead == pytest.approx(np.linalg.norm(by) * np.linalg.norm(ahead))
        assert room(panda, T, other.stance) < ROOM_RAD


def test_a_plan_is_led_out_anew_where_its_objects_have_moved(panda):
    context, plan = planned(panda, NEAR)
    led = context.clear(plan)
    away, problems = context.following(led, {"bowl": se3.from_yaw(FAR, -0.3)})
    assert (bool(led.out), away.out, problems) == (True, {}, [])
    back, problems = context.following(away, {"bowl": led.object_poses["bowl"]})
    assert (back.out.keys(), problems) == (led.out.keys(), [])
    for i, by in back.out.items():
        assert_allclose(by, led.out[i])


def test_a_grasp_that_was_turned_is_tried_as_it_was_shown(panda):
    context, plan = planned(panda, NEAR)
    for turned in (0.0, np.pi):
        ways = [(way.turned, way.put) for way in replace(plan, turned=turned).turns(context)]
        assert len(ways) == len(set(ways))
        assert ways[0] == (turned, "turned")
        assert {(0.0, "turned"), (np.pi, "turned"), (np.pi, "as_shown")} <= set(ways)


def test_where_no_place_further_out_has_room_the_hand_goes_as_it_was_shown(panda):
    *joints, last = panda.joints
    stiff = replace(panda, joints=(*joints, replace(last, limits=np.array([0.6, 1.0]))))
    context, plan = planned(stiff, NEAR)
    assert plan.stance is not None
    assert ways_out(plan.targets(context), stiff, plan.stance) == {}


def test_a_way_out_that_cannot_be_followed_is_not_taken_and_that_is_said(panda, caplog, monkeypatch):
    context, plan = planned(panda, NEAR)
    monkeypatch.setattr(Plan, "followed", lambda self, context: (self, ["too far"] if self.out else []))
    assert context.clear(plan) is plan
    assert "a joint comes near its limit as the hand rises: led further out, too far" in caplog.text


@pytest.mark.parametrize(
    ("phase", "hand_m", "target_m", "above_m", "is_known", "is_pushed"),
    [
        ("place", 0.72, 0.695, 0.0, True, True),
        ("pre-place", 0.72, 0.695, 0.02, True, True),
        ("place", 0.72, 0.711, 0.0, True, False),  # it touches something, near enough
        ("place", 0.72, 0.695, 0.05, True, False),  # it is held up from below
        ("place", 0.72, 0.74, 0.0, True, False),  # that only presses it against what is in its way
        ("place", 0.56, 0.535, 0.0, True, False),  # its elbow is far from turned over
        ("place", 0.72, 0.695, 0.0, False, False),
        ("push", 0.72, 0.695, 0.0, True, False),
        ("open", 0.72, 0.695, 0.0, True, False),
    ],
)
def test_a_stretched_arm_that_does_not_come_in_is_pushed_outwards_once(
    panda, phase, hand_m, target_m, above_m, is_known, is_pushed
):
    ahead = np.array([0.8, -0.6, 0.0])
    at = panda.base + hand_m * ahead, panda.base + target_m * ahead
    here, there = (hand_pose(x, y, z) for (x, y, _), z in zip(at, (1.34 + above_m, 1.34), strict=True))
    strategy = ClosedLoopTRC(robot(arm=panda if is_known else None))
    axis = Axis("slide", ahead, 0.1) if phase == "open" else None
    target = Target(there, key_pose("plate", np.eye(4), phase, closed=True), precise=True, axis=axis)
    approach, pushes, blocked = Approach(here), list[int](), list[bool]()
    for step in range(5 * CORRECTION_STEPS + OUTWARD_STEPS):
        action = strategy.direct(target, approach, Hand(here, 0.03))
        assert action is not None
        if action[2] == 1.0:
            assert_allclose(action[:2], [1.0, -0.75])
            pushes.append(step)
        assert_allclose(action[6], strategy.toward(target, here)[6])
        blocked.append(approach.is_blocked)
    n = OUTWARD_STEPS if is_pushed else 0
    assert pushes == list(range(CORRECTION_STEPS, CORRECTION_STEPS + n))
    # While it is pushed it is not given up; afterwards it is, if that did not help.
    assert not any(blocked[: CORRECTION_STEPS + n])
    assert blocked[-1]
    assert approach.corrections == (4 if is_pushed else 8), "they begin anew"
