import copy
import gc
import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.memory.builders import entry
from tests.memory.memories import a_memory, same
from tests.memory.memory_files import edit_arrays, edit_entries, name_of

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.memory import memory as module
from lerobot_openspm.memory.bank import MAX_LINE_BYTES, EntryBank
from lerobot_openspm.memory.columns import HasColumns, columns_of
from lerobot_openspm.memory.memory import read_memory, write_memory

MANY = tuple(entry(source=f"local/demos#{i}", quality=i / 10) for i in range(10))


@pytest.fixture
def bank(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 5)
    write_memory(a_memory(entries=MANY), tmp_path)
    return read_memory(tmp_path).entries


def test_a_large_memorys_entries_are_a_sequence_read_when_asked_for(bank):
    assert isinstance(bank, EntryBank)
    assert len(bank) == 10
    assert same(tuple(bank), MANY)
    assert same(bank[3], MANY[3])
    assert same(bank[-1], MANY[-1])
    assert bank[3] is bank[3]
    assert same(tuple(bank[7:2:-2]), MANY[7:2:-2])
    with pytest.raises(IndexError):
        _ = bank[10]


def test_it_can_be_copied_and_sent_to_other_processes(bank):
    for again in (copy.deepcopy(bank), pickle.loads(pickle.dumps(bank[2:4]))):
        assert same(again[1], MANY[1] if len(again) == 10 else MANY[3])


def test_superseded_entries_are_not_among_those_in_use(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 5)
    write_memory(a_memory(entries=MANY[:7], superseded=MANY[7:]), tmp_path)
    loaded = read_memory(tmp_path)
    assert [e.source for e in loaded.entries] == [e.source for e in MANY[:7]]
    assert [e.source for e in loaded.superseded] == [e.source for e in MANY[7:]]
    write_memory(loaded, tmp_path)
    assert same(tuple(read_memory(tmp_path).superseded), MANY[7:])


def test_what_is_open_stays_readable_when_a_newer_memory_is_saved(bank, tmp_path):
    write_memory(a_memory(), tmp_path)
    assert same(tuple(bank), MANY)


def test_an_entry_at_an_object_that_the_header_does_not_list_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 1)
    write_memory(a_memory(entries=MANY), tmp_path)

    def rename(rows):
        rows[2] = json.loads(json.dumps(rows[2]).replace("plate", "moon"))

    edit_entries(tmp_path, rename)
    entries = read_memory(tmp_path).entries
    with pytest.raises(MemoryFormatError, match=r"entries\[2\] has key poses at \['moon'\]"):
        tuple(entries)


def test_what_is_kept_to_find_entries_by_is_what_reading_them_would_say(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 5)
    stove = entry("put the bowl on the stove", source="local/demos#10", quality=0.25)
    write_memory(a_memory(entries=(*MANY, stove), superseded=MANY[:1]), tmp_path)
    bank = read_memory(tmp_path).entries
    assert isinstance(bank, HasColumns)
    for some, entries in (
        (bank, (*MANY, stove)),
        (bank[8:], (*MANY[8:], stove)),
        (bank[::-2], [*MANY, stove][::-2]),
    ):
        kept, made = columns_of(some), columns_of(entries)
        assert kept.digests.tolist() == made.digests.tolist()
        assert kept.qualities.tolist() == made.qualities.tolist()


@pytest.mark.parametrize("name", ["entries.keys", "entries.qualities"])
def test_columns_of_another_kind_are_refused(tmp_path, name):
    write_memory(a_memory(), tmp_path)
    edit_arrays(tmp_path, lambda arrays: arrays.update({name: arrays[name].astype(np.float32)}))
    with pytest.raises(MemoryFormatError, match=f"array '{name}' is float32"):
        read_memory(tmp_path)
    edit_arrays(tmp_path, lambda arrays: arrays.pop(name))
    with pytest.raises(MemoryFormatError, match=f"array '{name}' is missing"):
        read_memory(tmp_path)


def test_another_quality_than_the_entrys_is_refused(tmp_path):
    write_memory(a_memory(), tmp_path)
    edit_arrays(tmp_path, lambda arrays: arrays.update({"entries.qualities": np.array([0.9, 0.1])}))
    with pytest.raises(MemoryFormatError, match=r"entries\[1\] has another quality"):
        read_memory(tmp_path)


def test_an_entry_that_could_not_be_loaded_again_is_not_saved(tmp_path):
    write_memory(a_memory(), tmp_path)
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    long = replace(entry(), language="x" * MAX_LINE_BYTES)
    with pytest.raises(MemoryFormatError, match=rf"entries\[10\] has 400\d+ bytes.*up to {MAX_LINE_BYTES}"):
        write_memory(a_memory(entries=(*MANY, long)), tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in files} == files
    assert same(read_memory(tmp_path), a_memory())


def test_a_line_that_is_too_long_is_refused_with_what_is_expected(tmp_path):
    write_memory(a_memory(), tmp_path)
    edit_arrays(tmp_path, lambda arrays: arrays["entries.ends"].__iadd__(MAX_LINE_BYTES))
    with pytest.raises(MemoryFormatError, match=rf"expected 1 to {MAX_LINE_BYTES}.*pull it again"):
        read_memory(tmp_path)


def test_a_file_truncated_after_it_was_loaded_is_an_error_and_no_crash(bank, tmp_path):
    os.truncate(tmp_path / name_of(tmp_path, "entries"), 100)
    for read in (lambda: bank[0], lambda: bank[9], lambda: list(bank[3:].texts())):
        with pytest.raises(MemoryFormatError, match=r"entries\[\d\] has \d+ bytes, expected \d+: truncated"):
            read()


def test_the_file_is_open_once_and_closed_with_the_last_slice(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 5)
    write_memory(a_memory(entries=MANY), tmp_path)

    def n_open():
        links = [os.readlink(link) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
        return sum(str(tmp_path / "memory.entries") in link for link in links)

    entries = read_memory(tmp_path).entries
    part = entries[2:5]
    assert n_open() == 1
    del entries
    assert same(part[0], MANY[2])
    del part
    gc.collect()
    assert n_open() == 0


@pytest.mark.parametrize("name", ["version", "trials"])
def test_what_counts_further_than_is_read_again_is_not_saved(tmp_path, name):
    most = replace(entry(), **{name: 10**9})
    write_memory(a_memory(entries=(most,)), tmp_path)
    with pytest.raises(MemoryFormatError, match=rf"'{name}' 1000000001, expected up to 1e\+09"):
        write_memory(a_memory(entries=(replace(most, **{name: 10**9 + 1}),)), tmp_path)
    assert same(read_memory(tmp_path).entries, (most,))
