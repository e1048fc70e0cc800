import importlib.util
import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_openspm.memory import index as index_module
from lerobot_openspm.memory.index import ExactIndex, FaissIndex, make_index
from lerobot_openspm.memory.key_vector import DIMENSIONS

KINDS = [ExactIndex, FaissIndex]


def unit_vectors(count, seed=0):
    vectors = np.random.default_rng(seed).standard_normal((count, DIMENSIONS), np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("count", "queries", "k"), [(7, 3, 2), (7, 1, 7), (7, 2, 50), (1, 2, 1), (0, 2, 3)])
def test_shapes(kind, count, queries, k):
    index = kind(unit_vectors(count))
    cosines, found = index.search(unit_vectors(queries, seed=1), k)
    assert cosines.shape == found.shape == (queries, min(k, count))
    assert (cosines.dtype, found.dtype) == (np.float32, np.int64)
    assert index.search(unit_vectors(0), k)[1].shape == (0, min(k, count))


@pytest.mark.parametrize("kind", KINDS)
def test_a_vector_is_the_nearest_to_itself(kind):
    vectors = unit_vectors(500)
    cosines, found = kind(vectors).search(vectors, 3)
    assert found[:, 0].tolist() == list(range(500))
    np.testing.assert_allclose(cosines[:, 0], 1, atol=2e-3)  # FAISS keeps half precision
    assert (np.diff(cosines) <= 0).all()


def test_exact_is_what_comparing_all_gives():
    vectors, queries = unit_vectors(300), unit_vectors(20, seed=1)
    cosines, found = ExactIndex(vectors).search(queries, 10)
    expected = np.argsort(-(queries @ vectors.T), axis=1)[:, :10]
    assert np.array_equal(found, expected)
    np.testing.assert_allclose(cosines, np.take_along_axis(queries @ vectors.T, expected, 1), rtol=1e-5)


@given(st.integers(1, 900), st.integers(0, 2**32 - 1), st.integers(1, 20))
def test_faiss_agrees_with_exact_on_small_banks(count, seed, k):
    """Every list is looked into, so all vectors are compared."""
    vectors, queries = unit_vectors(count, seed), unit_vectors(4, seed + 1)
    exact, by_faiss = (kind(vectors).search(queries, k) for kind in KINDS)
    np.testing.assert_allclose(by_faiss[0], exact[0], atol=2e-3)
    for theirs, ours, scores in zip(by_faiss[1], exact[1], exact[0], strict=True):
        clear = scores > scores[-1] + 4e-3  # whatever half precision makes of the order of the others
        assert set(ours[clear]) <= set(theirs)


def test_equally_near_vectors_come_in_their_order():
    vectors = np.repeat(unit_vectors(1), 6, axis=0)
    assert ExactIndex(vectors).search(vectors[:1], 6)[1].tolist() == [[0, 1, 2, 3, 4, 5]]


@pytest.fixture(scope="module")
def forty_lists():
    """More lists than a query looks into."""
    return unit_vectors(40_000)


def test_faiss_finds_what_is_near_among_many_lists(forty_lists):
    queries = forty_lists[:200] + 0.5 * unit_vectors(200, seed=1)
    queries = (queries / np.linalg.norm(queries, axis=1, keepdims=True)).astype(np.float32)
    _, found = FaissIndex(forty_lists).search(queries, 10)
    assert np.mean(found[:, 0] == np.arange(200)) > 0.95


def test_what_the_lists_looked_into_do_not_hold_is_marked(forty_lists):
    cosines, found = FaissIndex(forty_lists).search(forty_lists[:1], len(forty_lists))
    n = int((found >= 0).sum())
    assert 1_000 < n < 40_000
    assert len(set(found[0, :n].tolist())) == n
    assert (found[0, n:] == -1).all()
    assert np.isneginf(cosines[0, n:]).all()


def test_the_same_vectors_make_the_same_index():
    vectors, queries = unit_vectors(5000), unit_vectors(50, seed=1)
    one, other = (FaissIndex(vectors).search(queries, 20) for _ in range(2))
    assert np.array_equal(one[0], other[0])
    assert np.array_equal(one[1], other[1])


def test_many_vectors_take_faiss_few_do_not(monkeypatch):
    monkeypatch.setattr(index_module, "EXACT_LIMIT", 100)
    assert isinstance(make_index(unit_vectors(100)), ExactIndex)
    assert isinstance(make_index(unit_vectors(101)), FaissIndex)


def test_without_faiss_it_goes_on_and_says_how_to_be_quicker(monkeypatch, caplog):
    monkeypatch.setattr(index_module, "EXACT_LIMIT", 100)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with caplog.at_level(logging.WARNING):
        made = make_index(unit_vectors(101), "bank/memory.json")
    assert isinstance(made, ExactIndex)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "bank/memory.json" in caplog.text
    assert "pip install 'lerobot_policy_openspm[index]'" in caplog.text
