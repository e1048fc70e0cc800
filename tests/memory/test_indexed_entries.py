from dataclasses import replace

import numpy as np
import pytest
from benchmarks.synthetic import distinct_keys, said_otherwise
from tests.memory.builders import entry, semantic_candidates

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory import indexed_entries as module
from lerobot_openspm.memory.entry import RetrievalKey
from lerobot_openspm.memory.indexed_entries import (
    ENTRIES_IN_ALL,
    ENTRIES_PER_KEY,
    INDEX_FROM,
    IndexedEntries,
    indexed,
    near,
)
from lerobot_openspm.memory.retrieval import MIN_SEMANTIC, semantic_score
from lerobot_openspm.memory.stored_entries import key_digest
from lerobot_openspm.types import SubTask

BOWL, STOVE = "put the bowl on the plate", "turn on the stove"
DIGEST_OF_BOWL = 9109827965828624359
DRAWER = "open the top drawer and put the bowl inside"


def entries_of(keys, qualities=None):
    """An entry for every key, numbered in its source."""
    template = entry()
    qualities = np.linspace(0, 1, len(keys)) if qualities is None else qualities
    return [
        replace(template, key=RetrievalKey(key, ("approach",)), quality=float(quality), source=f"entries#{i}")
        for i, (key, quality) in enumerate(zip(keys, qualities, strict=True))
    ]


def sources(entries):
    return [one.source for one in entries]


@pytest.fixture(scope="module")
def many():
    return entries_of(distinct_keys(INDEX_FROM + 500, np.random.default_rng(0)))


def test_it_is_the_sequence_it_indexes(many):
    entries = IndexedEntries(many)
    assert len(entries) == len(many)
    assert entries[3] is many[3]
    assert entries[2:5] == many[2:5]
    assert list(entries) == many


def test_small_banks_are_left_as_they_are(many):
    few = tuple(many[:INDEX_FROM])
    assert indexed(few) is few
    assert near(parse_instruction(BOWL), few, semantic_score) is few
    entries = indexed(many)
    assert isinstance(entries, IndexedEntries)
    assert indexed(entries) is entries


def test_the_best_by_meaning_is_near_however_it_is_said(many):
    rng = np.random.default_rng(1)
    entries, reached = IndexedEntries(many), []
    for i in rng.integers(len(many), size=40):
        asked = said_otherwise(many[i].key.sub_tasks, rng)
        best = max(semantic_score(asked, one.key.sub_tasks) for one in many)
        found = entries.near(asked, semantic_score)
        reached.append(max(semantic_score(asked, one.key.sub_tasks) for one in found) == best)
    assert np.mean(reached) >= 0.95


def test_retrieval_is_that_of_all_entries(many):
    known = [*many, entry(BOWL), entry(STOVE), entry("put the bowl next to the plate")]
    expected, found = (semantic_candidates(BOWL, entries) for entries in (known, indexed(known)))
    order = lambda pairs: sorted((one.source, one.language, score) for one, score in pairs)  # noqa: E731
    assert order(found) == order(expected)
    assert [one.language for one, _ in found] == [BOWL]


def test_what_is_unknown_is_refused_with_what_is_nearest(many):
    with pytest.raises(InstructionError, match="holds no entry"):
        semantic_candidates("put the trombone on the xylophone", indexed(many))


def test_a_bank_may_be_empty():
    assert IndexedEntries([]).near(parse_instruction(BOWL), semantic_score) == []


def test_of_equal_keys_the_best_are_handed_on(many):
    rng = np.random.default_rng(2)
    qualities = rng.random(5000)
    same = [
        replace(one, source=f"same#{i}")
        for i, one in enumerate(entries_of([parse_instruction(BOWL)] * 5000, qualities))
    ]
    found = IndexedEntries([*many, *same]).near(parse_instruction(BOWL), semantic_score)
    best = [f"same#{i}" for i in np.argsort(-qualities)[:ENTRIES_PER_KEY]]
    assert sources(found)[:ENTRIES_PER_KEY] == best
    assert not set(sources(found)[ENTRIES_PER_KEY:]) & {one.source for one in same}


def test_no_more_than_so_many_in_all_but_one_of_every_key():
    keys = [key for key in distinct_keys(40, np.random.default_rng(0)) if len(key) == 1]
    entries = IndexedEntries(entries_of(keys * 100))
    found = entries.near(keys[3], lambda asked, known: 1.0 if asked == known else 0.5)
    assert len(found) == ENTRIES_IN_ALL
    assert {one.key.sub_tasks for one in found} == set(keys)
    assert [one.key.sub_tasks for one in found[:ENTRIES_PER_KEY]] == [keys[3]] * ENTRIES_PER_KEY


def test_of_keys_about_something_else_one_entry_is_handed_on():
    keys = [key for key in distinct_keys(40, np.random.default_rng(0)) if len(key) == 1]
    found = IndexedEntries(entries_of(keys * 100)).near(keys[3], lambda asked, known: float(asked == known))
    assert len(found) == ENTRIES_PER_KEY + len(keys) - 1
    assert {one.key.sub_tasks for one in found} == set(keys)


def test_parts_are_found_in_either_direction():
    filler = entries_of(distinct_keys(300, np.random.default_rng(0)))
    whole, part = entry(DRAWER, source="whole"), entry("open the top drawer", source="part")
    entries = IndexedEntries([*filler, whole, part])
    inside = parse_instruction(DRAWER)[1]
    assert sources(entries.near([inside], semantic_score))[:1] != ["part"]
    assert "whole" in sources(entries.near([inside], semantic_score))
    assert sources(entries.near(parse_instruction("open the top drawer"), semantic_score))[0] == "part"
    chain = sources(entries.near(parse_instruction(DRAWER), semantic_score))
    assert chain[0] == "whole"
    assert "part" in chain


def test_digests_tell_keys_apart_and_are_the_same_everywhere(many):
    assert len({key_digest(one.key.sub_tasks) for one in many}) == len(many)
    assert key_digest((SubTask("put", "bowl", "", "on", "plate"),)) == DIGEST_OF_BOWL


def test_the_gate_of_retrieval_holds_for_what_is_near(many):
    asked = many[11].key.sub_tasks
    found = IndexedEntries(many).near(asked, semantic_score)
    scores = [semantic_score(asked, one.key.sub_tasks) for one in found]
    assert scores[0] == pytest.approx(1)
    assert min(scores) < MIN_SEMANTIC
    assert len(found) >= module.NEAREST_KEYS
