"""What lerobot-annotate wrote is understood by its verbs, and counts where it tells two phases apart."""

import pytest
from tests.mining.phase_labels.questions import pick_and_place

from lerobot_openspm.mining.phase_labels.annotations import CONFIDENCE, annotation_judge


def judged(*rows: tuple[float, str]):
    answers = annotation_judge(lambda index: rows).judge(pick_and_place())
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
