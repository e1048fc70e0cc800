"""What is not done is taken up again where it can be mended."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import HAND, Perception, controller, observe, watch
from tests.memory.builders import entry, hand_pose, key_pose, pick_and_place

from lerobot_openspm.control.executor import MAX_ATTEMPTS
from lerobot_openspm.control.scene import GIVE_UP_S
from lerobot_openspm.control.state import Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import Anchor, Axis, Outcome
from lerobot_openspm.types import Detections, Fault, Hand

OPEN = "open the top drawer"
CABINET = {"cabinet": se3.from_yaw([0.1, 0.0, 0.0], 0.5)}
KINDS = {
    "slide": Axis("slide", np.array([1.0, 0.0, 0.0]), 0.15),
    "turn": Axis("turn", np.array([0, 0, 1.0]), 1.5),
}


def handle(axis):
    """A handle that is taken, led along its axis, and let go."""
    T = hand_pose(0.1, 0.0, 0.1)
    end = axis.follow(T)
    poses = [
        key_pose("cabinet", hand_pose(0.1, 0.0, 0.2), "approach"),
        key_pose("cabinet", T, "approach"),
        key_pose("cabinet", T, "grasp", closed=True),
        key_pose("cabinet", end, "open" if axis.kind == "slide" else "turn", closed=True, axis=axis),
        key_pose("cabinet", end, "release"),
    ]
    return entry(OPEN, poses, CABINET)


@pytest.mark.parametrize("axis", KINDS.values(), ids=list(KINDS))
def test_travel_is_the_inverse_of_following(axis):
    start = hand_pose(0.1, 0.2, 0.3, 0.4)
    assert_allclose(axis.travel(start, axis.follow(start)), axis.amount, atol=1e-9)


@pytest.mark.parametrize("axis", KINDS.values(), ids=list(KINDS))
def test_a_handle_that_slipped_out_is_taken_again_where_it_is_now_for_the_rest_of_its_way(axis):
    perception, one = Perception(CABINET), controller(handle(axis), instruction=OPEN)
    observe(one, HAND, perception)
    shown = [target.T_world_ee for target in one.executor.targets]
    here = Hand(shown[2], 0.03)
    one.executor.begin(one.executor.targets, here, 3)
    world_axis = one.executor.targets[3].axis
    way = Axis(axis.kind, world_axis.direction, 0.4 * axis.amount)
    watch(one, perception, Hand(way.follow(shown[2]), 0.03), 1)
    assert one.state.index == 3
    watch(one, perception, Hand(axis.follow(shown[2]), 0.0), 1)  # the fingers have closed
    assert one.state.index == 0
    for index in (0, 1, 2):
        assert_allclose(one.executor.targets[index].T_world_ee, way.follow(shown[index]), atol=1e-9)
    again = Hand(one.executor.targets[2].T_world_ee, 0.03)
    one.executor.begin(one.executor.targets, again, 3)
    assert_allclose(one.executor.targets[3].T_world_ee, shown[3], atol=1e-9)


def test_a_handle_that_went_back_when_it_slipped_out_is_looked_for_nearer_to_where_it_was():
    axis = KINDS["slide"]
    perception, one = Perception(CABINET), controller(handle(axis), instruction=OPEN)
    observe(one, HAND, perception)
    shown = [target.T_world_ee for target in one.executor.targets]
    one.executor.begin(one.executor.targets, Hand(shown[2], 0.03), 3)
    way = Axis(axis.kind, one.executor.targets[3].axis.direction, 0.4 * axis.amount)
    watch(one, perception, Hand(way.follow(shown[2]), 0.03), 1)
    watch(one, perception, Hand(way.follow(shown[2]), 0.0), 1)
    for share in (0.2, 0.1):  # it is not where it slipped out
        there = one.executor.targets[2].T_world_ee
        one.executor.begin(one.executor.targets, Hand(there, 0.0), 3)
        watch(one, perception, Hand(there, 0.0), 1)
        nearer = Axis(axis.kind, way.direction, share * axis.amount)
        assert_allclose(one.executor.targets[2].T_world_ee, nearer.follow(shown[2]), atol=1e-9)


@pytest.mark.parametrize("share", [0.93, 0.97, 1.1])
def test_a_handle_that_slipped_out_near_the_end_and_went_back_is_not_looked_for_further_out(share):
    axis = KINDS["slide"]
    perception, one = Perception(CABINET), controller(handle(axis), instruction=OPEN)
    observe(one, HAND, perception)
    shown = [target.T_world_ee for target in one.executor.targets]
    one.executor.begin(one.executor.targets, Hand(shown[2], 0.03), 3)
    direction = one.executor.targets[3].axis.direction

    def pulled(metres):
        return Axis("slide", direction, metres).follow(shown[2])

    watch(one, perception, Hand(pulled(share * axis.amount), 0.03), 1)
    watch(one, perception, Hand(pulled(share * axis.amount), 0.0), 1)
    slipped = np.linalg.norm(one.executor.targets[2].T_world_ee[:3, 3] - shown[2][:3, 3])
    assert slipped < axis.amount
    there = one.executor.targets[2].T_world_ee
    one.executor.begin(one.executor.targets, Hand(there, 0.0), 3)
    drifted = there.copy()
    drifted[:3, 3] += 0.003 * (there[:3, 3] - shown[2][:3, 3]) / slipped  # the hand never stands quite still
    watch(one, perception, Hand(drifted, 0.0), 1)
    assert_allclose(one.executor.targets[2].T_world_ee, pulled(0.5 * slipped), atol=1e-9)


def test_a_handle_that_does_not_move_on_in_the_fingers_is_taken_again_where_it_is():
    axis = KINDS["slide"]
    perception, one = Perception(CABINET), controller(handle(axis), instruction=OPEN)
    observe(one, HAND, perception)
    shown = [target.T_world_ee for target in one.executor.targets]
    one.executor.begin(one.executor.targets, Hand(shown[2], 0.03), 3)
    way = Axis(axis.kind, one.executor.targets[3].axis.direction, 0.4 * axis.amount)
    watch(one, perception, Hand(way.follow(shown[2]), 0.03), 1)
    watch(one, perception, Hand(way.follow(shown[2]), 0.0), 1)
    held = Hand(one.executor.targets[2].T_world_ee, 0.03)
    one.executor.begin(one.executor.targets, held, 3)
    for _ in range(200):
        watch(one, perception, held, 1)
        if one.state.attempts == 2:
            break
    assert one.state.attempts == 2
    assert_allclose(one.executor.targets[2].T_world_ee, way.follow(shown[2]), atol=1e-9)


def test_a_drawer_that_does_not_open_is_named_with_the_hand_at_rest():
    perception, one = Perception(CABINET), controller(handle(KINDS["slide"]), instruction=OPEN)
    observe(one, HAND, perception)
    for _ in range(1000):
        target = one.executor.present  # the hand goes wherever it should but along with the handle
        is_pulling = target.axis is not None
        T = one.executor.approach.start if is_pulling else target.T_world_ee
        watch(one, perception, Hand(T, max(target.key_pose.opening, 0.03)), 1)
        if one.state.status is Status.NO_PROGRESS:
            break
    assert one.state.refusal.startswith("the top drawer of the cabinet does not open: it stays ")
    assert one.executor.next_action(HAND)[:6].tolist() == [0.0] * 6


def stuck(one, perception, hand, index):
    """The hand, held up short of a key pose until it is given up."""
    one.executor.begin(one.executor.targets, hand, index)
    for _ in range(200):
        watch(one, perception, hand, 1)
        if one.state.attempts:
            return
    pytest.fail("it was not given up")


def carrying(opening):
    """The bowl is in the hand, and its place is not reached."""
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, 2)
    grasp = one.executor.targets[2]
    watch(one, perception, Hand(grasp.T_world_ee, grasp.key_pose.opening), grasp.key_pose.n_steps + 1)
    assert one.scene.tracker.held == {"bowl"}
    perception.visible = 0.0
    place = one.executor.targets[5].T_world_ee.copy()
    place[:3, 3] += [0.03, 0.0, 0.02]  # beside it too, so that it is not let go there
    stuck(one, perception, Hand(place, opening), 5)
    return one


def test_what_is_still_in_the_hand_is_not_fetched_again_but_set_down_once_more():
    one = carrying(opening=0.03)
    assert one.state.status is Status.RUNNING
    assert one.executor.targets[one.state.index].key_pose.phase == "pre-place"
    assert one.scene.tracker.held == {"bowl"}


def test_what_is_no_more_in_the_hand_is_fetched():
    one = carrying(opening=0.0)
    assert one.executor.targets[one.state.index].key_pose.phase == "approach"
    assert one.scene.tracker.held == frozenset()


def test_what_slipped_out_while_it_was_lifted_stands_where_it_stood_and_does_not_hang_in_the_air():
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    first = one.executor.targets[0].T_world_ee
    one.executor.begin(one.executor.targets, HAND, 2)
    grasp, lift = one.executor.targets[2], one.executor.targets[3]
    watch(one, perception, Hand(grasp.T_world_ee, grasp.key_pose.opening), grasp.key_pose.n_steps + 1)
    assert one.scene.tracker.held == {"bowl"}
    perception.visible = 0.0  # the hand hides it
    watch(one, perception, Hand(lift.T_world_ee, 0.0), 1)
    assert one.state.index == 0
    assert_allclose(one.executor.targets[0].T_world_ee, first, atol=1e-6)


def test_what_a_later_sub_task_grasps_again_stays_in_the_hand():
    both = "put the bowl on the plate and put the bowl on the stove"
    again = [replace(pose, sub_task=1) for pose in pick_and_place("bowl", "stove")]
    object_poses = {**entry().object_poses, "stove": se3.from_yaw([-0.2, -0.1, 0.0], 0.0)}
    perception = Perception(object_poses)
    one = controller(entry(both, (*pick_and_place(), *again), object_poses), instruction=both)
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, 2)
    grasp, lift = one.executor.targets[2], one.executor.targets[3]
    watch(one, perception, Hand(grasp.T_world_ee, 0.03), grasp.key_pose.n_steps + 1)
    perception.object_poses["bowl"] = lift.T_world_ee @ se3.inverse(grasp.T_world_ee) @ object_poses["bowl"]
    watch(one, perception, Hand(lift.T_world_ee, 0.03), 1)
    assert one.executor.targets[one.state.index].key_pose.phase == "pre-place"
    perception.object_poses["plate"] = object_poses["plate"] @ se3.from_yaw([0.05, 0.05, 0.0], 0.0)
    watch(one, perception, Hand(lift.T_world_ee, 0.03), 15)
    assert one.state.attempts == 0
    assert one.scene.tracker.held == {"bowl"}


ON_PLATE = Outcome(0, "bowl", Anchor("plate", "plate"), np.zeros(3), np.zeros(3), 0.02)


def ended(at, look=None):
    """A bowl that was let go at a place relative to the plate, the hand gone, and looks from then on."""
    place = entry().object_poses["plate"] @ se3.from_yaw([*at], 0.0)
    perception, one = Perception(entry().object_poses), controller(entry(outcomes=(ON_PLATE,)))
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, 7)
    perception.object_poses["bowl"] = place
    watch(one, look or perception, Hand(one.executor.targets[7].T_world_ee, 0.08), 12)
    return one, place


def test_what_fell_beside_its_place_is_fetched_from_where_it_lies():
    one, place = ended([0.06, 0.0, 0.0])
    assert one.state.status is Status.RUNNING
    assert one.state.attempts == 1
    assert one.state.index == 0
    assert_allclose(one.executor.targets[0].T_world_ee, place @ entry().key_poses[0].T_obj_ee, atol=1e-9)
    assert one.state.succeeded is None, "it is not over"


def test_what_lies_in_its_place_is_left_alone():
    one, _ = ended([0.01, 0.0, -0.03])
    assert one.state.status is Status.DONE
    assert one.state.succeeded is True


@pytest.mark.parametrize("seconds", [0.1, GIVE_UP_S])
@pytest.mark.parametrize("off_m", [0.0, 0.06])
def test_without_a_picture_what_was_done_is_neither_seen_nor_tried_again(off_m, seconds):
    one, _ = ended([off_m, 0.0, 0.0], lambda *_: Detections({}, {"front": Fault("black", seconds)}))
    assert one.state.status is Status.DONE
    assert one.state.attempts == 0
    assert one.state.succeeded is None


def test_what_was_put_down_is_seen_to_be_there_before_the_rest_is_done():
    object_poses = {**entry().object_poses, **CABINET}
    both = "put the bowl on the plate and open the top drawer"
    memory = entry(outcomes=(ON_PLATE,)), handle(KINDS["slide"])
    perception, one = Perception(object_poses), controller(*memory, instruction=both)
    observe(one, HAND, perception)
    assert {target.key_pose.anchor.place for target in one.executor.targets} == {"bowl", "plate"}
    for off_m, part, attempts in ((0.06, 0, 1), (0.0, 1, 0)):
        last = len(one.executor.targets) - 1
        one.executor.begin(one.executor.targets, HAND, last)
        perception.object_poses["bowl"] = object_poses["plate"] @ se3.from_yaw([off_m, 0.0, 0.0], 0.0)
        watch(one, perception, Hand(one.executor.targets[last].T_world_ee, 0.08), 12)
        assert (one.state.part, one.state.attempts) == (part, attempts)
        assert one.state.index == 0
    assert one.state.verdicts == (True,)
    ((attempts, seconds),) = one.state.spent
    assert attempts == 1
    assert 0 < seconds < one.scene.time_s
    assert {target.key_pose.anchor.place for target in one.executor.targets} == {"cabinet"}


def finish(one, perception, at):
    """The hand at the end of the present part, the bowl so far beside the plate's middle."""
    last = len(one.executor.targets) - 1
    one.executor.begin(one.executor.targets, HAND, last)
    perception.object_poses["bowl"] = perception.object_poses["plate"] @ se3.from_yaw([at, 0.0, 0.0], 0.0)
    watch(one, perception, Hand(one.executor.targets[last].T_world_ee, 0.08), 12)


