"""How quickly a large memory is loaded and searched, and whether what is found is the nearest."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lerobot_openspm.bench.results import ResultOption
from lerobot_openspm.bench.synthetic_bank import synthetic_experience
from lerobot_openspm.bench.synthetic_keys import Key, distinct_keys, said_otherwise
from lerobot_openspm.memory.index import ExactIndex, FaissIndex, KeyIndex, make_index
from lerobot_openspm.memory.indexed_entries import NEAREST_KEYS, IndexedEntries
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.memory.key_vector import DIMENSIONS, Vectors, key_vectors
from lerobot_openspm.memory.retrieval import semantic_score

WARM_UP = 100
EXACT_ENTRIES, LOADED_ENTRIES = 10_000, 100_000
# Of uniform vectors: length of the noise added to a unit vector to ask for it; the cosine is then about 0.86.
UNIFORM_NOISE = 0.6
INDICES: dict[str, type[ExactIndex | FaissIndex]] = {"exact": ExactIndex, "faiss": FaissIndex}
# Every key is scored for every query, in Python.
SEMANTIC_ENTRIES, SEMANTIC_QUERIES = 20_000, 200


@dataclass
class Options(ResultOption):
    """Measure the index, and the loading of a large memory."""

    entries: int = 1_000_000  # different keys in the index
    queries: int = 2000  # asked one by one
    seed: int = 0  # of the made-up keys and queries
    threads: int = 2  # that FAISS makes the index with; a single query takes one
    loaded: int = LOADED_ENTRIES  # entries of the memory that is written and loaded

    def __post_init__(self) -> None:
        for name in ("entries", "queries", "threads", "loaded"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")


def measure(options: Options) -> dict[str, Any]:
    """Measure; keys of tasks are the headline, uniform vectors are the worst there is."""
    import faiss

    faiss.omp_set_num_threads(options.threads)
    rng = np.random.default_rng(options.seed)
    keys = distinct_keys(options.entries, rng)
    asked = [said_otherwise(keys[i], rng) for i in rng.integers(len(keys), size=options.queries)]
    tasks = _search(key_vectors(keys), key_vectors(asked))
    few = key_vectors(keys[:EXACT_ENTRIES])
    exact_ms, _ = _timed(ExactIndex(few), key_vectors(asked))
    load_s, near_ms = _load(options.loaded, options.queries, rng)
    return {
        "entries": options.entries,
        "n": options.queries,
        "query_ms_p50": tasks["query_ms_p50"],
        "query_ms_p99": tasks["query_ms_p99"],
        "recall": tasks["recall"],
        "loaded_entries": options.loaded,
        "load_s": round(load_s, 3),
        "exact_entries": len(few),
        "exact_ms_p50": _percentile(exact_ms, 50),
        "threads": options.threads,
        "tasks": tasks | _semantic_recall(keys[:SEMANTIC_ENTRIES], INDICES[tasks["index"]], rng),
        "uniform": _search(*_uniform(options.entries, options.queries, rng)),
        "near_ms_p50": _percentile(near_ms, 50),
    }


def _search(vectors: Vectors, queries: Vectors) -> dict[str, Any]:
    """Times of single queries, and how often the nearest vector is among what is found."""
    start_s = time.perf_counter()
    index = make_index(vectors)
    build_s = time.perf_counter() - start_s
    (wall_ms, cpu_ms), found = _timed_with_cpu(index, queries)
    nearest = _nearest(vectors, queries)
    return {
        "index": _kind(index),
        "query_ms_p50": _percentile(wall_ms, 50),
        "query_ms_p99": _percentile(wall_ms, 99),
        "query_cpu_ms_p99": _percentile(cpu_ms, 99),
        "recall": round(float((found == nearest[:, None]).any(axis=1).mean()), 4),
        "build_s": round(build_s, 1),
    }


def _kind(index: KeyIndex) -> str:
    return "faiss" if isinstance(index, FaissIndex) else "exact"


def _timed(index: KeyIndex, queries: Vectors) -> tuple[np.ndarray, np.ndarray]:
    (wall_ms, _), found = _timed_with_cpu(index, queries)
    return wall_ms, found


def _timed_with_cpu(index: KeyIndex, queries: Vectors) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Milliseconds of each query, by the clock and of this thread's work, and what was found."""
    for query in queries[:WARM_UP]:
        index.search(query[None], NEAREST_KEYS)
    times, found = np.zeros((2, len(queries))), []
    for i, query in enumerate(queries):
        wall_s, cpu_s = time.perf_counter(), time.thread_time()
        _, nearest = index.search(query[None], NEAREST_KEYS)
        times[:, i] = time.perf_counter() - wall_s, time.thread_time() - cpu_s
        found.append(nearest[0])
    return (1000 * times[0], 1000 * times[1]), np.stack(found)


