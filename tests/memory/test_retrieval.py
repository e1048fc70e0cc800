import pytest
from tests.memory.builders import entry

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.memory.instruction import parse_instruction
from lerobot_openspm.memory.retrieval import (
    ScoreWeights,
    retrieve,
    semantic_candidates,
    semantic_score,
)


def score(asked, known):
    return semantic_score(parse_instruction(asked), parse_instruction(known))


def test_the_same_thing_said_otherwise_scores_one():
    assert score("pick up the bowl and put it on the plate", "put the bowl onto the plate") == pytest.approx(
        1
    )


@pytest.mark.parametrize(
    "known",
    [
        "push the bowl on the plate",
        "put the box on the plate",
        "put the bowl on the stove",
        "open the drawer and put the bowl on the plate",
    ],
)
def test_another_operation_object_or_number_of_sub_tasks_scores_nothing(known):
    assert score("put the bowl on the plate", known) == 0


def test_agreement_is_graded():
    same = score("put the wine bottle on the rack", "put the wine bottle on the rack")
    shorter = score("put the bottle on the rack", "put the wine bottle on the rack")
    beside = score("put the bottle next to the rack", "put the wine bottle on the rack")
    assert same > shorter > beside > 0
    assert score("open the top drawer", "open the middle drawer") < score(
        "open the top drawer", "open the top drawer"
    )


def test_a_chain_is_as_good_as_its_weakest_link():
    asked = "open the top drawer and put the bowl on the plate"
    assert score(asked, "open the top drawer and put the bowl on the stove") == 0
    assert score(asked, asked) == pytest.approx(1)


def test_only_matching_entries_are_candidates_each_with_its_score():
    exact, other = entry("put the wine bottle on the rack"), entry("put the bowl on the plate")
    near = entry("put the bottle on the rack")
    found = semantic_candidates("put the wine bottle on the rack", [other, near, exact, exact])
    assert [item[0] for item in found] == [near, exact, exact]
    assert found[1][1] == pytest.approx(1)
    assert 0.75 <= found[0][1] < 1
    # The weight of semantics decides against a nearer match in another respect, or not.
    better_place = {id(near): 1.0}
    for weight, first in ((5.0, exact), (0.1, near)):
        weights = ScoreWeights(semantic=weight, geometric=0.5, quality=0.0)
        ranked = retrieve(found, lambda e: better_place.get(id(e), 0.5), weights)
        assert ranked[0].entry is first


@pytest.mark.parametrize("instruction", ["put the box on the plate", "open the bowl", "close the top drawer"])
def test_an_instruction_without_experience_lists_what_is_known(instruction):
    entries = [entry("put the bowl on the plate"), entry("put the bowl on the stove")]
    with pytest.raises(InstructionError) as caught:
        semantic_candidates(instruction, entries)
    message = str(caught.value)
    assert repr(instruction) in message
    assert "put the bowl on the plate; put the bowl on the stove" in message
    with pytest.raises(InstructionError, match="nothing yet"):
        semantic_candidates(instruction, [])


# Semantic and geometric score of three entries, each the best in one term.
SCORES = {"semantic": (1.0, 0.2), "geometric": (0.8, 1.0), "quality": (0.8, 0.2)}


def rank(weights, geometric=lambda entry: SCORES[entry.source][1]):
    entries = [
        (entry(quality=0.9 if source == "quality" else 0.2, source=source), semantic)
        for source, (semantic, _) in SCORES.items()
    ]
    return retrieve(entries, geometric, weights)


@pytest.mark.parametrize("term", ["semantic", "geometric", "quality"])
def test_the_weight_of_a_term_decides_for_the_entry_that_is_best_in_it(term):
    weights = {"semantic": 0.1, "geometric": 0.1, "quality": 0.1, term: 10.0}
    assert rank(ScoreWeights(**weights))[0].entry.source == term


def test_the_score_is_the_papers_sum():
    for scored in rank(ScoreWeights(2.0, 3.0, 5.0)):
        assert (scored.semantic, scored.geometric) == SCORES[scored.entry.source]
        assert scored.quality == scored.entry.quality
        assert scored.total == pytest.approx(2 * scored.semantic + 3 * scored.geometric + 5 * scored.quality)


@pytest.mark.parametrize("weights", [ScoreWeights(), ScoreWeights(100, 0, 0), ScoreWeights(0, 0, 100)])
def test_an_entry_that_cannot_be_executed_comes_last_whatever_the_weights(weights):
    best = rank(weights)[0].entry.source
    ranked = rank(weights, lambda entry: 0.0 if entry.source == best else 0.01)
    assert ranked[-1].entry.source == best
    assert ranked[-1].geometric == 0
    assert [scored.total for scored in ranked[:2]] == sorted((s.total for s in ranked[:2]), reverse=True)
