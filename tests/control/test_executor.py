from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from tests.memory.builders import OPEN_WIDTH, entry, hand_pose, key_pose, robot

from lerobot_openspm.control import executor as executing
from lerobot_openspm.control.executor import BLOCKED_CORRECTIONS, Executor
from lerobot_openspm.control.state import EpisodeState, Status
from lerobot_openspm.control.strategies import CORRECTION_STEPS, RESIDUAL_M, RESIDUAL_RAD, Approach
from lerobot_openspm.control.transfer import SHUT_M, transfer
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.geometry import se3
from lerobot_openspm.types import Hand

HOME = hand_pose(0.0, 0.0, 0.3)
ROBOT = robot()
GAINS = np.array([ROBOT.metres_per_action] * 3 + [ROBOT.radians_per_action] * 3)
CHUNK = 5


def toward(query, share=0.4):
    """A stand-in for the flow model: part of the way to the target each step, as far as actions of 1 go."""
    T, chunk = query.T_world_ee, []
    for _ in range(CHUNK):
        step = np.clip(share * se3.increment(T, query.T_world_target) / GAINS, -1, 1)
        T = se3.apply_increment(T, step * GAINS)
        chunk.append(np.append(step, ROBOT.command(bool(query.closed))))
    return np.array(chunk)


class World:
    """A hand that does what it is told, and fingers that stop at what they hold."""

    def __init__(self, T=HOME, held=0.03, gain=1.0, stuck=None):
        self.T, self.opening, self.held, self.gain, self.stuck = T, OPEN_WIDTH, held, gain, stuck
        self.step_count = 0

    @property
    def hand(self):
        return Hand(self.T, self.opening)

    def step(self, action):
        moved = se3.apply_increment(self.T, action[:6] * GAINS * self.gain)
        if self.stuck is None or not self.stuck(moved):
            self.T = moved
        self.opening = self.held if action[6] > 0 else OPEN_WIDTH
        self.step_count += 1


def make(execution="closed_loop_trc", key_poses=None, hand=HOME):
    memory = entry(key_poses=key_poses)
    executor = Executor(execution, ROBOT, EpisodeState())
    executor.begin(transfer(memory, memory.object_poses, {}, hand), Hand(hand, OPEN_WIDTH))
    return executor


def run(executor, world, n_steps=600, until=lambda _: False, flow=toward):
    """Act until done; returns, by key pose, the hand at the moment it was left, and the retries asked for."""
    left, retries, steps_at = {}, 0, {}
    for _ in range(n_steps):
        index = executor.state.index
        again = executor.advance(world.hand)
        for passed in range(index, executor.state.index):
            left[passed] = world.T
        if again:
            retries += 1
            executor.begin(executor.targets, world.hand, executor.contact_index(world.hand))
        if executor.state.status is not Status.RUNNING or until(executor):
            if executor.state.status is Status.DONE:
                left[executor.state.index] = world.T
            break
        action = executor.next_action(world.hand)
        if action is None:
            executor.push_chunk(flow(executor.query(world.hand)))
            action = executor.next_action(world.hand)
        steps_at[executor.state.index] = steps_at.get(executor.state.index, 0) + 1
        world.step(action)
    return left, retries, steps_at


def test_the_closed_loop_meets_every_key_pose_as_exactly_as_it_must():
    executor, world = make(), World()
    left, retries, _ = run(executor, world)
    assert executor.state.status is Status.DONE
    assert retries == 0
    assert sorted(left) == list(range(8))
    for i, target in enumerate(executor.targets):
        metres, radians = se3.distances(left[i], target.T_world_ee)
        if target.key_pose.dwell:
            continue
        limits = (RESIDUAL_M, RESIDUAL_RAD) if target.precise else (target.passing_m, target.passing_rad)
        assert metres <= limits[0]
        assert radians <= limits[1]


def test_waiting_for_the_fingers_takes_the_demonstrated_steps():
    executor, world = make(), World()
    _, _, steps_at = run(executor, world)
    for i, target in enumerate(executor.targets):
        if target.key_pose.dwell:
            assert steps_at[i] == target.key_pose.n_steps


def test_via_points_are_passed_without_stopping_short():
    loose, world = make(), World()
    wide = [replace(one, passing_m=0.05, passing_rad=1.0) for one in loose.targets]
    loose.begin(wide, Hand(HOME, OPEN_WIDTH))
    loose_left, _, _ = run(loose, world)
    metres, _ = se3.distances(loose_left[0], loose.targets[0].T_world_ee)
    assert make().targets[0].passing_m < metres <= 0.05


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_key_pose_is_met_in_angle_too(sign):
    T = hand_pose(0, 0, 0.3, sign * 0.5)
    executor = make(key_poses=[key_pose("bowl", np.eye(4), "place")])
    executor.begin([replace(executor.targets[0], T_world_ee=T)], Hand(HOME, OPEN_WIDTH))
    executor.advance(Hand(HOME, OPEN_WIDTH))
    assert executor.state.status is Status.RUNNING
    executor.advance(Hand(hand_pose(0, 0, 0.3, sign * (0.5 - 0.059)), OPEN_WIDTH))
    assert executor.state.status is Status.DONE


