from dataclasses import replace

import pytest

from lerobot_openspm.envs.tasks import TASKS
from lerobot_openspm.errors import InstructionError
from lerobot_openspm.memory.entry import Reference, SubTask
from lerobot_openspm.memory.instruction import parse_instruction

TABLETOP = {
    "bowl_on_plate": [SubTask("put", "bowl", "", "on", "plate")],
    "bowl_on_stove": [SubTask("put", "bowl", "", "on", "stove")],
    "bowl_on_cabinet": [SubTask("put", "bowl", "", "on", "cabinet")],
    "box_in_bowl": [SubTask("put", "cream cheese box", "", "in", "bowl")],
    "bottle_on_cabinet": [SubTask("put", "wine bottle", "", "on", "cabinet")],
    "bottle_on_rack": [SubTask("put", "wine bottle", "", "on", "rack")],
    "open_middle_drawer": [SubTask("open", "cabinet", "middle drawer")],
    "bowl_in_top_drawer": [
        SubTask("open", "cabinet", "top drawer"),
        SubTask("put", "bowl", "top drawer", "in", "cabinet"),
    ],
    "push_plate": [SubTask("push", "plate", "", "front of", "stove")],
    "turn_on_stove": [SubTask("turn on", "stove")],
}


@pytest.mark.parametrize("name", TASKS)
def test_every_instruction_of_the_tabletop(name):
    assert list(parse_instruction(TASKS[name].instruction)) == TABLETOP[name]


BOWL_ON_PLATE = SubTask("put", "bowl", "", "on", "plate")


def taken(relation, *landmarks):
    """The bowl that is somewhere, put on the plate."""
    return replace(BOWL_ON_PLATE, target_where=Reference(relation, landmarks))


@pytest.mark.parametrize(
    ("instruction", "expected"),
    [
        ("pick up the bowl and put it on the plate", [BOWL_ON_PLATE]),
        ("Pick the bowl up, then place it onto the plate.", [BOWL_ON_PLATE]),
        ("Place the  bowl  on top of the plate!", [BOWL_ON_PLATE]),
        ("put_the_bowl_on_the_plate", [BOWL_ON_PLATE]),
        ("pick up the bowl", [SubTask("put", "bowl")]),
        (
            "pick up the alphabet soup and place it in the basket",
            [SubTask("put", "alphabet soup", "", "in", "basket")],
        ),
        ("pick up the bowl from the stove and put it on the plate", [taken("on", "stove")]),
        ("pick up the bowl next to the box and place it on the plate", [taken("next to", "box")]),
        (
            "pick up the bowl between the stove and the rack and place it on the plate",
            [taken("between", "stove", "rack")],
        ),
        (
            "pick up the bowl in the top drawer of the cabinet and place it on the plate",
            [taken("in", "cabinet")],
        ),
        (
            "put the bowl on the stove and put it on the plate",
            [SubTask("put", "bowl", "", "on", "stove"), BOWL_ON_PLATE],
        ),
        (
            "put the cup in the microwave and close it",
            [SubTask("put", "cup", "", "in", "microwave"), SubTask("close", "microwave")],
        ),
        ("turn the stove on", [SubTask("turn on", "stove")]),
        ("switch the stove off", [SubTask("turn off", "stove")]),
        ("turn on the knob", [SubTask("turn on", "stove", "knob")]),
        ("close the top drawer", [SubTask("close", "cabinet", "top drawer")]),
        ("close the top drawer of the desk", [SubTask("close", "desk", "top drawer")]),
        ("slide the plate to the left of the stove", [SubTask("push", "plate", "", "left of", "stove")]),
        (
            "turn on the stove and put the moka pot on it",
            [SubTask("turn on", "stove"), SubTask("put", "moka pot", "", "on", "stove")],
        ),
        (
            "open the top drawer then put the bowl on the plate and close the top drawer",
            [
                SubTask("open", "cabinet", "top drawer"),
                BOWL_ON_PLATE,
                SubTask("close", "cabinet", "top drawer"),
            ],
        ),
        (
            "put the yellow and white mug on the plate",
            [SubTask("put", "yellow and white mug", "", "on", "plate")],
        ),
        (
            "put the bowl in the bottom drawer of the cabinet and close it",
            [
                SubTask("put", "bowl", "bottom drawer", "in", "cabinet"),
                SubTask("close", "cabinet", "bottom drawer"),
            ],
        ),
    ],
)
def test_instructions_people_give(instruction, expected):
    assert list(parse_instruction(instruction)) == expected


@pytest.mark.parametrize(
    ("instruction", "words"),
    [
        ("", "expected one like"),
        ("  ,, !", "expected one like"),
        ("juggle the bowls", r"no verb I know .*pick up.*turn on"),
        ("putty the bowl on the plate", "no verb I know"),
        ("open the drawer, juggle the bowl", "cannot read: .*juggle the bowl"),
        ("open", "names no object"),
        ("put on the plate", "names no object"),
        ("turn on the", "names no object"),
    ],
)
def test_what_cannot_be_read_is_repeated_in_the_error(instruction, words):
    with pytest.raises(InstructionError, match=words) as caught:
        parse_instruction(instruction)
    assert repr(instruction) in str(caught.value)
