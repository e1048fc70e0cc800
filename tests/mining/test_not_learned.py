"""A contact is anchored to what it belongs to, or to nothing."""

from collections.abc import Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.memory.builders import hand_pose
from tests.mining.test_anchors import GRASP, PLACE, SUB_TASKS, demonstrations, key_pose

from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.entry import WORLD, Anchor
from lerobot_openspm.mining.anchors import Demonstration, consensus, contact_roles
from lerobot_openspm.mining.mined import MinedTask
from lerobot_openspm.mining.not_learned import list_not_learned


def without(name: str, made: list[Demonstration], n_left: int = 0) -> list[Demonstration]:
    """Demonstrations in which an object was found in the first few only."""
    return [
        replace(one, object_poses={k: T for k, T in one.object_poses.items() if k != name or i < n_left})
        for i, one in enumerate(made)
    ]


@pytest.mark.parametrize("n", [1, 2, 3, 10])
@pytest.mark.parametrize("seed", range(3))
def test_a_grasp_of_what_is_not_known_belongs_to_nothing_else(n: int, seed: int):
    anchors = consensus(without("bowl", demonstrations(n, WORLD, seed)), SUB_TASKS)
    assert GRASP not in anchors
    assert anchors[PLACE].place == "plate"


def test_a_place_on_what_is_not_known_belongs_to_nothing_else():
    anchors = consensus(without("plate", demonstrations(10)), SUB_TASKS)
    assert set(anchors) == {GRASP}


def test_a_grasp_of_what_was_rarely_found_is_kept_where_it_was_found():
    anchors = consensus(without("bowl", demonstrations(10), n_left=2), SUB_TASKS)
    assert anchors[GRASP] == Anchor("bowl", "bowl")


@pytest.mark.parametrize("n_found", [5, 6, 7, 8, 9])
@pytest.mark.parametrize("moves_m", [0.005, 0.01, 0.02, 0.2])
def test_a_grasp_belongs_to_what_was_found_in_most_demonstrations_however_little_things_move(
    n_found: int, moves_m: float
):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        made: list[Demonstration] = []
        for _ in range(10):
            bowl, plate = (
                se3.from_yaw([x, *(moves_m * rng.uniform(-1, 1, 1)), 0.0], 0.0) for x in (0.0, 0.2)
            )
            grasp = key_pose("grasp", bowl @ hand_pose(*rng.normal(0, 0.001, 2), 0.02))
            made.append(Demonstration((grasp,), {"bowl": bowl, "plate": plate}))
        anchors = consensus(without("bowl", made, n_found), SUB_TASKS)
        assert anchors[GRASP].place == "bowl"


def beside_the_plate(n: int, moves_m: float) -> list[Demonstration]:
    """The hand grasps at a fixed pose from a plate that stands somewhere else in every demonstration."""
    rng = np.random.default_rng(0)
    made = []
    for _ in range(n):
        plate = se3.from_yaw([*(moves_m * rng.uniform(-1, 1, 2)), 0.0], 0.0)
        made.append(Demonstration((key_pose("grasp", plate @ hand_pose(0, 0.1, 0.02)),), {"plate": plate}))
    return made


def test_demonstrations_may_show_that_it_goes_along_with_another_object():
    assert consensus(beside_the_plate(6, 0.2), SUB_TASKS)[GRASP].place == "plate"
    assert consensus(beside_the_plate(2, 0.2), SUB_TASKS) == {}  # two may agree by chance
    assert consensus(beside_the_plate(6, 0.002), SUB_TASKS) == {}  # where nothing moves nothing is shown


def episodes(numbers: Iterable[int]) -> tuple[Any, ...]:
    """Demonstrations that are parts of the episodes with these numbers."""
    said = "put the bowl on the plate"
    return tuple(
        SimpleNamespace(sub_tasks=SUB_TASKS, episode=SimpleNamespace(task=said, index=i)) for i in numbers
    )


