"""Other constructions of what an imperative says."""

import contextlib
import time

import pytest
from benchmarks.language import known_instructions

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.language.meaning import same_meaning

ON_STOVE = "put the bowl on the stove"
IN_BASKET = "put both the alphabet soup and the tomato sauce in the basket"
BETWEEN = "pick up the black bowl between the plate and the ramekin and place it on the plate"
OPEN_FIRST = "open the top drawer of the cabinet and put the bowl in it"
SAID = (
    ("Onto the stove with the bowl, please", ON_STOVE),
    ("The bowl belongs on the stove, put it there.", ON_STOVE),
    ("The right place for the bowl is on the stove", ON_STOVE),
    ("The bowl's place is on the stove", "put the bowl on the stove"),
    ("I'd like the bowl to stand on the stove", ON_STOVE),
    ("on the stove is where I want the bowl", ON_STOVE),
    ("Put the pan up on top of the cupboard", "put the frying pan on top of the cabinet"),
    ("stick both of them, the alphabet soup and the tomato sauce, inside the basket", IN_BASKET),
    ("put these two in the basket: the alphabet soup and the tomato sauce", IN_BASKET),
    ("put the alphabet soup in the basket and put the tomato sauce in it as well", IN_BASKET),
    ("I need the black bowl, the one between the ramekin and the plate, moved onto the plate", BETWEEN),
    ("Take the black bowl - it's between the plate and the ramekin - and put it on the plate", BETWEEN),
    ("Put the bowl in the top drawer of the cabinet; you will need to open it first", OPEN_FIRST),
    ("Put the bowl in the cabinet's top drawer, which you need to open first", OPEN_FIRST),
    ("put the book in the caddy, at the back", "put the book in the back compartment of the caddy"),
    ("Find the milk, pick it up, and put it in the basket", "put the milk in the basket"),
    ("the plate belongs in front of the stove; push it there", "push the plate to the front of the stove"),
)


@pytest.mark.parametrize(("said", "meant"), SAID)
def test_it_means_the_same_as_the_imperative(said: str, meant: str):
    assert same_meaning(parse_instruction(said), parse_instruction(meant))


@pytest.mark.parametrize(
    "said",
    [
        "The bowl sits on the stove.",
        "Leave the bowl on the stove",
        "Put the mug on the plate and leave the bowl on the stove",
        "put it there",
    ],
)
def test_what_asks_for_nothing_is_still_refused(said: str):
    with pytest.raises(InstructionError):
        parse_instruction(said)


def test_no_pattern_takes_long_over_long_text():
    for text in ("the the bowl on the " * 25, "put the bowl, the one on " * 20, "a , " * 120, "both " * 100):
        start = time.perf_counter()
        with contextlib.suppress(InstructionError):
            parse_instruction(text)
        assert time.perf_counter() - start < 1.0


def test_known_instructions_stay_as_they_are():
    assert all(parse_instruction(known.instruction) == known.elements for known in known_instructions())
