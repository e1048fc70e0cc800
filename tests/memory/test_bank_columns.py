"""Digests of keys and qualities, kept with the entries of a large bank."""

import pickle

import numpy as np
import pytest
from benchmarks.synthetic import synthetic_memory
from tests.memory.memories import a_memory

from lerobot_openspm.memory import memory as module
from lerobot_openspm.memory.bank import EntryBank
from lerobot_openspm.memory.columns import columns_of
from lerobot_openspm.memory.indexed_entries import IndexedEntries
from lerobot_openspm.memory.memory import read_memory, write_memory
from lerobot_openspm.memory.retrieval import semantic_score


@pytest.fixture
def large(monkeypatch, tmp_path):
    """A memory of which no entry is read when it is loaded."""
    monkeypatch.setattr(module, "READ_AT_LOAD", 0)
    made = synthetic_memory(300, np.random.default_rng(0))
    write_memory(made, tmp_path)
    return made, tmp_path


def same(a, b):
    return np.array_equal(a.digests, b.digests) and np.array_equal(a.qualities, b.qualities)


def test_columns_are_those_of_the_entries(large):
    made, folder = large
    bank = read_memory(folder).entries
    assert isinstance(bank, EntryBank)
    assert same(bank.columns(), columns_of(made.entries))
    assert same(bank[5:40:3].columns(), columns_of(made.entries[5:40:3]))
    assert same(pickle.loads(pickle.dumps(bank[5:9])).columns(), columns_of(made.entries[5:9]))


def test_saving_again_takes_them_along(large, tmp_path):
    _, folder = large
    write_memory(read_memory(folder), tmp_path / "again")
    names = [sorted(file.name for file in where.glob("memory.*")) for where in (folder, tmp_path / "again")]
    assert names[0] == names[1]


def test_superseded_entries_have_theirs(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READ_AT_LOAD", 0)
    known = a_memory()
    write_memory(type(known)(**{**vars(known), "superseded": known.entries[:1]}), tmp_path)
    loaded = read_memory(tmp_path)
    assert same(loaded.entries.columns(), columns_of(known.entries))
    assert same(loaded.superseded.columns(), columns_of(known.entries[:1]))


def test_one_entry_of_each_key_is_read_to_index_them(large, monkeypatch):
    made, folder = large
    read = []
    text = EntryBank._text
    monkeypatch.setattr(EntryBank, "_text", lambda bank, row: read.append(row) or text(bank, row))
    indexed = IndexedEntries(read_memory(folder).entries)
    assert len(read) == len({entry.key.sub_tasks for entry in made.entries}) == 3
    asked = made.entries[150].key.sub_tasks
    found = indexed.near(asked, semantic_score)
    expected = IndexedEntries(made.entries).near(asked, semantic_score)
    assert [entry.source for entry in found] == [entry.source for entry in expected]
    assert len(read) < 300
