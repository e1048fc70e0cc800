from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from lerobot_openspm.envs.tabletop.tasks import TASKS
from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.instruction import parse_instruction, read_task
from lerobot_openspm.language.lexicon import OPERATIONS
from lerobot_openspm.language.meaning import same_meaning
from lerobot_openspm.types import Reference, SubTask

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


def put(target, relation, landmark, part="", where=None, landmark_where=None):
    return SubTask("put", target, part, relation, landmark, where, landmark_where)


OPEN_TOP = SubTask("open", "cabinet", "top drawer")
IN_TOP = put("bowl", "in", "cabinet", "top drawer")


@pytest.mark.parametrize(
    "instruction",
    [
        "Would you mind putting the bowl on the plate?",
        "Hey robot, could you please carefully set the bowl down on the plate for me? Thanks!",
        "Don't forget to put the bowl on the plate",
        "Your task: place the bowl on the plate",
        "I'd like the bowl on the plate",
        "the bowl should be placed on the plate",
        "The bowl goes on the plate.",
        "Could the bowl go on the plate, please?",
        "on the plate, put the bowl",
        "make sure the bowl is on the plate",
        "The plate is where I want the bowl.",
        "Bowl onto the plate, please",
        "The bowl, put it on the plate",
        "Take the bowl. Place it on the plate.",
    ],
)
def test_a_thing_is_asked_for_in_many_ways(instruction):
    assert same_meaning(parse_instruction(instruction), [BOWL_ON_PLATE])


@pytest.mark.parametrize(
    "instruction",
    [
        "After opening the top drawer, put the bowl inside",
        "Put the bowl in the top drawer after opening it",
        "put the bowl in the top drawer once you have opened it",
        "Before putting the bowl inside, open the top drawer",
        "Place the bowl in the top drawer, but open it first.",
        "First open the drawer on top, then drop the bowl in.",
        "the top drawer needs to be opened and the bowl placed inside",
        "Open the cabinet's top drawer to put the bowl in",
        "Open the top drawer. Once it is open, put the bowl in there.",
        "With the top drawer open, put the bowl in it.",
    ],
)
def test_sub_tasks_come_in_the_order_of_execution(instruction):
    assert list(parse_instruction(instruction)) == [OPEN_TOP, IN_TOP]


@pytest.mark.parametrize(
    ("instruction", "expected"),
    [
        (
            "put both the soup and the sauce in the basket",
            [put("soup", "in", "basket"), put("sauce", "in", "basket")],
        ),
        (
            "the soup goes in the basket, and so does the sauce",
            [put("soup", "in", "basket"), put("sauce", "in", "basket")],
        ),
        ("put the two moka pots on the stove", [put("moka pot", "on", "stove")] * 2),
        (
            "put the bowl on the plate and the bottle on the rack",
            [BOWL_ON_PLATE, put("bottle", "on", "rack")],
        ),
        (
            "put the white mug on the left plate and the yellow and white one on the right one",
            [
                put("white mug", "on", "plate", landmark_where=Reference("left")),
                put("yellow and white mug", "on", "plate", landmark_where=Reference("right")),
            ],
        ),
        (
            "stack the left bowl on the right bowl and place them in the tray",
            [
                put("bowl", "on", "bowl", "", Reference("left"), Reference("right")),
                put("bowl", "in", "tray", "", Reference("right")),
            ],
        ),
        (
            "close the lower drawer of the cupboard, then pull open its upper one",
            [SubTask("close", "cabinet", "bottom drawer"), OPEN_TOP],
        ),
        (
            "put the moka pot on the stove and turn it on",
            [put("moka pot", "on", "stove"), SubTask("turn on", "stove")],
        ),
        (
            "put the bowl in the top drawer of the cabinet and push the drawer shut",
            [IN_TOP, SubTask("close", "cabinet", "top drawer")],
        ),
    ],
)
def test_what_is_left_out_is_taken_from_what_was_said(instruction, expected):
    assert list(parse_instruction(instruction)) == expected


@pytest.mark.parametrize(
    ("instruction", "expected"),
    [
        (
            "put the black bowl at the front on the plate",
            put("black bowl", "on", "plate", "", Reference("front")),
        ),
        (
            "put the red mug on the plate on the left",
            put("red mug", "on", "plate", landmark_where=Reference("left")),
        ),
        ("put the bowl next to the box on the plate", taken("next to", "box")),
        (
            "put the bowl on the plate next to the box",
            put("bowl", "on", "plate", landmark_where=Reference("next to", ("box",))),
        ),
        ("move the bowl that is on the stove to the plate", replace(taken("on", "stove"), relation="at")),
        ("take the bowl out of the drawer and put it on the plate", taken("in", "cabinet")),
        ("put the bowl from the centre of the table on the plate", taken("center", "table")),
        ("the bowl is standing behind the plate. Put it on the plate", taken("back", "plate")),
        ("put the bowl to the right of the plate", put("bowl", "right of", "plate")),
        ("put the book in the slot at the back of the caddy", put("book", "in", "caddy", "back compartment")),
        ("put the book in the front of the caddy", put("book", "in", "caddy", "front compartment")),
        ("put the pan on the shelf in the cabinet", put("pan", "on", "cabinet", "shelf")),
        ("put the book on top of the shelf", put("book", "on", "shelf")),
        ("put a can of soup in the basket", put("soup", "in", "basket")),
        ("put the bottle of wine on the rack", put("wine bottle", "on", "rack")),
        ("put the white and yellow mug on the plate", put("yellow and white mug", "on", "plate")),
    ],
)
def test_phrases_say_which_is_meant_or_where_it_goes(instruction, expected):
    assert parse_instruction(instruction) == (expected,)


