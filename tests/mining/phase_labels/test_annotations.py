"""What lerobot-annotate wrote is understood by its verbs, and counts where it tells two phases apart."""

import pytest
from tests.mining.phase_labels.questions import pick_and_place

from lerobot_openspm.mining.phase_labels.annotations import CONFIDENCE, AnnotationJudge, phases_of

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


def judged(*rows: tuple[float, str]):
    answers = AnnotationJudge(lambda index: rows).judge(pick_and_place())
    return [None if a is None else (a.phase, a.confidence) for a in answers]


def test_sub_tasks_name_the_phases_they_cover():
    sure = pytest.approx(CONFIDENCE)
    assert judged((0.0, "pick up the bowl"), (4.0, "put the bowl on the plate")) == [
        ("approach", sure), ("approach", sure), ("grasp", sure), ("lift", sure),
        ("pre-place", sure), ("place", sure), ("release", sure), ("retreat", sure),
    ]  # fmt: skip


def test_a_sub_task_that_covers_both_names_in_question_says_nothing():
    found = judged((0.0, "move the bowl"))
    assert found[3:5] == [None, None]  # lift or pre-place: both belong to it


def test_the_other_name_is_said_where_the_words_exclude_this_one():
    found = judged((0.0, "pick up the bowl"))
    assert found[4] == ("lift", pytest.approx(CONFIDENCE))  # where motion says pre-place
    assert found[7] == ("approach", pytest.approx(CONFIDENCE))
    assert found[5] is None  # place: picking up covers it not, and it has no other name


def test_a_boundary_in_the_middle_of_the_way_makes_it_less_sure():
    found = judged((0.0, "pick up the bowl"), (3.75, "put the bowl on the plate"))
    assert found[3] == ("lift", pytest.approx(0.75 * CONFIDENCE))


def test_before_the_first_sub_task_and_without_any_nothing_is_said():
    assert judged((2.0, "pick up the bowl"))[0] is None
    assert judged() == [None] * 8
    assert judged((0.0, "dance")) == [None] * 8
