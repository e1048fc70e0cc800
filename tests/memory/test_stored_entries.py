import copy
import gc
import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.synthetic import synthetic_memory
from tests.memory.builders import entry
from tests.memory.memories import a_memory, same
from tests.memory.memory_files import edit_arrays, edit_entries, names

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.memory import io as module
from lerobot_openspm.memory.indexed_entries import IndexedEntries
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.memory.retrieval import semantic_score
from lerobot_openspm.memory.stored_entries import MAX_LINE_BYTES, StoredEntries, key_digest

MANY = tuple(entry(source=f"local/demos#{i}", quality=i / 10) for i in range(10))


@pytest.fixture
def entries(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 5)
    write_memory(a_memory(entries=MANY), tmp_path)
    return read_memory(tmp_path).entries


def test_a_large_memorys_entries_are_a_sequence_read_when_asked_for(entries):
    assert isinstance(entries, StoredEntries)
    assert len(entries) == 10
    assert same(tuple(entries), MANY)
    assert same(entries[3], MANY[3])
    assert same(entries[-1], MANY[-1])
    assert entries[3] is entries[3]
    assert same(tuple(entries[7:2:-2]), MANY[7:2:-2])
    with pytest.raises(IndexError):
        _ = entries[10]


def test_it_can_be_copied_and_sent_to_other_processes(entries):
    assert copy.deepcopy(entries) is entries
    assert same(pickle.loads(pickle.dumps(entries[2:4]))[1], MANY[3])


def test_superseded_entries_are_not_among_those_in_use(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 5)
    write_memory(a_memory(entries=MANY[:7], superseded=MANY[7:]), tmp_path)
    loaded = read_memory(tmp_path)
    assert [e.source for e in loaded.entries] == [e.source for e in MANY[:7]]
    assert [e.source for e in loaded.superseded] == [e.source for e in MANY[7:]]
    write_memory(loaded, tmp_path)
    assert same(tuple(read_memory(tmp_path).superseded), MANY[7:])


def test_what_is_open_stays_readable_when_a_newer_memory_is_saved(entries, tmp_path):
    write_memory(a_memory(), tmp_path)
    assert same(tuple(entries), MANY)


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
    stored = read_memory(tmp_path).entries
    for some, entries in (
        (stored, (*MANY, stove)),
        (stored[8:], (*MANY[8:], stove)),
        (stored[::-2], [*MANY, stove][::-2]),
        (pickle.loads(pickle.dumps(stored[5:9])), MANY[5:9]),
        (read_memory(tmp_path).superseded, MANY[:1]),
    ):
        assert some.keys.tolist() == [key_digest(one.key.sub_tasks) for one in entries]
        assert some.qualities.tolist() == [one.quality for one in entries]


@pytest.mark.parametrize("name", ["entries.keys", "entries.qualities"])
def test_columns_of_another_kind_are_refused(tmp_path, name):
    write_memory(a_memory(), tmp_path)
    edit_arrays(tmp_path, lambda arrays: arrays.update({name: arrays[name].astype(np.float32)}))
    with pytest.raises(MemoryFormatError, match=f"array '{name}' is float32"):
        read_memory(tmp_path)
    edit_arrays(tmp_path, lambda arrays: arrays.pop(name))
    with pytest.raises(MemoryFormatError, match=f"array '{name}' is missing"):
        read_memory(tmp_path)


@pytest.mark.parametrize(("name", "value"), [("qualities", [0.9, 0.1]), ("keys", [1, 2])])
def test_another_quality_or_key_than_the_entrys_is_refused(tmp_path, name, value):
    write_memory(a_memory(), tmp_path)
    name = f"entries.{name}"
    edit_arrays(tmp_path, lambda arrays: arrays.update({name: np.array(value, arrays[name].dtype)}))
    with pytest.raises(MemoryFormatError, match=r"entries\[\d\] has another key or quality"):
        read_memory(tmp_path)


def test_saving_again_makes_equal_files(entries, tmp_path):
    again = tmp_path / "again"
    write_memory(read_memory(tmp_path), again)
    assert [(again / name).read_bytes() for name in names(again)] == [
        (tmp_path / name).read_bytes() for name in names(tmp_path)
    ]


def test_one_entry_of_each_key_is_read_to_index_them(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 0)
    made = synthetic_memory(300, np.random.default_rng(0))
    write_memory(made, tmp_path)
    read = []
    text = StoredEntries._text
    monkeypatch.setattr(StoredEntries, "_text", lambda entries, row: read.append(row) or text(entries, row))
    indexed = IndexedEntries(read_memory(tmp_path).entries)
    assert len(read) == len({entry.key.sub_tasks for entry in made.entries}) == 3
    asked = made.entries[150].key.sub_tasks
    found = indexed.near(asked, semantic_score)
    expected = IndexedEntries(made.entries).near(asked, semantic_score)
    assert [entry.source for entry in found] == [entry.source for entry in expected]
    assert len(read) < 300


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


def test_a_file_truncated_after_it_was_loaded_is_an_error_and_no_crash(entries, tmp_path):
    os.truncate(tmp_path / "memory.json", 5000)
    for read in (lambda: entries[0], lambda: entries[9], lambda: list(entries[3:].lines())):
        with pytest.raises(MemoryFormatError, match=r"entries\[\d\] is not what its digest says: truncated"):
            read()


def test_the_file_is_open_once_and_closed_with_the_last_slice(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 5)
    write_memory(a_memory(entries=MANY), tmp_path)

    def n_open():
        links = [os.readlink(link) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
        return sum(str(tmp_path / "memory.json") in link for link in links)

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
    with pytest.raises(MemoryFormatError, match=rf"nothing was saved: .*<= 1000000000 - at `\$\.{name}`"):
        write_memory(a_memory(entries=(replace(most, **{name: 10**9 + 1}),)), tmp_path)
    assert same(read_memory(tmp_path).entries, (most,))