def _nearest(vectors: Vectors, queries: Vectors, at_once: int = 100) -> np.ndarray:
    """Number of the vector ``(q,)`` nearest to each query, found by comparing all."""
    blocks = [queries[i : i + at_once] for i in range(0, len(queries), at_once)]
    return np.concatenate([np.argmax(vectors @ block.T, axis=0) for block in blocks])


def _uniform(count: int, n_queries: int, rng: np.random.Generator) -> tuple[Vectors, Vectors]:
    """Vectors without any structure, and some of them with noise."""
    vectors = _unit(rng.standard_normal((count, DIMENSIONS), np.float32))
    noise = UNIFORM_NOISE * _unit(rng.standard_normal((n_queries, DIMENSIONS), np.float32))
    return vectors, _unit(vectors[rng.integers(count, size=n_queries)] + noise)


def _unit(vectors: np.ndarray) -> Vectors:
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def _semantic_recall(
    keys: list[Key], kind: type[ExactIndex | FaissIndex], rng: np.random.Generator
) -> dict[str, Any]:
    """How often the best ``S_sem`` of all keys is reached by those that an index of this kind finds."""
    asked = [said_otherwise(keys[i], rng) for i in rng.integers(len(keys), size=SEMANTIC_QUERIES)]
    index = kind(key_vectors(keys))
    _, found = index.search(key_vectors(asked), NEAREST_KEYS)
    reached = 0
    for key, numbers in zip(asked, found, strict=True):
        among = max((semantic_score(key, keys[int(i)]) for i in numbers if i >= 0), default=0.0)
        reached += among >= max(semantic_score(key, known) for known in keys)
    return {
        "semantic_recall": round(reached / len(asked), 4), "semantic_n": len(asked),
        "semantic_index": _kind(index), "semantic_entries": len(keys),
    }  # fmt: skip


def _load(count: int, n_queries: int, rng: np.random.Generator) -> tuple[float, np.ndarray]:
    """Median of three loads in seconds; milliseconds of finding the entries for an instruction in it."""
    memory = synthetic_experience(count, rng)
    asked = [
        said_otherwise(memory.entries[i].key.sub_tasks, rng) for i in rng.integers(count, size=n_queries)
    ]
    with TemporaryDirectory() as folder:
        write_memory(memory, Path(folder))
        del memory
        times = [_seconds(lambda: read_memory(Path(folder)))[0] for _ in range(3)]
        bank = IndexedEntries(read_memory(Path(folder)).entries)
    near_s = [_seconds(lambda key=key: bank.near(key, semantic_score))[0] for key in asked]
    return float(np.median(times)), 1000 * np.array(near_s)


def _seconds(do: Callable[[], Any]) -> tuple[float, Any]:
    start_s = time.perf_counter()
    result = do()
    return time.perf_counter() - start_s, result


def _percentile(values: np.ndarray, percent: float) -> float:
    return round(float(np.percentile(values, percent)), 4)
