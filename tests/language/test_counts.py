"""How many things an instruction is about."""

import pytest

from lerobot_openspm.language.instruction import parse_instruction


@pytest.mark.parametrize(
    ("things", "target", "count"),
    [
        ("10 mm socket", "10 mm socket", 1),
        ("24 can pack", "24 can pack", 1),
        ("8 ball", "8 ball", 1),
        ("2 button", "2 button", 1),
        ("4 port hub", "4 port hub", 1),
        ("2 x 4 block", "2 x 4 block", 1),
        ("12 inch rulers", "12 inch ruler", 2),
        ("1 mug", "mug", 1),
        ("one mug", "mug", 1),
        ("3 mugs", "mug", 3),
        ("2 cream cheese", "cream cheese", 2),
        ("1 of the mugs", "mug", 1),
        ("one of the mugs", "mug", 1),
        ("24 cans", "can", 24),
        ("thirteen mugs", "mug", 13),
    ],
)
def test_a_number_counts_things_or_belongs_to_a_name(things, target, count):
    read = parse_instruction(f"put the {things} in the tray")
    assert [sub_task.target for sub_task in read] == [target] * count


def test_both_counts_no_thing_of_a_list():
    read = parse_instruction("put both the cans of soup and the butter in the basket")
    assert [sub_task.target for sub_task in read] == ["soup", "butter"]


def test_a_size_counts_nothing_in_a_list():
    read = parse_instruction("put the cans of soup and the 10 mm socket in the tray")
    assert [sub_task.target for sub_task in read] == ["soup", "10 mm socket"]
