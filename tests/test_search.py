import pytest
from tests.language.text_model import make_model
from tests.memory.builders import entry
from tests.memory.test_compound import drawer_entry

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.names import names_from
from lerobot_openspm.search import search_memory

BOWL, STOVE = "put the bowl on the plate", "turn on the stove"
MEMORY = (
    entry(STOVE, source="stove", quality=1.0),
    entry(BOWL, source="poor", quality=0.2),
    entry(BOWL, source="good", quality=0.8),
    entry("put the bowl on the rack", source="rack", quality=0.4),
)


def sources(hits):
    return [hit.entry.source for hit in hits]


def test_what_retrieval_considers_is_ordered_by_its_score():
    found = search_memory("place the bowl onto the plate", MEMORY)
    assert (found.refusal, found.status, found.seen) == ("", "", {})
    (part,) = found.parts
    assert sources(part) == ["good", "poor"]
    best = part[0]
    assert (best.semantic, best.geometric) == (pytest.approx(1), None)
    assert best.total == pytest.approx(1.0 * 1 + 0.5 * 0.8)
    assert (found.asked[0].target, found.asked[0].landmark) == ("bowl", "plate")


def test_then_comes_the_best_entry_of_each_other_task_the_nearest_first():
    found = search_memory(BOWL, MEMORY)
    assert sources(found.others) == ["rack", "stove"]


def test_where_nothing_is_considered_the_reason_and_the_nearest_are_named():
    found = search_memory("put the mug on the plate", MEMORY)
    assert found.parts == ()
    assert "the memory holds no entry for the instruction 'put the mug on the plate'" in found.refusal
    assert sources(found.others) == ["good", "rack", "stove"]
    assert all(hit.semantic == 0 for hit in found.others)


def test_an_instruction_of_which_only_the_parts_are_known_is_found_part_by_part():
    both = drawer_entry(source="both")
    found = search_memory(f"open the top drawer and {BOWL}", (*MEMORY, both))
    assert found.refusal == ""
    opened, placed = found.parts
    assert [(hit.entry.language, hit.sources[0] is both) for hit in opened] == [
        ("open the top drawer of the cabinet", True)
    ]
    assert sources(placed) == ["good", "poor"]
    assert all(hit.sources[0] is hit.entry for hit in placed)
    assert sorted(sources(found.others)) == ["rack", "stove"]
    refused = search_memory(f"open the bottom drawer and {BOWL}", MEMORY)
    assert (refused.parts, "is a part of the instruction" in refused.refusal) == ((), True)


def test_names_that_embeddings_alone_know_are_found(tmp_path):
    model = make_model(tmp_path, {"tureen": (1.0, 0.1), "bowl": (1.0, 0.0), "plate": (0.0, 1.0)})
    instruction = "put the tureen on the plate"
    assert search_memory(instruction, MEMORY).parts == ()
    found = search_memory(instruction, MEMORY, names_from(str(model)))
    assert [sources(part) for part in found.parts] == [["good", "poor"]]


def test_what_cannot_be_read_is_refused_and_says_why():
    found = search_memory("sing a song", MEMORY)
    assert found.parts == ()
    assert "no verb I know in 'sing a song'" in found.refusal
    assert "it knows: " in found.refusal
    with pytest.raises(InstructionError, match="says nothing"):
        search_memory("...", MEMORY)


def test_an_empty_memory_knows_nothing():
    found = search_memory(BOWL, ())
    assert (found.parts, found.others) == ((), ())
    assert "nothing yet" in found.refusal
