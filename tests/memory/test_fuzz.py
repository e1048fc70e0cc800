"""Files that were cut, changed or made up: an error of ours that names the file, or nothing is different."""

import re
from dataclasses import replace

import numpy as np
import pytest
from tests.memory.builders import robot
from tests.memory.memories import LAYOUTS, a_memory, merged_entry, same
from tests.memory.memory_files import edit_header, name_of, names
from tests.memory.old_format import save_version_4

from lerobot_openspm.errors import MemoryFormatError, OpenSPMError
from lerobot_openspm.memory import memory as module
from lerobot_openspm.memory.bank import EntryBank
from lerobot_openspm.memory.memory import VERSION, read_memory, write_memory

OLD_NAMES = ("memory.json", "memory.safetensors", "cameras.json")


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
        assert isinstance(loaded.entries, EntryBank) == (request.param == "read when asked for")
        return replace(loaded, entries=tuple(loaded.entries), superseded=tuple(loaded.superseded))

    return load


@pytest.mark.parametrize("index", range(4))
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


@pytest.mark.parametrize("index", range(4))
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
    # What may change unnoticed are the spaces and line breaks between things.
    assert len(messages) >= (100 if path.name == "memory.json" else 190)


@pytest.mark.parametrize("name", OLD_NAMES[1:])
def test_a_flipped_byte_in_an_old_memorys_arrays_is_noticed_and_in_its_calibration_ends_well(tmp_path, name):
    save_version_4(a_memory(), tmp_path)
    path = tmp_path / name
    messages = []
    for spoilt in flips(path.read_bytes()):
        path.write_bytes(spoilt)
        try:
            loaded = read_memory(tmp_path)
        except OpenSPMError as error:
            messages.append(str(error))
        else:
            assert name == "cameras.json"  # nothing vouched for it then
            assert same(replace(loaded, cameras={}), a_memory(cameras={}))
    assert messages
    assert all(str(path) in message for message in messages)


def test_a_flipped_byte_in_an_old_memorys_json_never_ends_in_another_error(tmp_path):
    """Nothing vouched for the JSON until version 4; but what is read from it is sound."""
    save_version_4(a_memory(), tmp_path)
    path = tmp_path / "memory.json"
    messages = []
    for spoilt in flips(path.read_bytes(), 300):
        path.write_bytes(spoilt)
        try:
            loaded = read_memory(tmp_path)
        except MemoryFormatError as error:
            messages.append(str(error))
        else:
            assert all(0 <= e.quality <= 1 and e.key_poses for e in loaded.entries)
            assert np.isfinite(loaded.robot.workspace).all()
            assert [p.phase for e in loaded.entries for p in e.key_poses]
    assert len(messages) > 100
    assert all(message.startswith(str(tmp_path)) for message in messages)


@pytest.mark.parametrize("name", OLD_NAMES)
def test_an_old_memorys_file_cut_at_any_length_is_noticed(tmp_path, name):
    save_version_4(a_memory(), tmp_path)
    path = tmp_path / name
    content = path.read_bytes()
    for i in range(50):
        path.write_bytes(content[: round(i * len(content) / 50)])
        with pytest.raises(OpenSPMError, match=re.escape(str(path))):
            read_memory(tmp_path)


def test_a_newer_version_asks_for_an_upgrade_whatever_else_it_holds(saved):
    def newer(header):
        header.clear()
        header.update(format="openspm-memory", version=VERSION + 1, something="new")

    edit_header(saved, newer)
    with pytest.raises(MemoryFormatError, match=rf"version {VERSION + 1}.*upgrade"):
        read_memory(saved)


def test_an_entry_that_is_never_read_costs_nothing_and_the_others_can_be_used(saved, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 0)
    path = saved / name_of(saved, "entries")
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
    # A memory of before version 5 does not know its robot's layout, and learns it.
    assert a_memory(layouts=None).appended(ours).layouts == LAYOUTS