@pytest.mark.parametrize(
    ("instruction", "reason"),
    [
        ("don't put the bowl on the plate", "what not to do"),
        ("put the bowl on the plate without touching the stove", "what not to do"),
        ("if the drawer is open, close it", "depends on a condition"),
        ("put the bowl on the plate or on the stove", "leaves a choice"),
        ("turn on the stove in five minutes", "says when"),
        ("open the top drawer three times", "how often"),
        ("Is the bowl on the plate?", "is a question"),
        ("How do I open the drawer?", "is a question"),
        ("The bowl is on the plate.", "states something"),
        ("the robot opened the drawer", "cannot read"),
        ("good morning", "no verb I know"),
        ("leave the bowl on the plate", "to leave something as it is"),
        ("put the bowl the plate", "cannot read"),
        ("turn the stove", "no verb I know"),
        ("put the bowl " * 100, "1300 characters"),
    ],
)
def test_what_is_no_instruction_is_refused_with_the_reason(instruction, reason):
    with pytest.raises(InstructionError, match=reason):
        parse_instruction(instruction)


WORDS = (
    *("put", "pick", "take", "open", "close", "turn", "push", "bowl", "plate", "drawer", "cabinet", "stove"),
    *("it", "them", "there", "one", "its", "the", "a", "both", "top", "left", "on", "in", "to", "from", "of"),
    *(
        "next",
        "and",
        "then",
        "after",
        "before",
        "once",
        "first",
        "is",
        "should",
        "goes",
        "that",
        "which",
        "off",
    ),
    *(",", ".", "?", ";", "'", "'s", "please", "i", "want", "up"),
)


@given(st.lists(st.sampled_from(WORDS), max_size=14))
@example(["it", "next", "put"])
def test_any_words_are_read_or_refused(words):
    try:
        found = parse_instruction(" ".join(words))
    except InstructionError:
        return
    assert found
    assert all(sub_task.operation in OPERATIONS and sub_task.target for sub_task in found)
    assert all(bool(sub_task.relation) == bool(sub_task.landmark) for sub_task in found)


@pytest.mark.parametrize(
    ("instruction", "expected"),
    [
        ("put block a on block b", [SubTask("put", "block a", "", "on", "block b")]),
        ("pick up block 1 and put it on block 2.", [SubTask("put", "block 1", "", "on", "block 2")]),
        ("put 3 mugs on the plate", [SubTask("put", "mug", "", "on", "plate")] * 3),
        ("put 10 mugs on the plate", [SubTask("put", "mug", "", "on", "plate")] * 10),
        ("put twelve mugs on the plate", [SubTask("put", "mug", "", "on", "plate")] * 12),
        (
            "put the can in the left bin",
            [SubTask("put", "can", "", "in", "bin", landmark_where=Reference("left"))],
        ),
        ("put the pen in the organizer", [SubTask("put", "pen", "", "in", "organizer")]),
        ("press the button", [SubTask("push", "button")]),
        (
            "1. open the top drawer 2. put the bowl in it",
            [SubTask("open", "cabinet", "top drawer"), SubTask("put", "bowl", "top drawer", "in", "cabinet")],
        ),
    ],
)
def test_things_mean_what_they_say(instruction: str, expected: list[SubTask]):
    assert list(read_task(instruction)) == expected


@pytest.mark.parametrize(
    ("names", "landmark"),
    [
        ((), "cupboard"),
        (("cabinet",), "cabinet"),
        (("cabinet", "cupboard"), "cupboard"),
        (("dresser",), "dresser"),
    ],
)
def test_a_thing_keeps_its_name_unless_the_memory_calls_its_kind_otherwise(
    names: tuple[str, ...], landmark: str
):
    (sub_task,) = read_task("put the bowl in the cupboard", names)
    assert sub_task.landmark == landmark


@pytest.mark.parametrize("of", ["", "the top drawer of "])
def test_left_and_right_things_are_opened_and_switched_one_after_the_other(of):
    verb, thing = ("open", "cabinet") if of else ("turn on", "stove")
    read = parse_instruction(f"{verb} {of}the left {thing} and {verb} {of}the right {thing}")
    assert [sub_task.target_where for sub_task in read] == [Reference("left"), Reference("right")]
    apart = [parse_instruction(f"{verb} {of}the {side} {thing}")[0] for side in ("left", "right")]
    assert list(read) == apart


def test_what_is_said_again_more_vaguely_is_not_done_twice():
    read = parse_instruction("Turn on the left stove. The stove should be on.")
    assert [sub_task.target_where for sub_task in read] == [Reference("left")]


@pytest.mark.parametrize(
    ("told", "said_again"),
    [
        ("Open the top drawer.", "The top drawer should be open."),
        ("Turn on the stove.", "Make sure the stove is on."),
        ("Put the bowl on the plate.", "The bowl should be on the plate."),
        ("Put two bowls on the plate.", "The bowls should be on the plate."),
    ],
)
def test_what_is_said_to_be_so_in_the_end_is_not_done_twice(told, said_again):
    assert parse_instruction(f"{told} {said_again}") == parse_instruction(told)


@pytest.mark.parametrize("instruction", ["turn on the {}stove", "open the top drawer of the {}cabinet"])
def test_what_is_said_more_exactly_is_another_thing(instruction: str):
    read = parse_instruction(f"{instruction.format('')} and {instruction.format('left ')}")
    assert [sub_task.target_where for sub_task in read] == [None, Reference("left")]
