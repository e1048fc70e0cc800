import numpy as np
import pytest
from tests.memory.builders import entry

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.instruction import parse_instruction
from lerobot_openspm.memory.retrieval import (
    ScoreWeights,
    layout_similarity,
    retrieve,
    semantic_candidates,
    semantic_score,
)


def layout(distance=0.2, shift=(0.0, 0.0), yaw=0.0):
    """Bowl and plate `distance` apart."""
    G = se3.from_yaw([*shift, 0.0], yaw)
    return {
        "bowl": G @ se3.from_yaw([0, 0, 0], 0.0),
        "plate": G @ se3.from_yaw([distance, 0, 0], 0.0),
    }


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


def test_only_the_best_matching_entries_are_candidates():
    exact, other = entry("put the wine bottle on the rack"), entry("put the bowl on the plate")
    near = entry("put the bottle on the rack")
    found = semantic_candidates("put the wine bottle on the rack", [other, near, exact, exact])
    assert [item[0] for item in found] == [exact, exact]
    assert found[0][1] == pytest.approx(1)


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


def test_layouts_are_compared_by_where_objects_stand_to_one_another():
    assert layout_similarity(layout(), layout()) == 1
    assert layout_similarity(layout(shift=(0.3, -0.1)), layout()) == pytest.approx(1)
    # Each of the two stands 0.05 m nearer to the middle.
    assert layout_similarity(layout(0.3), layout(0.2)) == pytest.approx(np.exp(-0.05 / 0.15))
    assert layout_similarity(layout(0.5), layout(0.2)) < layout_similarity(layout(0.3), layout(0.2))
    assert layout_similarity({"cup": np.eye(4)}, layout()) == 0
    alone = {"bowl": se3.from_yaw([0.15, 0, 0], 0.0)}
    assert layout_similarity(alone, layout()) == pytest.approx(np.exp(-1))


def rank(weights, feasible=lambda _: True, present=None):
    """Three entries, each the best in one term of the score."""
    entries = {
        "semantic": (entry(layout=layout(0.5), quality=0.2, source="semantic"), 1.0),
        "geometric": (entry(layout=layout(0.2), quality=0.2, source="geometric"), 0.8),
        "quality": (entry(layout=layout(0.5), quality=0.9, source="quality"), 0.8),
    }
    scored = retrieve(list(entries.values()), layout() if present is None else present, feasible, weights)
    return scored


@pytest.mark.parametrize("term", ["semantic", "geometric", "quality"])
def test_the_weight_of_a_term_decides_for_the_entry_that_is_best_in_it(term):
    weights = {"semantic": 0.1, "geometric": 0.1, "quality": 0.1, term: 10.0}
    assert rank(ScoreWeights(**weights))[0].entry.source == term


def test_the_score_is_the_papers_sum():
    for scored in rank(ScoreWeights(2.0, 3.0, 5.0)):
        total = 2 * scored.semantic + 3 * scored.geometric + 5 * scored.quality
        assert scored.total == pytest.approx(total)
    geometric = {scored.entry.source: scored.geometric for scored in rank(ScoreWeights())}
    assert geometric["geometric"] == pytest.approx(1)
    assert geometric["semantic"] == pytest.approx(0.5 + 0.5 * np.exp(-1))


@pytest.mark.parametrize("weights", [ScoreWeights(), ScoreWeights(100, 0, 0), ScoreWeights(0, 0, 100)])
def test_an_entry_that_cannot_be_executed_comes_last_whatever_the_weights(weights):
    best = rank(weights)[0].entry.source
    ranked = rank(weights, feasible=lambda e: e.source != best)
    assert ranked[-1].entry.source == best
    assert ranked[-1].geometric == 0


def test_an_entry_whose_object_is_not_found_is_not_even_checked():
    def feasible(_):
        raise AssertionError("transfer needs every object")

    ranked = rank(ScoreWeights(), feasible, {"bowl": np.eye(4)})
    assert [scored.geometric for scored in ranked] == [0, 0, 0]