def test_a_demonstration_of_two_things_is_one():
    made = without("bowl", demonstrations(6))
    task = MinedTask(episodes([0, 0, 1, 1, 2, 2]), tuple(made), consensus(made, SUB_TASKS), (), (), ())
    mined = SimpleNamespace(tasks=[task], object_poses=[one.object_poses for one in made], surfaces=(),
                            unlearned={"bowl": "it is grey"}, objects={}, simulator_objects=())  # fmt: skip
    bowl, instruction = list_not_learned(mined)
    assert str(bowl).startswith("'bowl' is handled in 3 demonstrations and could not be learned: it is grey")
    assert str(instruction).startswith("'put the bowl on the plate' is not learned: none of its 3 demonstr")


@pytest.mark.parametrize(
    ("n", "words"), [(6, "kept relative to the plate, with which it goes along"), (2, "")]
)
def test_it_is_said_what_a_contact_is_kept_relative_to_instead(n: int, words: str):
    made = beside_the_plate(n, 0.2)
    task = MinedTask(episodes(range(n)), tuple(made), consensus(made, SUB_TASKS), (), (), ())
    mined = SimpleNamespace(tasks=[task], object_poses=[one.object_poses for one in made], surfaces=(),
                            unlearned={"bowl": "it is grey"}, objects={}, simulator_objects=())  # fmt: skip
    (bowl, *_) = list_not_learned(mined)
    assert (bowl.name, bowl.demonstrations) == ("bowl", n)
    assert bowl.reason == "it is grey" + (f"; what the hand does there is {words}" if words else "")


def test_it_is_said_of_what_the_hand_never_touched_too():
    made = beside_the_plate(6, 0.2)
    task = MinedTask(episodes(range(6)), tuple(made), consensus(made, SUB_TASKS), (), (), ())
    mined = SimpleNamespace(tasks=[task], object_poses=[one.object_poses for one in made], surfaces=(),
                            unlearned={}, objects={}, simulator_objects=())  # fmt: skip
    (bowl,) = list_not_learned(mined)
    assert bowl.reason.startswith("the hand touches it in no demonstration; what the hand does there is kept")
    mined.objects = {"bowl": object()}
    assert list_not_learned(mined) == ()  # it is known, and so what is kept can be acted on


@pytest.mark.parametrize("n_found", [2, 5])
def test_demonstrations_that_do_not_show_what_is_known_are_told_as_left_out(n_found: int):
    made = without("bowl", demonstrations(6), n_found)
    anchors = consensus(demonstrations(6), SUB_TASKS)
    task = MinedTask(episodes(range(6)), tuple(made), anchors, (), (), ())
    mined = SimpleNamespace(tasks=[task], object_poses=[one.object_poses for one in made], surfaces=(),
                            unlearned={}, objects={"bowl": object()}, simulator_objects=())  # fmt: skip
    (told,) = list_not_learned(mined)
    assert (told.what, told.name, told.demonstrations) == ("demonstrations", "bowl", 6 - n_found)
    count = {2: "4 demonstrations", 5: "1 demonstration"}[n_found]
    assert str(told).startswith(f"{count} of 'bowl' left out: the first picture does not show it clearly; ")


def test_what_is_put_on_the_table_is_put_relative_to_what_is_known():
    sub_tasks = parse_instruction("put the bowl on the table")
    made = without("plate", demonstrations(4, "bowl"))
    assert PLACE not in consensus(made, sub_tasks)
    assert consensus(made, sub_tasks, {"table"})[PLACE].place == "bowl"


def test_where_a_push_begins_is_a_contact():
    phases = ("approach", "approach", "push", "push", "retreat")
    poses = [key_pose(phase, hand_pose(0, 0, 0.1), contact=0) for phase in phases]
    assert contact_roles(poses) == {(0, "approach", 0), (0, "push", 0), (0, "push", 1)}