def test_what_a_later_part_knocked_away_is_put_back():
    both = "put the bowl on the plate and open the top drawer"
    memory = entry(outcomes=(ON_PLATE,)), handle(KINDS["slide"])
    perception, one = Perception({**entry().object_poses, **CABINET}), controller(*memory, instruction=both)
    observe(one, HAND, perception)
    finish(one, perception, 0.0)
    assert (one.state.part, one.state.verdicts) == (1, (True,))
    finish(one, perception, 0.3)
    assert (one.state.part, one.state.status, one.state.index) == (
        1,
        Status.RUNNING,
        len(one.executor.targets) - 1,
    )
    assert one.executor.present.T_world_ee[2, 3] == HAND.T_world_ee[2, 3], "first the hand rises"
    finish(one, perception, 0.3)
    assert (one.state.part, one.state.status, one.state.succeeded) == (2, Status.RUNNING, None)
    assert {target.key_pose.anchor.place for target in one.executor.targets} == {"bowl", "plate"}
    bowl = perception.object_poses["bowl"]
    assert_allclose(one.executor.targets[0].T_world_ee, bowl @ entry().key_poses[0].T_obj_ee, atol=1e-9)
    finish(one, perception, 0.0)
    assert (one.state.status, one.state.succeeded) == (Status.DONE, True)
    assert len(one.state.used) == len(one.state.parts) == 3


