"""How quickly a large memory is loaded and searched, and whether what is found is the nearest.

python -m benchmarks.memory
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.results import run, write
from benchmarks.synthetic import Key, distinct_keys, said_otherwise, synthetic_memory
from lerobot_openspm.memory.index import ExactIndex, FaissIndex, KeyIndex, make_index
from lerobot_openspm.memory.indexed_entries import NEAREST_KEYS
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.memory.key_vector import DIMENSIONS, Vectors, key_vectors
from lerobot_openspm.memory.retrieval import semantic_score

WARM_UP = 100
EXACT_ENTRIES = 10_000
# Of uniform vectors: length of the noise added to a unit vector to ask for it; the cosine is then about 0.86.
UNIFORM_NOISE = 0.6
# Every key is scored for every query, in Python.
SEMANTIC_ENTRIES, SEMANTIC_QUERIES = 20_000, 200


@dataclass
class MemoryConfig:
    """Measure the index, and the loading of a large memory.

    Args:
        entries: Different keys in the index.
        queries: Asked one by one.
        seed: Of the made-up keys and queries.
        threads: That FAISS makes the index with; a single query takes one.
        loaded: Entries of the memory that is written and loaded.
    """

    entries: int = 1_000_000
    queries: int = 2000
    seed: int = 0
    threads: int = 2
    loaded: int = 100_000

    def __post_init__(self) -> None:
        for name in ("entries", "queries", "threads", "loaded"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")


def main(config: MemoryConfig) -> dict[str, Any]:
    """Measure, write and return the result."""
    return write("memory", {"seed": config.seed, **measure(config)})


def measure(config: MemoryConfig) -> dict[str, Any]:
    """Keys of tasks are the headline, uniform vectors are the worst there is."""
    import faiss

    faiss.omp_set_num_threads(config.threads)
    rng = np.random.default_rng(config.seed)
    keys = distinct_keys(config.entries, rng)
    asked = [said_otherwise(keys[i], rng) for i in rng.integers(len(keys), size=config.queries)]
    tasks = _search(key_vectors(keys), key_vectors(asked))
    few = key_vectors(keys[:EXACT_ENTRIES])
    (exact_ms, _), _ = _timed(ExactIndex(few), key_vectors(asked))
    return {
        "entries": config.entries,
        "n": config.queries,
        "query_ms_p50": tasks["query_ms_p50"],
        "query_ms_p99": tasks["query_ms_p99"],
        "recall": tasks["recall"],
        "loaded_entries": config.loaded,
        "load_s": round(_load_s(config.loaded, rng), 3),
        "exact_entries": len(few),
        "exact_ms_p50": _percentile(exact_ms, 50),
        "threads": config.threads,
        "tasks": tasks | _semantic_recall(keys[:SEMANTIC_ENTRIES], rng),
        "uniform": _search(*_uniform(config.entries, config.queries, rng)),
    }


def _search(vectors: Vectors, queries: Vectors) -> dict[str, Any]:
    """Times of single queries, and how often the nearest vector is among what is found."""
    start_s = time.perf_counter()
    index = make_index(vectors)
    build_s = time.perf_counter() - start_s
    (wall_ms, cpu_ms), found = _timed(index, queries)
    nearest = _nearest(vectors, queries)
    return {
        "index": "faiss" if isinstance(index, FaissIndex) else "exact",
        "query_ms_p50": _percentile(wall_ms, 50),
        "query_ms_p99": _percentile(wall_ms, 99),
        "query_cpu_ms_p99": _percentile(cpu_ms, 99),
        "recall": round(float((found == nearest[:, None]).any(axis=1).mean()), 4),
        "build_s": round(build_s, 1),
    }


def _timed(index: KeyIndex, queries: Vectors) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
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


def _semantic_recall(keys: list[Key], rng: np.random.Generator) -> dict[str, Any]:
    """How often the best ``S_sem`` of all keys is reached by those that FAISS finds."""
    asked = [said_otherwise(keys[i], rng) for i in rng.integers(len(keys), size=SEMANTIC_QUERIES)]
    _, found = FaissIndex(key_vectors(keys)).search(key_vectors(asked), NEAREST_KEYS)
    reached = 0
    for key, numbers in zip(asked, found, strict=True):
        among = max((semantic_score(key, keys[int(i)]) for i in numbers if i >= 0), default=0.0)
        reached += among >= max(semantic_score(key, known) for known in keys)
    return {"semantic_recall": round(reached / len(asked), 4), "semantic_entries": len(keys)}


def _load_s(count: int, rng: np.random.Generator) -> float:
    """Seconds that a memory of so many entries takes to load, the median of three."""
    times = []
    with TemporaryDirectory() as folder:
        write_memory(synthetic_memory(count, rng), Path(folder))
        for _ in range(3):
            start_s = time.perf_counter()
            read_memory(Path(folder))
            times.append(time.perf_counter() - start_s)
    return float(np.median(times))


def _percentile(values: np.ndarray, percent: float) -> float:
    return round(float(np.percentile(values, percent)), 4)


if __name__ == "__main__":
    run(MemoryConfig, main)
