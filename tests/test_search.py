import pytest
from tests.memory.builders import entry

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.memory.retrieval import ScoreWeights
from lerobot_openspm.search import search_memory

BOWL, STOVE = "put the bowl on the plate", "turn on the stove"
BANK = (
    entry(STOVE, source="stove", quality=1.0),
    entry(BOWL, source="poor", quality=0.2),
    entry(BOWL, source="good", quality=0.8),
    entry("put the bowl on the rack", source="rack", quality=0.4),
)


def sources(hits):
    return [hit.entry.source for hit in hits]


def test_what_retrieval_considers_comes_first_by_its_score():
    found = search_memory("place the bowl onto the plate", BANK, ScoreWeights(semantic=2.0, quality=0.5))
    assert (found.considered, found.refusal, found.status, found.seen) == (2, "", "", {})
    assert sources(found.hits[:2]) == ["good", "poor"]
    best = found.hits[0]
    assert (best.semantic, best.geometric) == (pytest.approx(1), None)
    assert best.total == pytest.approx(2.0 * 1 + 0.5 * 0.8)
    assert (found.asked[0].target, found.asked[0].landmark) == ("bowl", "plate")


def test_then_comes_the_best_entry_of_each_other_task_the_nearest_first():
    found = search_memory(BOWL, BANK, ScoreWeights())
    assert sources(found.hits[2:]) == ["rack", "stove"]


def test_where_nothing_is_considered_the_reason_and_the_nearest_are_named():
    found = search_memory("put the mug on the plate", BANK, ScoreWeights())
    assert found.considered == 0
    assert "the memory holds no experience for the instruction 'put the mug on the plate'" in found.refusal
    assert sources(found.hits) == ["good", "rack", "stove"]
    assert all(hit.semantic == 0 for hit in found.hits)


def test_what_cannot_be_read_is_an_error():
    with pytest.raises(InstructionError, match="sing a song"):
        search_memory("sing a song", BANK, ScoreWeights())


def test_an_empty_memory_knows_nothing():
    found = search_memory(BOWL, (), ScoreWeights())
    assert found.hits == ()
    assert "nothing yet" in found.refusal
