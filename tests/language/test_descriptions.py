"""What is said of sub-tasks and phases is understood again."""

import pytest

from lerobot_openspm.envs.tabletop.tasks import ANY_TASK
from lerobot_openspm.language.descriptions import phase_phrase, phases_of, phrase
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.types import Reference, SubTask

PICK, PUT = ("approach", "grasp", "lift"), ("pre-place", "place", "release", "retreat")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("pick up the red cup", PICK),
        ("Picking up bowl", PICK),
        ("takes the mug", PICK),
        ("put the cup on the shelf", PUT),
        ("putting bowl on plate", PUT),
        ("place the black bowl in the top drawer", PUT),
        ("stack the cubes", PUT),
        ("lower the bowl onto the plate", PUT),
        ("open the top drawer", ("approach", "grasp", "open", "push", "release", "retreat")),
        ("open the gripper", ("release",)),
        ("opens its fingers", ("release",)),
        ("close the gripper", ("approach", "grasp")),
        ("turn on the stove", ("approach", "grasp", "turn", "push", "release", "retreat")),
        ("rotating the knob", ("approach", "grasp", "turn", "push", "release", "retreat")),
        ("push the plate to the front of the stove", ("approach", "push", "retreat")),
        ("move to the bowl", ("approach",)),
        ("move the bowl to the plate", ("lift", "pre-place")),
        ("move away from the plate", ("retreat",)),
        ("raise the bowl", ("grasp", "lift")),
        ("releasing it", ("release",)),
        ("let go of the bowl", ("release",)),
        ("return home", ("retreat",)),
        ("the robot grips the handle", ("approach", "grasp")),
        ("pour water into the glass", ()),
        ("", ()),
        ("a display of outputs", ()),
    ],
)
def test_phases_of_words(words: str, expected: tuple[str, ...]):
    assert phases_of(words) == expected


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize(
    "instruction",
    ["put the bowl in the top drawer of the cabinet", "open the top drawer", "turn on the stove"],
)
def test_a_sub_task_is_worded_so_that_it_is_understood_again(phase: str, instruction: str):
    words = phase_phrase(phase, parse_instruction(instruction)[0])
    assert phase in phases_of(words), words


@pytest.mark.parametrize("task", ANY_TASK)
def test_a_phrase_says_the_sub_task(task):
    for sub_task in parse_instruction(ANY_TASK[task].instruction):
        assert parse_instruction(phrase(sub_task)) == (sub_task,)


ON_PLATE = ("put", "bowl", "", "on", "plate")


@pytest.mark.parametrize(
    ("sub_task", "words"),
    [
        (SubTask(*ON_PLATE, None, Reference("left")), "put the bowl on the left plate"),
        (
            SubTask(*ON_PLATE, Reference("between", ("cup", "ramekin"))),
            "put the bowl between the cup and the ramekin on the plate",
        ),
        (
            SubTask("pick", "mug", target_where=Reference("front", ("box",))),
            "pick up the mug in front of the box",
        ),
        (
            SubTask("open", "cabinet", "top drawer", target_where=Reference("left")),
            "open the top drawer of the left cabinet",
        ),
    ],
)
def test_a_phrase_says_which_is_meant(sub_task, words):
    assert phrase(sub_task) == words