def test_time_runs_out_in_the_closed_loop():
    executor = make("closed_loop")
    world = World(stuck=lambda T: True)
    _, retries, steps_at = run(executor, world)
    assert executor.state.status is Status.DONE
    assert retries == 0
    length = float(se3.distance(HOME, executor.targets[0].T_world_ee))
    assert steps_at[0] == max(10, int(np.ceil(length / ROBOT.metres_per_step)))


def test_residual_correction_reaches_what_time_alone_does_not():
    slow = 0.5
    without = make("closed_loop")
    left_without, _, _ = run(without, World(gain=slow))
    corrected = make()
    left_with, retries, _ = run(corrected, World(gain=slow))
    assert corrected.state.status is Status.DONE
    assert retries == 0
    error = lambda left, executor: float(se3.distances(left[1], executor.targets[1].T_world_ee)[0])  # noqa: E731
    assert error(left_with, corrected) <= RESIDUAL_M < error(left_without, without)


def test_a_correction_contracts_the_error_whatever_the_flow_model_says():
    executor, world = make(), World()
    still = lambda query: np.zeros((CHUNK, 7))  # noqa: E731
    start = float(se3.distance(HOME, executor.targets[0].T_world_ee))
    left, retries, _ = run(executor, world, flow=still)
    assert executor.state.status is Status.DONE
    assert retries == 0
    assert float(se3.distances(left[0], executor.targets[0].T_world_ee)[0]) <= 0.015 < start


@given(st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6))
def test_a_corrective_action_points_straight_at_the_key_pose_and_is_bounded(offset):
    executor = make(key_poses=[key_pose("bowl", np.eye(4), "place")])
    T = se3.apply_increment(executor.targets[0].T_world_ee, np.array(offset))
    action = executor.strategy.toward(executor.targets[0], T)
    residual = se3.increment(T, executor.targets[0].T_world_ee) / GAINS
    assert np.abs(action[:6]).max() <= 1 + 1e-12
    assert float(action[:6] @ residual) >= 0
    assert_allclose(np.outer(action[:6], residual), np.outer(residual, action[:6]), atol=1e-6)


def blocked_at_the_bowl(executor):
    height = executor.targets[1].T_world_ee[2, 3]
    return lambda T: bool(T[2, 3] < height + 0.02)


def test_what_cannot_be_met_is_corrected_then_tried_again_then_given_up(monkeypatch):
    monkeypatch.setattr(executing, "MAX_CORRECTIONS", 3)
    monkeypatch.setattr(executing, "MAX_ATTEMPTS", 2)
    executor = make()
    world = World(stuck=blocked_at_the_bowl(executor))
    _, retries, _ = run(executor, world, 2000)
    assert executor.state.status is Status.NO_PROGRESS
    assert executor.state.refusal.startswith("the hand does not get to the bowl: it stays ")
    assert retries == 2
    assert executor.state.attempts == 2
    assert executor.next_action(world.hand)[:6].tolist() == [0.0] * 6


def test_corrections_are_counted_once_time_is_up_and_forgotten_at_the_next_key_pose(monkeypatch):
    monkeypatch.setattr(executing, "MAX_CORRECTIONS", 3)
    executor = make()
    world = World(stuck=blocked_at_the_bowl(executor))
    run(executor, world, until=lambda e: e.state.index == 1)
    assert executor.approach.corrections == 0
    run(executor, world, until=lambda e: e.approach.corrections == 3)
    assert executor.state.index == 1
    assert executor.state.attempts == 0
    # One more chunk makes it four, more than the three that are allowed.
    run(executor, world, until=lambda e: e.state.attempts == 1)
    assert executor.state.index == 0
    assert executor.approach.corrections == 0


def test_a_via_point_that_is_blocked_is_left_behind():
    executor = make()
    high = executor.targets[0].T_world_ee[2, 3]
    world = World(stuck=lambda T: bool(T[2, 3] < high + 0.03) and world.step_count < 200)
    _, retries, _ = run(executor, world, until=lambda e: e.state.index == 1)
    assert executor.state.index == 1
    assert retries == 0
    assert executor.state.status is Status.RUNNING


