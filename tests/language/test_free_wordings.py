"""Wordings that are far from the imperative."""

import pytest

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.language.meaning import same_meaning

SAID = (
    ("The orange juice needs to find its way into the basket.", "put the orange juice in the basket"),
    ("Into the tray the ketchup should go, please.", "put the ketchup in the tray"),
    (
        "Black bowl, the one sitting on the ramekin: transfer it to the plate.",
        "pick up the black bowl on the ramekin and place it on the plate",
    ),
    (
        "The black bowl beside the plate should be on it. Please put it there.",
        "pick up the black bowl next to the plate and place it on the plate",
    ),
    ("the cabinet's top drawer is open, please close it", "close the top drawer of the cabinet"),
    (
        "After placing the front stick of butter in the cabinet's top drawer, close that drawer.",
        "put the butter at the front in the top drawer of the cabinet and close it",
    ),
    (
        "With the top drawer opened first, have the bowl placed inside it.",
        "open the top drawer and put the bowl inside",
    ),
    (
        "I'd like to have the wine bottle standing on the cabinet.",
        "put the wine bottle on top of the cabinet",
    ),
    ("The stove ought to be lit. Could you see to that?", "turn on the stove"),
    (
        "move the book that's on the right to underneath the cabinet shelf",
        "pick up the book on the right and place it under the cabinet shelf",
    ),
)
NOT_ASKED = (
    "The bowl is on the plate.",
    "Is the bowl on the plate?",
    "Leave the bowl on the stove",
    "the bowl should not be on the stove",
    "if the bowl is on the stove put it on the plate",
    "put the milk or the butter in the basket",
    "bowl plate",
)


@pytest.mark.parametrize(("said", "meant"), SAID)
def test_it_means_the_same_as_the_imperative(said: str, meant: str):
    assert same_meaning(parse_instruction(said), parse_instruction(meant))


@pytest.mark.parametrize("said", NOT_ASKED)
def test_what_asks_for_nothing_is_refused(said: str):
    with pytest.raises(InstructionError):
        parse_instruction(said)
