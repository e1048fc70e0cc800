from dataclasses import replace

import pytest
from tests.memory.builders import entry, semantic_candidates

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory import retrieval
from lerobot_openspm.memory.retrieval import (
    MARGIN,
    retrieve,
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


def test_only_matching_entries_are_candidates_each_with_its_score(monkeypatch):
    exact, other = entry("put the wine bottle on the rack"), entry("put the bowl on the plate")
    near = entry("place the wine bottle on the left rack")
    found = semantic_candidates("put the wine bottle on the rack", [other, near, exact, exact])
    assert [item[0] for item in found] == [near, exact, exact]
    assert found[1][1] == pytest.approx(1)
    assert 0.75 <= found[0][1] < 1
    # The weight of semantics decides against a nearer match in another respect, or not.
    better_place = {id(near): 1.0}
    for weight, first in ((5.0, exact), (0.1, near)):
        monkeypatch.setattr(retrieval, "LAMBDAS", (weight, 0.5, 0.0))
        ranked = retrieve(found, lambda e: better_place.get(id(e), 0.5))
        assert ranked[0].entry is first


@pytest.mark.parametrize(
    ("asked", "rival"),
    [
        ("put the cup on the tray", "put the mug on the tray"),
        ("put the mug on the tray", "put the cup on the tray"),
        ("put the bowl on the plate", "put the black bowl on the plate"),
        ("put the can in the right bin", "put the can in the left bin"),
        ("put block a on block b", "put block b on block a"),
        ("wipe the table", "wipe the table with the sponge"),
        ("pull the lever", "push the lever"),
    ],
)
def test_what_is_meant_acts_whatever_the_scene_and_the_quality_say_for_another(asked, rival):
    meant, other = entry(asked, quality=0.0), entry(rival, quality=1.0)
    found = semantic_candidates(asked, [other, meant])
    for geometry in (0.1, 0.0):
        scene = {id(meant): geometry, id(other): 1.0}
        ranked = retrieve(found, lambda e, scene=scene: scene[id(e)])
        assert ranked[0].entry is meant


def test_another_name_finds_a_thing_that_the_memory_does_not_know_by_it():
    mug, cup = entry("put the mug on the tray"), entry("put the cup on the tray")
    asked = "set the cup on the tray"
    assert [item[0] for item in semantic_candidates(asked, [mug])] == [mug]
    assert [item[0] for item in semantic_candidates(asked, [mug, cup])] == [cup]
    with pytest.raises(InstructionError, match="holds no entry"):  # it holds the two apart
        semantic_candidates("put the cup on the shelf", [cup, entry("put the mug on the shelf")])


def test_the_words_of_a_demonstration_find_it_however_it_was_read():
    shown = replace(entry("put the bowl on the plate"), language="do the usual thing")
    assert semantic_candidates("please do the usual thing", [shown]) == [(shown, 1.0)]


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


def rank(geometric=lambda entry: SCORES[entry.source][1]):
    entries = [
        (entry(quality=0.9 if source == "quality" else 0.2, source=source), semantic)
        for source, (semantic, _) in SCORES.items()
    ]
    return retrieve(entries, geometric)


@pytest.mark.parametrize("term", ["semantic", "geometric", "quality"])
def test_the_weight_of_a_term_decides_for_the_entry_that_is_best_in_it(monkeypatch, term):
    monkeypatch.setattr(retrieval, "LAMBDAS", tuple(10.0 if name == term else 0.1 for name in SCORES))
    assert rank()[0].entry.source == term


def test_the_score_is_the_papers_sum(monkeypatch):
    monkeypatch.setattr(retrieval, "LAMBDAS", (2.0, 3.0, 5.0))
    for scored in rank():
        assert (scored.semantic, scored.geometric) == SCORES[scored.entry.source]
        assert scored.quality == scored.entry.quality
        assert scored.total == pytest.approx(2 * scored.semantic + 3 * scored.geometric + 5 * scored.quality)


@pytest.mark.parametrize("weights", [retrieval.LAMBDAS, (100, 0, 0), (0, 0, 100)])
def test_an_entry_that_cannot_be_executed_comes_last_whatever_the_weights(monkeypatch, weights):
    monkeypatch.setattr(retrieval, "LAMBDAS", weights)
    best = rank()[0].entry.source
    ranked = rank(lambda entry: 0.0 if entry.source == best else 0.01)
    assert ranked[-1].entry.source == best
    assert ranked[-1].geometric == 0
    assert [scored.total for scored in ranked[:2]] == sorted((s.total for s in ranked[:2]), reverse=True)


def first(instruction, entries):
    found = semantic_candidates(instruction, entries)
    return max(found, key=lambda item: item[1])[0]


def test_the_entry_with_the_same_reference_comes_first_but_the_others_may_serve():
    stove, box, plain = (
        entry(f"pick up the bowl {where}and put it on the plate")
        for where in ("on the stove ", "next to the box ", "")
    )
    for asked, best in (
        ("the bowl on the stove", stove),
        ("the bowl beside the box", box),
        ("the bowl", plain),
    ):
        instruction = f"put {asked} onto the plate"
        assert first(instruction, [stove, box, plain]) is best
        assert len(semantic_candidates(instruction, [stove, box, plain])) == 3


def test_another_reference_is_a_smaller_loss_than_another_relation_or_object():
    known = "pick up the bowl on the stove and put it on the plate"
    other_where = score("pick up the bowl on the rack and put it on the plate", known)
    other_relation = score("pick up the bowl on the stove and put it next to the plate", known)
    other_object = score("pick up the box on the stove and put it on the plate", known)
    assert 1 > other_where > 0.75 > other_relation > other_object == 0


@pytest.mark.parametrize(
    ("instruction", "known"),
    [
        ("open the drawer", ["open the top drawer", "open the middle drawer"]),
        ("put the mug on the plate", ["put the red mug on the plate", "put the white mug on the plate"]),
        (
            "put the sauce in the basket",
            ["put the bbq sauce in the basket", "put the tomato sauce in the basket"],
        ),
    ],
)
def test_what_may_mean_two_things_is_not_guessed(instruction, known):
    entries = [entry(language) for language in known]
    with pytest.raises(InstructionError, match="may mean different things") as caught:
        semantic_candidates(instruction, entries)
    assert all(repr(language) in str(caught.value) for language in known)
    # Where only one of them is known it is meant, and so is what is said in its very words.
    assert first(instruction, [entries[0], entries[0]]) is entries[0]
    assert first(known[1], entries) is entries[1]


def test_of_two_things_that_fit_nearly_as_well_none_is_guessed():
    red = "pick up the red mug on the stove and put it on the plate"
    white = "put the white mug on the plate"
    asked = "pick up the mug on the rack and put it on the plate"
    assert 0.75 < score(asked, red) < score(asked, white) < score(asked, red) + MARGIN
    with pytest.raises(InstructionError, match="may mean different things") as caught:
        semantic_candidates(asked, [entry(red), entry(white)])
    assert all(repr(language) in str(caught.value) for language in (red, white))


def test_only_what_means_the_same_as_the_best_is_a_candidate():
    bowl, black = entry("put the bowl on the plate"), entry("put the black bowl on the plate")
    white = entry("put the white bowl on the plate")
    assert [item[0] for item in semantic_candidates("put the black bowl on the plate", [black, white])] == [
        black
    ]
    red = entry("pick up the red bowl on the stove and put it on the plate")
    # Where nothing is said of a stove the white one is meant, and the red one is none of it.
    assert [item[0] for item in semantic_candidates("put the bowl on the plate", [red, white])] == [white]
    with pytest.raises(InstructionError, match="did you mean 'put the bowl on the plate'"):
        semantic_candidates("put the blue bowl on the plate", [bowl])


def test_the_order_counts_where_it_matters():
    soup, sauce = "put the soup in the basket", "put the sauce in the basket"
    assert 0.9 < score(f"{sauce} and {soup}", f"{soup} and {sauce}") < 1
    opened, filled = "open the microwave", "put the cup in the microwave"
    assert score(f"{filled} and {opened}", f"{opened} and {filled}") == 0
    assert score("put the bowl on the plate and put the plate on the stove", "put the plate on the stove "
                 "and put the bowl on the plate") == 0  # fmt: skip


def test_what_was_pushed_somewhere_may_be_asked_to_be_put_there_but_not_the_other_way_round():
    pushed, was_put = "push the plate in front of the stove", "put the plate in front of the stove"
    assert 0.75 < score(was_put, pushed) < 1
    assert score(pushed, was_put) == 0