def test_a_hand_that_cannot_get_away_has_done_its_part():
    executor = make()
    last = replace(executor.targets[-1], T_world_ee=hand_pose(0, 0, 0.4), precise=False)
    executor.begin([last], Hand(HOME, OPEN_WIDTH))
    _, retries, _ = run(executor, World(stuck=lambda T: True))
    assert (executor.state.status, retries) == (Status.DONE, 0)


def test_a_hand_that_swings_about_a_key_pose_is_not_blocked():
    executor = make(key_poses=[key_pose("bowl", np.eye(4), "grasp")])
    T = executor.targets[0].T_world_ee
    for swing_m, is_blocked in ((0.008, False), (0.0, True)):
        approach = Approach(HOME)
        for side in (1, -1, 1, -1):
            off = T @ se3.transform(np.eye(3), np.array([0.0, 0.008 + side * swing_m, 0.0]))
            for _ in range(CORRECTION_STEPS):
                executor.strategy.direct(executor.targets[0], approach, Hand(off, OPEN_WIDTH))
        assert approach.is_blocked == is_blocked


def test_a_retry_begins_on_the_approach_of_the_same_contact_where_the_hand_is_nearest():
    second = [key_pose("plate", hand_pose(x, 0, z), "approach") for x, z in ((0.3, 0.4), (0, 0.2), (0, 0.12))]
    second.append(key_pose("plate", hand_pose(0, 0, 0.1), "grasp", closed=True))
    second.append(key_pose("plate", hand_pose(0, 0, 0.2), "place", closed=True))
    executor = make(key_poses=[*entry().key_poses, *second])
    far, above, at = (Hand(executor.targets[i].T_world_ee, OPEN_WIDTH) for i in (8, 9, 11))
    for index in range(13):
        executor.begin(executor.targets, Hand(HOME, OPEN_WIDTH), index)
        found = [executor.contact_index(hand) for hand in (far, above, at)]
        if index < 8:
            assert set(found) <= {0, 1}
        elif index < 10:  # it has not got to the grasp yet
            assert found == [8, 8, 8]
        else:  # the last key pose of the approach leaves no room to come down
            assert found == [8, 9, 9]


def test_a_retry_of_a_push_begins_at_its_first_approach():
    poses = [key_pose("bowl", hand_pose(-0.1 * i, 0, 0.2 - 0.05 * i), "approach") for i in range(3)]
    executor = make(key_poses=[*poses, key_pose("bowl", hand_pose(0.2, 0, 0.1), "push")])
    executor.begin(executor.targets, Hand(HOME, OPEN_WIDTH), 3)
    assert executor.contact_index(Hand(executor.targets[2].T_world_ee, 0.0)) == 0


def test_a_hand_that_something_keeps_from_going_down_to_a_grasp_does_not_push_on():
    executor, corrections = make(), list[int]()
    world = World(stuck=blocked_at_the_bowl(executor))
    run(executor, world, until=lambda e: corrections.append(e.approach.corrections) or e.state.attempts == 1)
    assert executor.state.attempts == 1
    assert max(corrections) <= BLOCKED_CORRECTIONS + 1 < executing.MAX_CORRECTIONS


def test_the_open_loop_never_looks_at_the_hand():
    seen = []
    for world in (World(), World(stuck=lambda T: True), World(gain=0.3, held=0.0)):
        executor, queries = make("open_loop"), []

        def flow(query, queries=queries):
            queries.append(query)
            return toward(query)

        run(executor, world, flow=flow)
        assert executor.state.status is Status.DONE
        seen.append(np.stack([query.T_world_ee for query in queries]))
    assert_allclose(seen[1], seen[0])
    assert_allclose(seen[2], seen[0])
    assert_allclose(seen[0][0], HOME)


def test_closed_loop_queries_start_from_the_hand():
    executor = make()
    elsewhere = Hand(hand_pose(0.1, 0.1, 0.2, 0.4), OPEN_WIDTH / 2)
    query = executor.query(elsewhere)
    assert_allclose(query.T_world_ee, elsewhere.T_world_ee)
    assert_allclose(query.T_world_target, executor.targets[0].T_world_ee)
    assert query.opening == pytest.approx(0.5)
    assert query.closed == 0
    assert executor.state.replans == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_actions_never_reach_the_robot(value):
    executor = make("closed_loop")
    chunk = np.zeros((CHUNK, 7))
    chunk[3, 2] = value
    with pytest.raises(OpenSPMError, match="not finite"):
        executor.push_chunk(chunk)
    assert executor.next_action(Hand(HOME, OPEN_WIDTH)) is None


def test_actions_left_over_are_dropped_at_the_next_key_pose():
    executor = make("closed_loop")
    executor.push_chunk(np.ones((CHUNK, 7)))
    executor.next_action(Hand(HOME, OPEN_WIDTH))
    executor.advance(Hand(executor.targets[0].T_world_ee, OPEN_WIDTH))
    assert executor.state.index == 1
    assert executor.next_action(Hand(HOME, OPEN_WIDTH)) is None


