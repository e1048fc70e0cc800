"""Like things in one instruction, and what its parts do to each other, carried out in a world of things."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import HAND, Perception, controller, observe, watch
from tests.memory.builders import entry, hand_pose, key_pose, pick_and_place

from lerobot_openspm.control.state import Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import read_task
from lerobot_openspm.memory.entry import Anchor, Outcome
from lerobot_openspm.types import Hand

# Where `pick_and_place` leaves a thing that stands upright, in the frame of what it is put on.
LEFT_AT = np.array([-0.03, -0.02, 0.02])


def at(x: float, y: float, z: float = 0.0) -> np.ndarray:
    return se3.from_yaw([x, y, z], 0.0)


def put(instruction: str, beside: float = 0.0):
    """A demonstration that puts something so far beside where others do, metres."""
    (sub_task,) = read_task(instruction)
    poses = [
        replace(pose, T_obj_ee=se3.from_yaw([beside, 0.0, 0.0], 0.0) @ pose.T_obj_ee)
        if pose.anchor.place == sub_task.landmark
        else pose
        for pose in pick_and_place(sub_task.target, sub_task.landmark, yaw=0.0)
    ]
    place = LEFT_AT + np.array([beside, 0.0, 0.0])
    outcome = Outcome(0, sub_task.target, Anchor(sub_task.landmark, sub_task.landmark), place, place, 0.02)
    starts = {sub_task.target: at(0.0, 0.2), sub_task.landmark: at(0.1, -0.2)}
    return entry(instruction, poses, starts, outcomes=(outcome,), source=f"local/demos#{beside}{instruction}")


def turned_on(low_m: float = 0.2):
    """A demonstration that turns on the stove, and ends low."""
    T = hand_pose(0.1, 0.0, low_m)
    phases = (("approach", False), ("grasp", True), ("turn", True), ("release", False), ("retreat", False))
    poses = [key_pose("stove", T, phase, closed) for phase, closed in phases]
    return entry("turn on the stove", poses, {"stove": np.eye(4)}, source="local/demos#stove")


class Things(Perception):
    """Sees all things of every name, and what the hand has hold of goes along."""

    def __init__(self, **things):
        self.things = {name: list(T) if isinstance(T, list) else [T] for name, T in things.items()}
        super().__init__({})

    def _estimate(self, name):
        self.object_poses = {name: own[0] for name, own in self.things.items()}
        return replace(super()._estimate(name), others=tuple(self.things.get(name, ())[1:]))

    def carry(self, one, before, after):
        for name in one.scene.tracker.held:
            own, held = self.things[name], one.scene.tracker.poses(before)[name]
            i = int(np.argmin([np.linalg.norm(T[:3, 3] - held[:3, 3]) for T in own]))
            own[i] = after @ se3.inverse(before) @ own[i]


def carried_out(one, things, during=None):
    """The hand goes to every key pose, to the end; `during` gets the number of each part as it begins."""
    hand, part = HAND, 0
    observe(one, hand, things)
    for _ in range(800):
        if one.state.part != part and during is not None:
            during(one.state.part)
        part = one.state.part
        if one.state.status is Status.DONE and one.state.looks_left == 0:
            break
        if (target := one.executor.target) is not None and one.state.status is Status.RUNNING:
            things.carry(one, hand.T_world_ee, target.T_world_ee)
            hand = Hand(target.T_world_ee, target.key_pose.opening)
        watch(one, things, hand, 1)
    return hand


def assert_at(T, x, y):
    assert_allclose(T[:2, 3], [x, y], atol=5e-3)


PLATE = put("put the bowl on the plate")
STOVE = put("put the bowl on the stove")
MUG = put("put the mug on the plate")


@pytest.mark.parametrize("order", [1, -1])
def test_two_places_of_one_name_are_both_right_at_the_end(order: int):
    parts = ["put the bowl on the left plate", "put the mug on the right plate"][::order]
    things = Things(bowl=at(0.2, 0.0), mug=at(-0.2, 0.0), plate=[at(0.0, -0.25), at(0.0, 0.25)])
    one = controller(PLATE, MUG, instruction=" and ".join(parts))
    carried_out(one, things)
    assert (one.state.status, one.state.succeeded, len(one.state.parts)) == (Status.DONE, True, 2)
    assert_at(things.things["bowl"][0], LEFT_AT[0], -0.25 + LEFT_AT[1])
    assert_at(things.things["mug"][0], LEFT_AT[0], 0.25 + LEFT_AT[1])


def test_which_one_is_left_and_which_right_is_settled_before_one_of_them_is_moved():
    """The left bowl becomes the rightmost one, and is named once more after that."""
    plate, stove = at(0.1, 0.25), at(-0.3, -0.2)
    left_then_right = "put the left bowl on the plate, put the right bowl on the stove"
    for instruction, places in (
        (left_then_right, ((0.07, 0.23), (-0.33, -0.22))),
        (f"{left_then_right} and put the left bowl on the stove", ((-0.21, -0.22), (-0.33, -0.22))),
    ):
        things = Things(bowl=[at(0.0, -0.05), at(-0.2, 0.05)], plate=plate, stove=stove)
        beside = put("put the bowl on the stove", 0.12)
        one = controller(PLATE, STOVE, beside, instruction=instruction)
        carried_out(one, things)
        assert (one.state.status, one.state.succeeded) == (Status.DONE, True)
        for T, place in zip(things.things["bowl"], places, strict=True):
            assert_at(T, *place)


def test_both_are_moved_on_once_both_were_put():
    things = Things(bowl=[at(0.0, 0.2), at(-0.2, 0.2)], plate=at(0.1, -0.2), stove=at(-0.3, -0.2))
    memory = PLATE, put("put the bowl on the plate", 0.12), STOVE, put("put the bowl on the stove", 0.12)
    one = controller(*memory, instruction="put both bowls on the plate and put both bowls on the stove")
    carried_out(one, things)
    assert (one.state.status, one.state.succeeded) == (Status.DONE, True)
    assert sorted(round(T[0, 3], 2) for T in things.things["bowl"]) == [-0.33, -0.21]


@pytest.mark.parametrize(
    ("ending", "n_on_stove"), [("put two bowls on the stove", 2), ("put the bowl on the stove", 1)]
)
def test_those_that_nothing_was_done_with_come_first(ending: str, n_on_stove: int):
    bowls = [at(0.0, 0.2), at(-0.2, 0.2), at(0.25, 0.1), at(-0.2, 0.0)][: 2 + n_on_stove]
    things = Things(bowl=bowls, plate=at(0.1, -0.2), stove=at(-0.3, -0.2))
    memory = PLATE, put("put the bowl on the plate", 0.12), STOVE, put("put the bowl on the stove", 0.12)
    one = controller(*memory, instruction=f"put two bowls on the plate and {ending}")
    carried_out(one, things)
    assert (one.state.status, one.state.succeeded) == (Status.DONE, True)
    on_plate = [T for T in things.things["bowl"] if T[0, 3] > 0.05]
    assert len(on_plate) == 2


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
def test_what_somebody_else_moves_meanwhile_is_not_taken_for_it(order: tuple[int, ...]):
    left, middle, right = at(0.05, -0.05), at(-0.1, 0.1), at(0.15, 0.25)
    bowls = [(left, middle, right)[i] for i in order]
    things = Things(bowl=bowls, plate=at(0.1, -0.2), stove=at(-0.3, -0.2))
    said = "put the left bowl on the plate and put the right bowl on the stove"
    one = controller(PLATE, STOVE, instruction=said)

    def aside(part: int) -> None:
        things.things["bowl"][order.index(1)] = at(-0.25, 0.05)

    carried_out(one, things, aside)
    assert (one.state.status, one.state.succeeded) == (Status.DONE, True)
    for which, place in ((0, (0.07, -0.22)), (1, (-0.25, 0.05)), (2, (-0.33, -0.22))):
        assert_at(things.things["bowl"][order.index(which)], *place)


def test_a_place_that_is_named_without_words_first_and_with_words_then_may_be_two():
    class ShownFirst(Things):
        """Others are seen only where words tell them apart."""

        def _estimate(self, name):
            is_told_apart = one.scene.grounding.told_apart & {name}
            estimate = super()._estimate(name)
            return estimate if is_told_apart else replace(estimate, others=())

    things = ShownFirst(bowl=at(0.0, 0.1), mug=at(-0.2, 0.0), plate=[at(0.1, -0.2), at(0.0, 0.28)])
    said = "put the mug on the plate and put the bowl on the right plate"
    one = controller(PLATE, MUG, instruction=said)
    carried_out(one, things)
    assert (one.state.status, len(one.state.parts)) == (Status.DONE, 2)
    assert_at(things.things["mug"][0], 0.07, -0.22)
    assert_at(things.things["bowl"][0], -0.03, 0.26)


def test_the_second_of_both_is_put_back_where_a_later_part_knocked_it_away():
    things = Things(bowl=[at(0.0, 0.2), at(-0.2, 0.2)], plate=at(0.1, -0.2), stove=at(-0.3, -0.2))
    memory = PLATE, put("put the bowl on the plate", 0.12), turned_on()
    one = controller(*memory, instruction="put both bowls on the plate and turn on the stove")

    def knock(part: int) -> None:
        if part == 2:
            things.things["bowl"][1] = at(-0.1, 0.1)

    carried_out(one, things, knock)
    assert (one.state.status, len(one.state.parts)) == (Status.DONE, 4)
    assert sorted(round(T[0, 3], 2) for T in things.things["bowl"]) == [0.07, 0.19]


def test_a_stack_that_was_knocked_over_is_built_again_from_above():
    things = Things(bowl=at(0.0, 0.2), box=at(-0.2, 0.0), plate=at(0.1, -0.2), stove=at(-0.3, -0.2))
    memory = PLATE, put("put the box in the bowl"), turned_on()
    said = "put the bowl on the plate, put the box in the bowl and turn on the stove"
    one, began = controller(*memory, instruction=said), {}

    def knock(part: int) -> None:
        began[part] = one.state.plan.T_world_ee[2, 3]
        if part == 2:
            things.things["bowl"][0], things.things["box"][0] = at(-0.1, -0.3), at(0.0, 0.3)

    carried_out(one, things, knock)
    assert (one.state.status, len(one.state.parts)) == (Status.DONE, 5)
    bowl = things.things["bowl"][0]
    assert_at(bowl, 0.1 + LEFT_AT[0], -0.2 + LEFT_AT[1])
    assert_at(things.things["box"][0], bowl[0, 3] + LEFT_AT[0], bowl[1, 3] + LEFT_AT[1])
    assert began[3] == pytest.approx(HAND.T_world_ee[2, 3], abs=0.03), "what is done once more begins as high"


def test_what_was_demonstrated_in_another_order_is_done_to_what_was_said():
    both = "put the bowl in the basket and put the mug in the basket"
    second = [replace(pose, sub_task=1) for pose in pick_and_place("mug", "basket", 0.0)]
    starts = {"bowl": at(0.0, 0.2), "mug": at(0.1, 0.2), "basket": at(0.1, -0.2)}
    whole = entry(both, [*pick_and_place("bowl", "basket", 0.0), *second], starts)
    parts = ["put the left bowl in the basket", "put the right mug in the basket"]
    for said in (parts, parts[::-1]):
        things = Things(bowl=[at(-0.2, -0.25), at(-0.2, 0.25)], mug=[at(0.2, -0.25), at(0.2, 0.25)],
                        basket=at(0.0, 0.0))  # fmt: skip
        carried_out(controller(whole, instruction=" and ".join(said)), things)
        bowl, mug = things.things["bowl"], things.things["mug"]
        assert_at(bowl[0], *LEFT_AT[:2])
        assert_at(mug[1], *LEFT_AT[:2])
        assert_at(bowl[1], -0.2, 0.25)
        assert_at(mug[0], 0.2, -0.25)


def test_what_is_shut_by_a_push_stays_where_it_stands():
    T = hand_pose(0.2, 0.0, 0.1)
    phases = (("approach", T), ("push", hand_pose(0.05, 0.0, 0.1)), ("retreat", T))
    shut = entry("close the cabinet", [key_pose("cabinet", T, p, p != "approach") for p, T in phases],
                 {"cabinet": np.eye(4)})  # fmt: skip
    things = Things(cabinet=at(0.1, 0.2), box=at(-0.2, 0.0))
    one = controller(shut, put("put the box on the cabinet"),
                     instruction="close the cabinet and put the box on the cabinet")  # fmt: skip
    seen = things._estimate

    def unlike(name):
        # Open, or with the hand before it, it is not recognised.
        is_like = name != "cabinet" or one.state.part == 0 == one.state.index
        return seen(name if is_like else "nothing")

    things._estimate = unlike
    carried_out(one, things)
    assert one.state.status is Status.DONE
    assert_at(things.things["box"][0], 0.1 + LEFT_AT[0], 0.2 + LEFT_AT[1])


def test_what_does_not_shut_is_looked_for_again():
    T = hand_pose(0.2, 0.0, 0.1)
    phases = (("approach", T), ("push", hand_pose(0.05, 0.0, 0.1)), ("retreat", T))
    shut = entry("close the cabinet", [key_pose("cabinet", T, p, p != "approach") for p, T in phases],
                 {"cabinet": np.eye(4)})  # fmt: skip
    things, one = Things(cabinet=at(0.1, 0.2)), controller(shut, instruction="close the cabinet")
    observe(one, HAND, things)
    one.executor.begin(one.executor.targets, HAND, 0)
    hand = Hand(one.executor.targets[0].T_world_ee, 0.0)
    watch(one, things, hand, 2)
    assert one.state.index == 1
    things.things["cabinet"] = [at(0.16, 0.2)]
    for _ in range(400):  # held up on its way
        watch(one, things, hand, 1)
        if one.state.attempts:
            break
    assert (one.state.attempts, one.state.index) == (1, 0)
    assert_at(one.state.plan.object_poses["cabinet"], 0.16, 0.2)