def test_of_two_things_that_knock_each_other_away_each_is_put_back_once():
    on_stove = replace(ON_PLATE, target="box", anchor=Anchor("stove", "stove"))
    object_poses = {**entry().object_poses, **CABINET}
    object_poses |= {name: se3.from_yaw([x, -0.1, 0.0], 0.0) for name, x in (("box", 0.1), ("stove", -0.2))}
    put = "put the box on the stove"
    memory = (
        entry(outcomes=(ON_PLATE,)),
        entry(put, pick_and_place("box", "stove"), object_poses, outcomes=(on_stove,)),
        handle(KINDS["slide"]),
    )
    asked = f"put the bowl on the plate, {put} and open the top drawer"
    perception, one = Perception(object_poses), controller(*memory, instruction=asked)
    observe(one, HAND, perception)
    plate, stove = object_poses["plate"], object_poses["stove"]
    away = se3.from_yaw([0.3, 0.0, 0.0], 0.0)
    for bowl, box, part in (
        (plate, object_poses["box"], 1),
        (plate, stove, 2),
        (plate @ away, stove, 2),  # the hand rises
        (plate @ away, stove, 3),
        (plate, stove @ away, 3),
        (plate, stove @ away, 4),
        (plate @ away, stove, 4),
    ):
        last = len(one.executor.targets) - 1
        one.executor.begin(one.executor.targets, HAND, last)
        perception.object_poses |= {"bowl": bowl, "box": box}
        watch(one, perception, Hand(one.executor.targets[last].T_world_ee, 0.08), 12)
        assert one.state.part == part
    assert (one.state.status, one.state.succeeded) == (Status.DONE, False)