def test_holding_still_keeps_the_fingers_as_they_are():
    executor = Executor("closed_loop_trc", ROBOT, EpisodeState())
    assert executor.hold().tolist() == [0] * 6 + [ROBOT.open_command]
    assert executor.next_action(Hand(HOME, OPEN_WIDTH)).tolist() == [0] * 6 + [ROBOT.open_command]
    carrying = make()
    carrying.begin(carrying.targets, Hand(HOME, 0.03), 4)
    assert carrying.hold().tolist() == [0] * 6 + [ROBOT.close_command]
    done = make(key_poses=[key_pose("bowl", HOME, "lift", closed=True)])
    done.advance(Hand(done.targets[0].T_world_ee, 0.03))
    assert done.state.status is Status.DONE
    assert done.next_action(Hand(HOME, OPEN_WIDTH)).tolist() == [0] * 6 + [ROBOT.close_command]


@pytest.mark.parametrize(("gap", "retries_wanted"), [(0.008, 0), (0.03, 1)])
def test_what_is_in_the_way_counts_as_met_when_the_key_pose_is_near(gap, retries_wanted):
    """Something solid holds the hand up above the place: within three tolerances it has arrived."""
    executor = make()
    floor = executor.targets[1].T_world_ee[2, 3] + gap
    world = World(stuck=lambda T: T[2, 3] < floor and executor.state.index <= 1)
    _, retries, _ = run(executor, world, n_steps=150, until=lambda e: e.state.index > 1)
    assert (executor.state.index > 1) == (retries_wanted == 0)
    assert (retries > 0) == (retries_wanted > 0)


def test_a_correction_that_gets_nowhere_pushes_harder():
    executor = make()
    world = World(stuck=blocked_at_the_bowl(executor))
    run(executor, world, until=lambda e: e.state.index == 1)
    pushes = {}
    while executor.approach.corrections < 6 and executor.state.attempts == 0:
        action = executor.next_action(world.hand)
        if action is None:
            executor.push_chunk(toward(executor.query(world.hand)))
            continue
        if executor.approach.corrections:
            pushes.setdefault(executor.approach.corrections, float(np.abs(action[:3]).max()))
        world.step(action)
        executor.advance(world.hand)
    values = [pushes[i] for i in sorted(pushes)]
    assert len(values) >= 4
    assert values == sorted(values)
    assert values[3] > 2 * values[0] or values[3] == pytest.approx(1.0)


def closing():
    """A drawer of the box that is pushed shut by 15 cm along x; the hand, where it begins to push."""
    poses = [
        key_pose("cabinet", hand_pose(-0.1, 0.0, 0.1), "approach", closed=True),
        key_pose("cabinet", hand_pose(0.05, 0.0, 0.1), "push", closed=True),
        key_pose("cabinet", hand_pose(0.0, 0.0, 0.2), "retreat", closed=True),
    ]
    memory = entry("close the top drawer of the cabinet", poses, {"cabinet": np.eye(4)})
    return transfer(memory, memory.object_poses, {}, HOME)


def test_what_is_closed_is_pushed_until_it_stops_the_hand_a_little_further_than_was_shown():
    targets = closing()
    assert_allclose(targets[1].T_world_ee[:3, 3], [0.05 + SHUT_M, 0.0, 0.1], atol=1e-9)
    assert [target.until_stopped for target in targets[:3]] == [False, True, False]
    executor = Executor("closed_loop_trc", ROBOT, EpisodeState())
    executor.begin(targets, Hand(HOME, OPEN_WIDTH))
    shut = 0.05 - 0.012  # short of where it was shown
    left, retries, _ = run(executor, World(held=0.0, stuck=lambda T: bool(T[0, 3] > shut and T[2, 3] < 0.12)))
    assert executor.state.status is Status.DONE
    assert retries == 0
    assert left[1][0, 3] > shut - 0.01


def test_what_stops_a_closing_hand_half_way_is_no_end_of_the_way():
    """A bowl that stands too high jams the drawer 8 cm before it is shut."""
    executor = Executor("closed_loop_trc", ROBOT, EpisodeState())
    executor.begin(closing(), Hand(HOME, OPEN_WIDTH))
    jammed = 0.05 - 0.08
    run(executor, World(held=0.0, stuck=lambda T: bool(T[0, 3] > jammed and T[2, 3] < 0.12)), n_steps=600)
    assert executor.state.index == 1
    assert executor.state.status is Status.NO_PROGRESS
    assert " does not close: it stays " in executor.state.refusal
