"""Evidence is pooled as its formula says, and what no hand can follow never comes out."""

import pytest
from benchmarks.libero.guessed_key_poses import check_sequence
from hypothesis import example, given
from hypothesis import strategies as st

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.mining.phase_labels.base import PhaseLabel
from lerobot_openspm.mining.phase_labels.merge import LAST, MAX_CONFIDENCE, SIBLINGS, SUCCESSORS, merge

confidences = st.floats(0, 1, allow_subnormal=False)
unsure = st.floats(0, 0.99, allow_subnormal=False)
phases = st.sampled_from(PHASES)
PICK = ("approach", "approach", "grasp", "lift", "pre-place", "place", "release", "retreat", "retreat")


@st.composite
def walks(draw: st.DrawFn) -> list[str]:
    """Phases that a hand can follow, one or several things done one after the other."""
    walk = ["approach"]
    while len(walk) < 14 or walk[-1] not in LAST:
        following = SUCCESSORS[walk[-1]]
        if len(walk) > 20:  # bring it to an end
            following = [n for n in following if n != walk[-1]] or following
        walk.append(draw(st.sampled_from(following)))
    return walk


def of(names, confidence: float = 0.7) -> list[PhaseLabel]:
    return [PhaseLabel(name, confidence) for name in names]


def in_the_middle(kinematic: PhaseLabel, judged: PhaseLabel | None, threshold: float = 0.0) -> PhaseLabel:
    """A lift and a pre-place may both stand between a lift and a pre-place; nothing is said of the others."""
    around = of(("approach", "grasp", "lift")), of(("pre-place", "place", "release"))
    answers = (None,) * 3 + (judged,) + (None,) * 3
    return merge([*around[0], kinematic, *around[1]], answers, threshold)[3]


@given(walks(), st.data())
def test_what_a_hand_can_follow_it_can_follow_after_merging(walk: list[str], data: st.DataObject):
    answers = st.none() | st.builds(PhaseLabel, phases, confidences)
    kinematic = [PhaseLabel(name, data.draw(confidences)) for name in walk]
    judged = tuple(data.draw(st.lists(answers, min_size=len(walk), max_size=len(walk))))
    merged = merge(kinematic, judged, data.draw(confidences))
    check_sequence([answer.phase for answer in merged])
    for before, after in zip(kinematic, merged, strict=True):
        assert after.phase in (before.phase, SIBLINGS.get(before.phase))
        assert 0 <= after.confidence <= 1
        if before.confidence == 1:
            assert after == before


@given(st.lists(st.builds(PhaseLabel, phases, confidences), min_size=1), st.data())
def test_a_sequence_that_no_hand_can_follow_is_left_as_it_was_found(kinematic, data):
    answers = tuple(data.draw(st.none() | st.builds(PhaseLabel, phases, confidences)) for _ in kinematic)
    merged = merge(kinematic, answers, 0.0)
    assert len(merged) == len(kinematic)
    kept = [SIBLINGS.get(before.phase, before.phase) for before in kinematic]
    assert all(m.phase in (b.phase, k) for m, b, k in zip(merged, kinematic, kept, strict=True))


@given(st.lists(st.builds(PhaseLabel, phases, confidences), min_size=1), phases)
def test_without_a_judge_or_with_one_that_knows_nothing_all_stays(kinematic, phase):
    assert merge(kinematic, (None,) * len(kinematic), 0.0) == tuple(kinematic)
    assert merge(kinematic, (PhaseLabel(phase, 0.0),) * len(kinematic), 0.0) == tuple(kinematic)


@given(unsure, phases, st.floats(0.01, 1), st.data())
def test_below_its_threshold_a_judge_changes_nothing(g, phase, threshold, data):
    m = data.draw(st.floats(0, threshold, exclude_max=True))
    kinematic = PhaseLabel("lift", g)
    assert in_the_middle(kinematic, PhaseLabel(phase, m), threshold) == kinematic


@given(confidences, confidences, confidences)
@example(1.0, 0.0, 0.5625)
def test_agreement_never_lowers_and_more_of_it_never_less(g, m, more):
    m, more = sorted((m, more))
    kinematic = PhaseLabel("lift", g)
    once, twice = (in_the_middle(kinematic, PhaseLabel("lift", c)) for c in (m, more))
    assert once.phase == twice.phase == "lift"
    assert g - 1e-12 <= once.confidence <= twice.confidence + 1e-12


@given(unsure, confidences, confidences)
def test_disagreement_lowers_more_the_surer_the_judge_until_it_is_believed(g, m, more):
    m, more = sorted((m, more))
    kinematic = PhaseLabel("lift", g)
    once, twice = (in_the_middle(kinematic, PhaseLabel("pre-place", c)) for c in (m, more))
    for answer, judged in ((once, m), (twice, more)):
        assert answer.phase == ("pre-place" if min(judged, MAX_CONFIDENCE) > g else "lift")
    if once.phase == twice.phase == "lift":
        assert twice.confidence <= once.confidence + 1e-12 <= g + 2e-12
    if once.phase == twice.phase == "pre-place":
        assert once.confidence <= twice.confidence + 1e-12
        assert twice.confidence <= MAX_CONFIDENCE


def test_the_formula():
    assert in_the_middle(PhaseLabel("lift", 0.6), PhaseLabel("lift", 0.8)).confidence == pytest.approx(
        0.6 * 4 / (0.6 * 4 + 0.4)
    )
    kept = in_the_middle(PhaseLabel("lift", 0.8), PhaseLabel("pre-place", 0.6))
    taken = in_the_middle(PhaseLabel("lift", 0.6), PhaseLabel("pre-place", 0.8))
    assert (kept.phase, taken.phase) == ("lift", "pre-place")
    assert kept.confidence == pytest.approx(taken.confidence) == pytest.approx(4 / (4 + 1.5))


def test_at_a_contact_a_sure_judge_lowers_what_is_not_certain_but_renames_nothing():
    kinematic = [*of(PICK[:5]), PhaseLabel("place", 0.9), *of(PICK[6:])]
    merged = merge(kinematic, tuple(PhaseLabel("lift", 1.0) for _ in PICK), 0.5)
    assert merged[5].phase == "place"
    assert merged[5].confidence < 0.9


def test_two_renamings_that_exclude_each_other_leave_the_better_one():
    kinematic = of(("approach", "grasp", "lift", "pre-place", "place", "release"), 0.6)
    said = [None, None, PhaseLabel("pre-place", 0.9), PhaseLabel("lift", 0.8), None, None]
    assert [a.phase for a in merge(kinematic, tuple(said), 0.5)][2:4] == ["pre-place", "pre-place"]
    said[2], said[3] = PhaseLabel("pre-place", 0.8), PhaseLabel("lift", 0.9)
    assert [a.phase for a in merge(kinematic, tuple(said), 0.5)][2:4] == ["lift", "lift"]


def test_the_last_retreat_cannot_become_an_approach_to_nothing():
    merged = merge(of(PICK, 0.6), tuple(of(["approach"] * len(PICK), 0.9)), 0.5)
    assert tuple(a.phase for a in merged) == PICK


def test_as_many_answers_as_candidates():
    with pytest.raises(PhaseLabelError, match="got 1 labels for 2 candidates"):
        merge(of(("approach", "grasp")), (None,), 0.5)


@pytest.mark.parametrize(("phase", "confidence"), [("fly", 0.5), ("lift", 1.1), ("lift", float("nan"))])
def test_an_answer_outside_the_closed_set_is_none(phase: str, confidence: float):
    with pytest.raises(PhaseLabelError, match="expected"):
        PhaseLabel(phase, confidence)