def test_what_a_later_part_moves_on_is_not_put_back():
    both = "put the bowl on the plate and put the bowl on the stove"
    object_poses = {**entry().object_poses, "stove": se3.from_yaw([-0.2, -0.1, 0.0], 0.0)}
    memory = (
        entry(outcomes=(ON_PLATE,)),
        entry("put the bowl on the stove", pick_and_place("bowl", "stove"), object_poses),
    )
    perception, one = Perception(object_poses), controller(*memory, instruction=both)
    observe(one, HAND, perception)
    finish(one, perception, 0.0)
    finish(one, perception, 0.3)
    assert (one.state.part, one.state.status) == (1, Status.DONE)


def test_what_does_not_stay_where_it_is_put_is_named_at_last():
    perception, one = Perception(entry().object_poses), controller(entry(outcomes=(ON_PLATE,)))
    observe(one, HAND, perception)
    for _ in range(MAX_ATTEMPTS + 1):
        assert one.state.status is Status.RUNNING
        finish(one, perception, 0.06)
    assert (one.state.status, one.state.succeeded) == (Status.NO_PROGRESS, False)
    assert one.state.refusal == "the bowl is not where it should be"


def test_an_outcome_that_no_key_pose_leads_to_is_not_tried_again():
    object_poses = entry().object_poses
    memory = entry("put both bowls on the plate", pick_and_place(), object_poses,
                   outcomes=(replace(ON_PLATE, sub_task=1),))  # fmt: skip
    assert len(memory.key.sub_tasks) == 2
    perception, one = Perception(object_poses), controller(memory, instruction="put both bowls on the plate")
    observe(one, HAND, perception)
    one.executor.begin(one.executor.targets, HAND, 7)
    perception.object_poses["bowl"] = object_poses["plate"] @ se3.from_yaw([0.06, 0.0, 0.0], 0.0)
    watch(one, perception, Hand(one.executor.targets[7].T_world_ee, 0.08), 12)
    assert one.state.status is Status.DONE
    assert one.state.attempts == 0
    assert one.state.succeeded is None


def test_of_a_whole_of_which_a_part_was_not_seen_nothing_is_said():
    one, _ = ended([0.01, 0.0, 0.0])
    one.state.verdicts = (None,)
    assert one.state.succeeded is None


def test_an_episode_that_is_given_up_has_failed():
    one = carrying(opening=0.0)
    one.executor.stop(Status.NO_PROGRESS)
    assert one.state.succeeded is False


def test_a_handle_that_went_all_the_way_is_a_success_if_the_fingers_could_feel_it():
    for opening, expected in ((0.03, True), (0.001, None)):
        poses = [replace(pose, opening=opening) for pose in handle(KINDS["slide"]).key_poses]
        perception, one = Perception(CABINET), controller(entry(OPEN, poses, CABINET), instruction=OPEN)
        observe(one, HAND, perception)
        last = len(one.executor.targets) - 1
        one.executor.begin(one.executor.targets, HAND, last)
        watch(one, perception, Hand(one.executor.targets[last].T_world_ee, 0.08), 12)
        assert one.state.status is Status.DONE
        assert one.state.succeeded is expected
