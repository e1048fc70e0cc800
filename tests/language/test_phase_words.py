"""The verb of a sub-task tells which phases it covers."""

import pytest

from lerobot_openspm.language.phase_words import phases_of

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
