"""What the hand does where it did not get hold of something, or lost it: not the same again."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import HAND, Perception, controller, observe, planning_context, watch
from tests.control.test_executor import ROBOT, make
from tests.memory.builders import entry

from lerobot_openspm.control.feasibility import Miss, TransferLimits
from lerobot_openspm.control.plan import DEEPER_M, Plan
from lerobot_openspm.control.planning import FEW_POINTS
from lerobot_openspm.control.state import Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.types import Hand, Symmetry


# A bowl that is held near its middle has the fingers furthest from where they were after a quarter.
@pytest.mark.parametrize(
    ("turn", "tracking", "expected"),
    [(0.0, True, 90), (0.0, False, 90), (np.pi / 2, True, 90), (np.pi, True, 0), (None, True, 0)],
)
def test_a_grasp_that_the_hand_is_kept_from_is_tried_again_from_another_side(turn, tracking, expected):
    shown, symmetries = entry(), {} if turn is None else {"bowl": Symmetry(np.zeros(2), turn)}
    perception = Perception(shown.object_poses)
    one = controller(shown, symmetries=symmetries, tracking=tracking)
    observe(one, HAND, perception)
    grasp = next(i for i, target in enumerate(one.executor.targets) if target.key_pose.phase == "grasp")
    before = one.executor.targets[grasp].T_world_ee
    held_up = se3.transform(before[:3, :3], before[:3, 3] + [0.0, 0.0, 0.03])
    one.executor.begin(one.executor.targets, HAND, grasp - 1)
    for _ in range(300):
        watch(one, perception, Hand(held_up, HAND.opening), 1)
        if one.state.attempts:
            break
    assert one.state.attempts == 1
    turned = float(se3.distances(one.executor.targets[grasp].T_world_ee, before)[1])
    assert_allclose(np.rad2deg(turned), expected, atol=1e-4)


def test_what_slipped_out_is_grasped_again_as_it_was_but_deeper():
    shown = entry()
    perception = Perception(shown.object_poses)
    one = controller(shown, symmetries={"bowl": Symmetry(np.zeros(2), 0.0)})
    observe(one, HAND, perception)
    grasp = next(i for i, target in enumerate(one.executor.targets) if target.key_pose.phase == "grasp")
    before = one.executor.targets[grasp].T_world_ee
    one.executor.begin(one.executor.targets, HAND, grasp + 1)
    watch(one, perception, Hand(before, 0.0), 1)
    assert one.state.attempts == 1
    deeper = before @ se3.transform(np.eye(3), [0.0, 0.0, DEEPER_M])
    assert_allclose(one.executor.targets[grasp].T_world_ee, deeper, atol=1e-9)
    as_shown = Plan(shown, shown.object_poses, HAND.T_world_ee)
    lift = as_shown.targets(planning_context())[grasp + 1]
    assert_allclose(one.executor.targets[grasp + 1].T_world_ee, lift.T_world_ee, atol=1e-9)
    # What slips out again is grasped from another side.
    one.executor.begin(one.executor.targets, HAND, grasp + 1)
    watch(one, perception, Hand(before, 0.0), 1)
    assert one.state.attempts == 2
    turned = float(se3.distances(one.executor.targets[grasp].T_world_ee, before)[1])
    assert_allclose(np.rad2deg(turned), 90, atol=1e-4)


def test_nothing_is_grasped_deeper_than_the_hand_may_go_nor_twice():
    plan, context = Plan(entry(), entry().object_poses, HAND.T_world_ee), planning_context()
    lowest = min(target.T_world_ee[2, 3] for target in plan.targets(context))
    low, high = context.robot.workspace
    own = replace(context.robot, workspace=np.array([[*low[:2], lowest], high]))
    tight, wide = (
        replace(context, robot=own, limits=TransferLimits(min_clearance_m=metres))
        for metres in (0.004, 0.012)
    )
    assert plan.deepened(0, tight) is None
    once = plan.deepened(0, wide)
    assert once is not None
    assert once.deeper == {0: DEEPER_M}
    assert once.deepened(0, wide) is None


# The demonstrated opening leaves so much room that the hand may go aside by 2 cm.
@pytest.mark.parametrize(
    ("pushed", "middle", "expected"),
    [
        (0.012, None, 0.02),
        (-0.012, 0.05, -0.02),
        (0.002, None, None),
        (0.002, 0.01, None),
        (0.002, -0.05, -0.02),
    ],
)
def test_a_hand_that_one_finger_keeps_off_goes_a_little_aside_once(pushed, middle, expected):
    context = planning_context()
    if middle is not None:  # of the bowl, that far from the hand along the axis over which the fingers open
        T_ee_bowl = se3.inverse(
            Plan(entry(), entry().object_poses, HAND.T_world_ee).grasp(0, context).T_world_ee
        )
        T_ee_bowl = T_ee_bowl @ entry().object_poses["bowl"]
        (own,) = se3.apply(se3.inverse(T_ee_bowl), np.array([[0.0, middle, T_ee_bowl[2, 3]]]))
        context = planning_context(symmetries={"bowl": Symmetry(own[:2], 0.0)})
    plan = Plan(entry(), entry().object_poses, HAND.T_world_ee)
    aside = plan.dodging(0, pushed, context)
    assert (aside is None) == (expected is None)
    if aside is None:
        return
    before, after = plan.targets(context), aside.targets(context)
    for i, target in enumerate(before):
        y = (se3.inverse(target.T_world_ee) @ after[i].T_world_ee)[1, 3]
        is_aside = target.key_pose.phase in ("approach", "grasp")
        assert y == pytest.approx(expected if is_aside else 0.0, abs=2e-3)
    assert aside.dodging(0, pushed, context) is None
    # Objects that are seen a little elsewhere leave it so. Beside one that is gone, nothing is known.
    for metres, dodges in ((0.01, aside.dodges), (0.1, {})):
        bowl = se3.from_yaw([metres, 0.0, 0.0], 0.0) @ plan.object_poses["bowl"]
        assert aside.following({"bowl": bowl}).dodges == dodges
    # It goes aside from where it was shown, and nowhere else.
    shifted = replace(plan, shifts={0: 0.012}).dodging(0, pushed, context)
    assert shifted is not None
    assert shifted.shifts == {}


@pytest.mark.parametrize("side", [1, -1])
def test_a_hand_that_is_pushed_aside_goes_further_to_that_side_and_then_to_another_one(side):
    shown = entry()
    one = controller(shown, symmetries={"bowl": Symmetry(np.zeros(2), 0.0)})
    perception = Perception(shown.object_poses)
    observe(one, HAND, perception)
    first, ways = grasp_of(one), list[np.ndarray]()
    for attempt in (1, 2):
        before = (
            next(i for i, target in enumerate(one.executor.targets) if target.key_pose.phase == "grasp") - 1
        )
        aside = se3.transform(np.eye(3), [0.0, side * 0.008, -0.03])
        held_off = Hand(one.executor.targets[before].T_world_ee @ aside, HAND.opening)
        one.executor.begin(one.executor.targets, held_off, before)
        for _ in range(300):
            watch(one, perception, held_off, 1)
            if one.state.attempts == attempt:
                break
        assert (one.state.attempts, one.state.status) == (attempt, Status.RUNNING)
        ways.append(se3.inverse(first) @ grasp_of(one))
    assert_allclose(ways[0][:3, 3], [0.0, side * 0.02, 0.0], atol=1e-9)
    assert_allclose(ways[0][:3, :3], np.eye(3), atol=1e-9)
    assert float(se3.distances(ways[1], np.eye(4))[1]) >= np.pi / 3 - 1e-6


def grasp_of(one):
    """Where the hand takes hold, ``T_world_ee`` ``(4, 4)``."""
    return next(target for target in one.executor.targets if target.key_pose.phase == "grasp").T_world_ee


def test_the_opposite_side_of_a_rim_is_reached_without_turning_the_hand_round():
    shown = entry()
    plan = Plan(shown, shown.object_poses, HAND.T_world_ee, shifts={0: 0.01}, dodges={0: 0.02})
    grasp = plan.grasp(0, planning_context()).T_world_ee
    T_bowl_ee = se3.inverse(shown.object_poses["bowl"]) @ grasp
    middle = (T_bowl_ee @ se3.transform(np.eye(3), [0.0, 0.06, 0.0]))[:2, 3]
    context = planning_context(symmetries={"bowl": Symmetry(middle, 0.0)})
    other = context.otherwise(plan, 0)
    step = se3.inverse(grasp) @ other.grasp(0, context).T_world_ee
    assert (other.shifts, other.dodges) == ({}, {})
    # It was 2 cm nearer to the middle than shown, and comes as far beyond it as was shown.
    assert_allclose(step[:2, 3], [0.0, 0.06 + 0.08], atol=1e-6)
    assert float(se3.distances(step, np.eye(4))[1]) < 1e-6


def test_a_hand_keeps_its_depth_while_the_fingers_close_and_not_while_they_open():
    executor = make()
    for phase, share in (("grasp", 1.0), ("release", 0.2)):
        index = next(i for i, one in enumerate(executor.targets) if one.key_pose.phase == phase)
        T = executor.targets[index].T_world_ee
        back = Hand(se3.transform(T[:3, :3], T[:3, 3] - 0.004 * T[:3, 2]), HAND.opening)
        executor.begin(executor.targets, back, index)
        action = executor.next_action(back)
        assert action is not None
        assert float(action[:3] @ T[:3, 2]) * ROBOT.metres_per_action == pytest.approx(share * 0.004)


def test_a_key_pose_that_is_out_of_reach_one_way_round_leaves_the_other(monkeypatch):
    context = planning_context()
    plan = Plan(entry(), entry().object_poses, HAND.T_world_ee)
    half = replace(plan, is_half_turned=True)
    place = next(one for one in plan.targets(context) if one.key_pose.phase == "place")
    miss = Miss(5, place, 0.1, 0.0)
    monkeypatch.setattr(
        Plan, "backing_off", lambda self, context: (self, miss if self.is_half_turned else None)
    )
    monkeypatch.setattr(type(context), "_crowded", lambda self, plans, points: [(one, {}) for one in plans])
    for ways in ([half, plan], [plan, half]):
        found = context._clearest(ways, {})
        assert found is not None
        assert not found[0].is_half_turned
    assert context._clearest([half, half], {}) is None


def test_a_stretched_arm_is_not_led_step_by_step_into_other_things(monkeypatch):
    context = planning_context()
    plan = Plan(entry(), entry().object_poses, HAND.T_world_ee)
    # What reaches further is each time in twice as much of something.
    inside = {i: {"box": points} for i, points in enumerate((0, 10, 20, 40))}
    ways = [replace(plan, turned=float(i)) for i in inside]
    crowded = [(way, inside[round(way.turned)]) for way in ways]
    monkeypatch.setattr(type(context), "_crowded", lambda self, plans, points: crowded)
    monkeypatch.setattr(Plan, "backing_off", lambda self, context: (self, None))
    monkeypatch.setattr(Plan, "reach_left", lambda self, context: 0.005 + 0.01 * self.turned)
    found = context._clearest(ways, {})
    assert found is not None
    assert sum(found[1].values()) <= FEW_POINTS
