"""The measures of large memories, on few entries."""

import numpy as np
import pytest
from benchmarks.synthetic import distinct_keys, said_otherwise, synthetic_memory

from benchmarks import memory
from lerobot_openspm.memory import index
from lerobot_openspm.memory.key_vector import key_vector

KEYS = (
    "entries",
    "n",
    "query_ms_p50",
    "query_ms_p99",
    "recall",
    "loaded_entries",
    "load_s",
    "exact_entries",
    "exact_ms_p50",
)


def test_it_tells_what_it_measured(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(index, "EXACT_LIMIT", 2000)
    monkeypatch.setattr(memory, "SEMANTIC_ENTRIES", 1000)
    measured = memory.measure(memory.MemoryConfig(entries=3000, queries=50, threads=1, loaded=200))
    assert tuple(measured)[: len(KEYS)] == KEYS
    assert (measured["entries"], measured["n"], measured["loaded_entries"]) == (3000, 50, 200)
    assert measured["tasks"]["index"] == measured["uniform"]["index"] == "faiss"
    assert 0 < measured["query_ms_p50"] <= measured["query_ms_p99"]
    assert measured["recall"] > 0.9
    assert measured["tasks"]["semantic_recall"] > 0.9
    assert measured["tasks"]["semantic_entries"] == 1000
    assert measured["load_s"] > 0
    # With fewer keys than the exact search is usually timed on, the result says how many there were.
    assert measured["exact_entries"] == 3000
    assert measured["exact_ms_p50"] > 0


def test_options_are_checked():
    with pytest.raises(ValueError, match="queries is 0, expected at least 1"):
        memory.MemoryConfig(queries=0)


def test_made_up_keys_are_different_and_repeatable():
    keys = distinct_keys(500, np.random.default_rng(1))
    assert len(set(keys)) == 500
    assert keys == distinct_keys(500, np.random.default_rng(1))
    assert {len(key) for key in keys} == {1, 2}


def test_what_is_said_otherwise_is_near_but_not_always_the_same():
    rng = np.random.default_rng(0)
    keys = distinct_keys(300, rng)
    asked = [said_otherwise(key, rng) for key in keys]
    same = np.mean([a == b for a, b in zip(keys, asked, strict=True)])
    cosines = [key_vector(a) @ key_vector(b) for a, b in zip(keys, asked, strict=True)]
    assert 0.1 < same < 0.9
    assert np.min(cosines) > 0.5
    assert np.median(cosines) < 1


def test_made_up_entries_are_like_mined_ones():
    memory = synthetic_memory(250, np.random.default_rng(0))
    assert len(memory.entries) == 250
    assert len({entry.key.sub_tasks for entry in memory.entries}) == 3
    assert len({entry.source for entry in memory.entries}) == 250
    for entry in memory.entries:
        assert set(entry.objects) == set(entry.object_poses)
        assert len(entry.key_poses) == 8
        assert entry.key_poses[0].T_obj_ee[3].tolist() == pytest.approx([0, 0, 0, 1])
