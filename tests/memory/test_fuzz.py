"""Files that were cut, changed or made up: an error of ours that names the file, or nothing is different."""

import re
from dataclasses import replace

import numpy as np
import pytest
from tests.memory.builders import robot
from tests.memory.memories import LAYOUTS, a_memory, merged_entry, same
from tests.memory.memory_files import names

from lerobot_openspm.errors import MemoryFormatError, OpenSPMError
from lerobot_openspm.memory import io as module
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.memory.stored_entries import StoredEntries


def whole():
    entries = (*a_memory().entries, merged_entry(source="local/demos#2", trials=3, successes=2))
    return a_memory(entries=entries, superseded=entries[:1], layouts=LAYOUTS)


@pytest.fixture
def saved(tmp_path):
    write_memory(whole(), tmp_path)
    return tmp_path


@pytest.fixture(params=["read at load", "read when asked for"])
def load(request, monkeypatch):
    """Load a memory and read every entry, as a small or as a large one is read."""
    if request.param == "read when asked for":
        monkeypatch.setattr(module, "READ_AT_LOAD", 0)

    def load(folder):
        loaded = read_memory(folder)
        assert isinstance(loaded.entries, StoredEntries) == (request.param == "read when asked for")
        return replace(loaded, entries=tuple(loaded.entries), superseded=tuple(loaded.superseded))

    return load


@pytest.mark.parametrize("index", range(2))
def test_a_file_cut_at_any_length_is_noticed(saved, load, index):
    path = saved / names(saved)[index]
    content = path.read_bytes()
    lengths = {round(i * len(content) / 50) for i in range(50)} | {1, 7, 8, 9, len(content) - 2}
    for length in sorted(lengths):
        path.write_bytes(content[:length])
        with pytest.raises(OpenSPMError, match=re.escape(str(path))):
            load(saved)


def flips(content, count=200):
    """The content with single bytes changed, in so many places; each with another bit."""
    for i, place in enumerate(np.linspace(0, len(content) - 1, count).astype(int)):
        spoilt = bytearray(content)
        spoilt[place] ^= 1 << (i % 8)
        yield bytes(spoilt)


@pytest.mark.parametrize("index", range(2))
def test_a_flipped_byte_is_noticed_or_changes_nothing(saved, load, index):
    path, original = saved / names(saved)[index], whole()
    messages = []
    for spoilt in flips(path.read_bytes()):
        path.write_bytes(spoilt)
        try:
            loaded = load(saved)
        except OpenSPMError as error:
            messages.append(str(error))
        else:
            assert same(loaded, original)
    assert all(str(saved / "memory") in message or str(path) in message for message in messages)
    # What may change unnoticed are the line breaks between entries.
    assert len(messages) >= 195


def test_an_entry_that_is_never_read_costs_nothing_and_the_others_can_be_used(saved, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 0)
    path = saved / "memory.json"
    content = path.read_bytes()
    path.write_bytes(content.replace(b"local/demos#1", b"local/demos#9"))
    entries = read_memory(saved).entries
    assert [entries[0].source, entries[2].source] == ["local/demos#0", "local/demos#2"]
    with pytest.raises(MemoryFormatError, match=r"entries\[1\] is not what its digest says"):
        _ = entries[1]


def test_another_robots_memory_is_not_appended():
    ours, turned = a_memory(layouts=LAYOUTS), a_memory(layouts=LAYOUTS[::-1])
    with pytest.raises(MemoryFormatError, match=r"'layouts'.*different robots"):
        ours.appended(turned)
    with pytest.raises(MemoryFormatError, match="close_command"):
        ours.appended(a_memory(robot=robot(close_command=-1.0, open_command=1.0)))
    # A memory that does not know its robot's layout learns it.
    assert a_memory(layouts=None).appended(ours).layouts == LAYOUTS
