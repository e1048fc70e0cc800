"""Instructions of which only the parts were demonstrated, carried out one after another."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.control.acting import (
    HAND,
    LOOK_AGAIN_STEPS,
    Perception,
    observe,
    planning_context,
    shifted,
    watch,
)
from tests.memory.builders import OPEN_WIDTH, entry, hand_pose, key_pose
from tests.memory.test_compound import BOX as BOX_IN_DRAWER
from tests.memory.test_compound import drawer_entry

from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.control.state import Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import Anchor
from lerobot_openspm.types import Hand

PLATE = entry("put the bowl on the plate", source="local/demos#0")
BOX = entry("put the box in the bowl", source="local/demos#1")
BOTH = "put the bowl on the plate and put the box in the bowl"
LAYOUT = {
    "bowl": se3.from_yaw([0.0, 0.2, 0.0], 0.0),
    "plate": se3.from_yaw([0.1, -0.2, 0.0], 0.0),
    "box": se3.from_yaw([-0.2, 0.0, 0.0], 0.0),
}


def opening(instruction="open the top drawer", thing="cabinet", phase="open"):
    T = hand_pose(0.1, 0.0, 0.1)
    phases = (("approach", False), ("grasp", True), (phase, True), ("release", False), ("retreat", False))
    poses = [key_pose(thing, T, phase, closed) for phase, closed in phases]
    return entry(instruction, poses, {thing: np.eye(4)}, source="local/demos#2")


def controller(*entries, instruction=BOTH, **options):
    return EpisodeController(planning_context(*entries, **options), instruction, 7, 0)


def finish_part(one, perception, hand=None):
    """Bring the hand to every key pose of the present part in turn, and what it carries along with it."""
    part = one.state.part
    for _ in range(400):
        if one.state.status is not Status.RUNNING or one.state.part != part:
            return hand
        target = one.executor.target
        before = hand
        hand = Hand(target.T_world_ee, target.key_pose.opening)
        for name in one.scene.tracker.held:
            perception.object_poses[name] = (
                hand.T_world_ee @ se3.inverse(before.T_world_ee) @ perception.object_poses[name]
            )
        watch(one, perception, hand, 1)
    pytest.fail(f"the part did not end: {one.state.status} at key pose {one.state.index}")


def test_the_second_part_goes_where_the_first_one_has_put_things():
    perception, one = Perception(LAYOUT), controller(PLATE, BOX)
    observe(one, HAND, perception)
    assert one.state.used == ((PLATE,),)
    assert sorted(perception.asked[0]) == ["bowl", "box", "plate"], "what comes later is looked for at once"
    hand = finish_part(one, perception, HAND)
    assert one.state.status is Status.RUNNING
    assert one.state.part == 1
    assert not np.allclose(perception.object_poses["bowl"], LAYOUT["bowl"])
    place = next(target for target in one.executor.targets if target.key_pose.phase == "place")
    assert_allclose(place.T_world_ee, perception.object_poses["bowl"] @ place.key_pose.T_obj_ee, atol=2e-3)
    assert [used.source for (used,) in one.state.used] == [PLATE.source, BOX.source]
    finish_part(one, perception, hand)
    assert one.state.status is Status.DONE


def test_what_is_not_recognised_any_more_is_where_the_hand_let_it_go():
    perception, one = Perception(LAYOUT), controller(PLATE, BOX)
    observe(one, HAND, perception)

    class Blind(Perception):
        """Recognises nothing where it was not at first."""

        def _estimate(self, name):
            is_there = name in LAYOUT and np.allclose(self.object_poses[name], LAYOUT[name])
            return super()._estimate(name if is_there else "nothing")

    blind = Blind(LAYOUT)
    hand = finish_part(one, blind, HAND)
    assert one.state.part == 1
    assert_allclose(one.state.plan.object_poses["bowl"], blind.object_poses["bowl"], atol=1e-9)
    assert not np.allclose(one.state.plan.object_poses["bowl"], LAYOUT["bowl"])
    index = next(i for i, pose in enumerate(one.executor.targets) if pose.key_pose.anchor.place == "bowl")
    one.executor.begin(one.executor.targets, hand, index)  # the box in the hand, on its way
    watch(one, blind, hand, 100)  # five seconds in which it is in sight and not recognised
    assert one.state.status is not Status.OBJECT_LOST
    assert_allclose(one.state.plan.object_poses["bowl"], blind.object_poses["bowl"], atol=1e-9)


def test_a_part_ends_as_high_as_the_episode_began_but_the_last_one_does_not():
    perception, one = Perception(LAYOUT), controller(PLATE, BOX)
    observe(one, HAND, perception)
    last, before = one.executor.targets[-1], one.executor.targets[-2]
    assert_allclose(last.T_world_ee[:3, 3], [*before.T_world_ee[:2, 3], HAND.T_world_ee[2, 3]])
    assert_allclose(last.T_world_ee[:3, :3], before.T_world_ee[:3, :3])
    assert len(one.executor.targets) == len(PLATE.key_poses) + 1
    finish_part(one, perception, HAND)
    assert len(one.executor.targets) == len(BOX.key_poses)
    low, one = Hand(hand_pose(0, 0, 0.1), HAND.opening), controller(PLATE, BOX)
    observe(one, low, Perception(LAYOUT))
    assert len(one.executor.targets) == len(PLATE.key_poses), "it began lower than it ends"


def test_another_object_of_the_same_name_is_not_taken_to_be_where_the_first_one_was():
    asked = "put the left bowl on the plate and put the right bowl on the plate"
    perception, one = Perception(LAYOUT), controller(PLATE, instruction=asked)
    observe(one, HAND, perception)
    del perception.object_poses["bowl"]
    one.scene.tracker.release(one.scene.tracker.held, HAND.T_world_ee)
    one.executor.begin(one.executor.targets, HAND, len(one.executor.targets) - 1)
    watch(one, perception, Hand(one.executor.targets[-1].T_world_ee, HAND.opening), 12)
    assert one.state.part == 1
    assert one.state.status is Status.OBJECT_NOT_FOUND


def test_the_second_of_two_like_things_is_looked_for_after_the_first_was_opened():
    poses = [replace(pose, anchor=Anchor("box", "box")) for pose in opening().key_poses]
    memory = entry("open the box", poses, {"box": np.eye(4)})
    perception = Perception({"box": se3.from_yaw([0.2, 0.1, 0.0], 0.0)})
    one = controller(memory, instruction="open the left box then open the right box")
    observe(one, HAND, perception)
    last = len(one.executor.targets) - 1
    one.executor.begin(one.executor.targets, HAND, 1)
    for index in range(1, last + 1):
        target = one.executor.targets[index]
        hand = Hand(target.T_world_ee, target.key_pose.opening)
        one.executor.begin(one.executor.targets, hand, index)
        watch(one, perception, hand, target.key_pose.n_steps + 2)
    assert one.state.part == 1
    assert "box" in perception.asked[-1]
    assert one.state.status is Status.RUNNING


def test_the_whole_is_preferred_where_it_was_demonstrated():
    whole = entry(BOTH, PLATE.key_poses, LAYOUT, source="local/demos#9")
    one = controller(PLATE, BOX, whole)
    observe(one, HAND, Perception(LAYOUT))
    assert one.state.used == ((whole,),)
    assert len(one.executor.targets) == len(whole.key_poses)


def test_a_part_of_an_entry_is_used_in_the_name_of_the_entry():
    both = "open the top drawer and put the bowl inside"
    whole = entry(both, opening().key_poses, {"cabinet": np.eye(4), "bowl": LAYOUT["bowl"]})
    one = controller(whole, instruction="open the top drawer")
    observe(one, HAND, Perception({"cabinet": LAYOUT["plate"]}))
    assert one.state.status is Status.RUNNING
    assert one.state.ranked[0].entry.language == "open the top drawer of the cabinet"
    assert len(one.state.used) == 1
    assert one.state.used[0] == (whole,)


def test_an_opened_drawer_looks_different_and_is_not_looked_for_again():
    cabinet = se3.from_yaw([0.2, 0.2, 0.0], 0.3)
    perception = Perception({**LAYOUT, "cabinet": cabinet})
    one = controller(opening(), entry("put the bowl on the cabinet"),
              instruction="open the top drawer and put the bowl on the cabinet")  # fmt: skip
    observe(one, HAND, perception)
    hand = finish_part(one, perception, HAND)
    assert one.state.part == 1
    perception.asked.clear()
    perception.object_poses["cabinet"] = shifted(cabinet, 0.08)  # what its looks seem to say now
    finish_part(one, perception, hand)
    assert one.state.status is Status.DONE
    assert not any("cabinet" in names for names in perception.asked)
    place = next(target for target in one.executor.targets if target.key_pose.phase == "place")
    assert_allclose(place.T_world_ee, cabinet @ place.key_pose.T_obj_ee)


@pytest.mark.parametrize(
    ("instruction", "n_parts"),
    [
        ("put the bowl in the top drawer, close the top drawer and put the box in the top drawer", 5),
        ("close the top drawer, open the top drawer and close the top drawer", 3),
        ("put the bowl on the plate, put the bowl on the box and put the bowl on the plate", 3),
    ],
)
def test_what_was_done_already_is_done_to_the_same_thing_again(instruction: str, n_parts: int):
    perception = Perception({**LAYOUT, "cabinet": se3.from_yaw([0.2, 0.2, 0.0], 0.3)})
    closing, on_box = opening("close the top drawer of the cabinet"), entry("put the bowl on the box")
    known = drawer_entry(), BOX_IN_DRAWER, closing, PLATE, on_box
    one, hand = controller(*known, instruction=instruction), HAND
    observe(one, HAND, perception)
    assert len(one.state.parts) == n_parts
    for _ in range(n_parts):
        hand = finish_part(one, perception, hand)
    assert one.state.status is Status.DONE, one.state.refusal


def test_both_of_two_are_put_one_after_the_other():
    class TwoBowls(Perception):
        """Sees another bowl too."""

        other = se3.from_yaw([-0.2, -0.2, 0.0], 0.0)

        def _estimate(self, name):
            estimate = super()._estimate(name)
            return replace(estimate, others=(self.other,)) if name == "bowl" else estimate

    beside = entry(
        "put the bowl on the plate",
        [
            replace(pose, T_obj_ee=shifted(pose.T_obj_ee, 0.1)) if pose.anchor.place == "plate" else pose
            for pose in PLATE.key_poses
        ],
        source="local/demos#3",
    )
    perception, one = TwoBowls(LAYOUT), controller(PLATE, beside, instruction="put both bowls on the plate")
    observe(one, HAND, perception)
    hand = finish_part(one, perception, HAND)
    put, left = perception.object_poses["bowl"], perception.other
    perception.object_poses["bowl"], perception.other = left, put
    watch(one, perception, hand, LOOK_AGAIN_STEPS)
    assert one.state.part == 1
    assert_allclose(one.state.plan.object_poses["bowl"], left, atol=1e-6)
    finish_part(one, perception, hand)
    assert one.state.status is Status.DONE


def test_what_an_opened_drawer_hides_is_not_lost():
    perception = Perception({**LAYOUT, "cabinet": se3.from_yaw([0.2, 0.2, 0.0], 0.3)})
    one = controller(opening(), PLATE, instruction="open the top drawer and put the bowl on the plate")
    observe(one, HAND, perception)
    del perception.object_poses["bowl"]  # it should be in sight, and is not recognised
    finish_part(one, perception, HAND)
    assert one.state.part == 1
    away = Hand(hand_pose(-0.4, -0.4, 0.5), HAND.opening)
    watch(one, perception, away, 100)
    assert one.state.status is Status.RUNNING
    assert one.state.status is not Status.PAUSED
    perception.object_poses["bowl"] = LAYOUT["bowl"]
    watch(one, perception, away, 12)
    del perception.object_poses["bowl"]
    watch(one, perception, away, 100)
    assert one.state.status is Status.OBJECT_LOST, "it was seen since, so it is gone now"


@pytest.mark.parametrize(
    ("instruction", "thing", "phase"),
    [("close the top drawer", "cabinet", "open"), ("turn on the stove", "stove", "turn")],
)
def test_what_closes_or_turns_hides_nothing(instruction: str, thing: str, phase: str):
    perception = Perception({**LAYOUT, thing: se3.from_yaw([0.2, 0.2, 0.0], 0.3)})
    both = f"{instruction} and put the bowl on the plate"
    one = controller(opening(instruction, thing, phase), PLATE, instruction=both)
    observe(one, HAND, perception)
    del perception.object_poses["bowl"]
    finish_part(one, perception, HAND)
    watch(one, perception, Hand(hand_pose(-0.4, -0.4, 0.5), HAND.opening), 100)
    assert one.state.status is Status.OBJECT_LOST


def test_what_was_opened_is_not_looked_for_when_a_later_grasp_is_tried_again():
    cabinet = se3.from_yaw([0.2, 0.2, 0.0], 0.3)
    putting = entry("put the bowl on the cabinet").key_poses
    both = "open the top drawer and put the bowl on the cabinet"
    whole = entry(both, (*opening().key_poses, *putting), {"cabinet": cabinet, "bowl": LAYOUT["bowl"]})
    perception, one = Perception({**LAYOUT, "cabinet": cabinet}), controller(whole, instruction=both)
    observe(one, HAND, perception)
    hand = HAND
    while one.state.index < 9:  # the bowl is lifted
        target = one.executor.target
        hand = Hand(target.T_world_ee, target.key_pose.opening)
        watch(one, perception, hand, 1)
    perception.asked.clear()
    watch(one, perception, Hand(hand.T_world_ee, 0.0), 1)
    assert one.state.attempts == 1
    assert perception.asked == [[]], "what is falling is not looked for"
    watch(one, perception, Hand(hand.T_world_ee, OPEN_WIDTH), 12)
    assert ["bowl"] in perception.asked
    assert not any("cabinet" in asked for asked in perception.asked)


def test_a_part_that_cannot_be_found_is_waited_for():
    perception, one = Perception({k: T for k, T in LAYOUT.items() if k != "box"}), controller(PLATE, BOX)
    observe(one, HAND, perception)
    hand = finish_part(one, perception, HAND)
    assert one.state.status is Status.OBJECT_NOT_FOUND
    assert one.state.used == ((PLATE,),)
    assert not one.executor.next_action(hand)[:6].any()
    perception.object_poses["box"] = LAYOUT["box"]
    watch(one, perception, hand, LOOK_AGAIN_STEPS)
    assert one.state.status is Status.RUNNING
    assert one.state.used == ((PLATE,), (BOX,))


def test_a_part_out_of_reach_is_infeasible():
    perception, one = Perception({**LAYOUT, "box": shifted(LAYOUT["box"], 3.0)}), controller(PLATE, BOX)
    observe(one, HAND, perception)
    assert one.state.status is Status.RUNNING
    finish_part(one, perception, HAND)
    assert one.state.status is Status.INFEASIBLE


def test_every_part_has_attempts_of_its_own():
    perception, one = Perception(LAYOUT), controller(PLATE, BOX)
    observe(one, HAND, perception)
    one.state.attempts = 3
    finish_part(one, perception, HAND)
    assert one.state.part == 1
    assert one.state.attempts == 0


def test_nothing_is_begun_where_a_part_is_unknown():
    one = controller(PLATE, BOX, instruction="put the bowl on the plate and turn on the stove")
    observe(one, HAND, Perception(LAYOUT))
    assert one.state.status is Status.NOT_UNDERSTOOD
    assert "'turn on the stove' is a part of the instruction" in one.state.refusal
    assert one.executor.targets == ()


@pytest.mark.parametrize("off", [{"tracking": False}, {"execution": "open_loop"}])
def test_without_tracking_every_part_is_still_planned_from_a_look(off):
    perception, one = Perception(LAYOUT), controller(PLATE, BOX, **off)
    observe(one, HAND, perception)
    finish_part(one, perception, HAND)
    assert one.state.part == 1
    assert len(perception.asked) == 2
