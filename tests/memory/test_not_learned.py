"""Records of what could not be learned, in a memory and its file."""

from dataclasses import replace
from pathlib import Path

import pytest
from tests.memory.memories import a_memory
from tests.memory.memory_files import edit_header

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.memory.not_learned import MAX_RECORDS, NotLearned, not_learned

BOWL = "put the bowl on the plate"
TOLD = (
    NotLearned("object", "black bowl", 10, "no two cameras show it at once"),
    NotLearned("demonstrations", "plate", 2, "the first picture does not show it clearly"),
    NotLearned("instruction", BOWL, 1, "what they handle is not known: 'black bowl'"),
)


def test_records_are_kept_with_the_memory(tmp_path: Path):
    write_memory(a_memory(not_learned=TOLD), tmp_path)
    assert read_memory(tmp_path).not_learned == TOLD


@pytest.mark.parametrize(
    "change",
    [
        {"what": "robot"}, {"name": ""}, {"name": "a\nb"}, {"name": "x" * 1001}, {"demonstrations": -1},
        {"reason": 3}, {"more": 1},
    ],
)  # fmt: skip
def test_malformed_records_are_refused(tmp_path: Path, change: dict):
    write_memory(a_memory(not_learned=TOLD), tmp_path)
    edit_header(tmp_path, lambda header: header["not_learned"][0].update(change))
    with pytest.raises(MemoryFormatError, match="not_learned"):
        read_memory(tmp_path)


def test_more_records_than_are_kept_are_refused(tmp_path: Path):
    write_memory(a_memory(not_learned=TOLD), tmp_path)
    edit_header(tmp_path, lambda header: header.update(not_learned=header["not_learned"] * MAX_RECORDS))
    with pytest.raises(MemoryFormatError, match="not_learned"):
        read_memory(tmp_path)


@pytest.mark.parametrize("text", ["put it\tthere\n now", "a\x00b\ud800", "\x00", "long " * 1000])
def test_any_text_makes_a_record_that_can_be_read_again(tmp_path: Path, text: str):
    told = not_learned("instruction", text, 1, text)
    write_memory(a_memory(not_learned=(told,)), tmp_path)
    assert read_memory(tmp_path).not_learned == (told,)


def test_what_is_learned_later_is_struck_off():
    older = a_memory(not_learned=TOLD)
    bowl = a_memory().objects["bowl"]
    newer = a_memory(objects={"black bowl": bowl}, entries=(replace(a_memory().entries[0], language=BOWL),))
    assert older.appended(newer).not_learned == (TOLD[1],)
    again = NotLearned("object", "black bowl", 2, "the cameras disagree about where it is")
    other = a_memory(objects={}, entries=a_memory().entries[1:], not_learned=(again,))
    assert older.appended(other).not_learned == (again, *TOLD[1:])
