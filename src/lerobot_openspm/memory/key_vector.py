"""Retrieval keys as vectors, so that of a large memory only the nearest keys have to be read.

The vectors decide nothing but which keys are looked at: what is found is scored by
:func:`lerobot_openspm.memory.retrieval.semantic_score`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array  # pyright: ignore[reportMissingTypeStubs]

from lerobot_openspm.language.meaning import canonical
from lerobot_openspm.types import Reference, SubTask

Vectors = NDArray[np.float32]

DIMENSIONS = 64

# How much the elements of a sub-task count. Another operation, target or landmark is another task; the
# reference tells apart only objects of one name.
_WEIGHTS = {
    "operation": 1.0, "target": 1.0, "landmark": 1.0, "part": 0.8, "relation": 0.4,
    "target_where": 0.4, "landmark_where": 0.4, "words": 2.0,
}  # fmt: skip
# Share of a name as a whole beside its words: names of the same words in another order are told apart.
_WHOLE_NAME = 0.2

# Number of the sub-task, field of it, what the field says.
_Element = tuple[int, str, str]


def key_vector(sub_tasks: Sequence[SubTask]) -> Vectors:
    """A unit vector ``(64,)`` that is near those of similar keys in cosine; equal keys alone have equal ones.

    Every word of every element is a feature (so that "bottle" is near "wine bottle"), every feature a vector
    of random signs given by its hash, and a key the weighted sum of its features: a random projection with
    entries of +-1 (Achlioptas 2003) whose rows are not kept but hashed (Weinberger et al. 2009). The same on
    every machine and in every process.

    The phases of a key take no part. An instruction says nothing of them, and demonstrations of one task that
    differ in them share a vector, and with it one place in the index.

    Args:
        sub_tasks: What is to be done, in order; other names of the same things give the same vector.
    """
    return key_vectors([sub_tasks])[0]


def key_vectors(keys: Sequence[Sequence[SubTask]]) -> Vectors:
    """The vectors ``(n, 64)`` of many keys, see :func:`key_vector`; zeros for a key without sub-tasks."""
    numbers: dict[_Element, int] = {}
    columns: list[int] = []
    ends = [0]
    for sub_tasks in keys:
        for position, sub_task in enumerate(sub_tasks):
            columns += [numbers.setdefault(item, len(numbers)) for item in _elements(position, sub_task)]
        ends.append(len(columns))
    table = np.stack([_element_vector(item) for item in numbers] or [np.zeros(DIMENSIONS, np.float32)])
    ones = np.ones(len(columns), np.float32)
    contains: Any = csr_array((ones, columns, ends), shape=(len(keys), len(table)))
    sums: Vectors = contains @ table
    norms = np.sqrt(np.einsum("ij,ij->i", sums, sums))[:, None]
    return np.divide(sums, norms, out=np.zeros_like(sums), where=norms > 0)


def _elements(position: int, sub_task: SubTask) -> list[_Element]:
    if sub_task.words:  # which objects it was about the demonstrations told
        return [(0, "words", sub_task.words)]
    sub_task = canonical(sub_task)
    # That there is no landmark or part is an element too, as it is in the semantic score.
    elements = [
        (position, "operation", sub_task.operation),
        (position, "target", sub_task.target),
        (position, "landmark", sub_task.landmark),
        (position, "part", sub_task.part),
        (position, "relation", sub_task.relation),
    ]
    if sub_task.target_where is not None:
        elements.append((position, "target_where", _reference_words(sub_task.target_where)))
    if sub_task.landmark_where is not None:
        elements.append((position, "landmark_where", _reference_words(sub_task.landmark_where)))
    return elements


def _reference_words(reference: Reference) -> str:
    return " ".join([f"<{reference.relation}>", *reference.landmarks])


@lru_cache(maxsize=65536)
def _element_vector(element: _Element) -> Vectors:
    """The weighted sum ``(64,)`` of an element's features."""
    position, field, text = element
    words = sorted(set(text.split())) or [""]
    total = _WHOLE_NAME * _signs(f"{position}|{field}|={text}")
    total += sum(_signs(f"{position}|{field}|{word}") for word in words) / len(words) ** 0.5
    return (_WEIGHTS[field] * total).astype(np.float32)


def _signs(feature: str) -> NDArray[np.float64]:
    """Signs ``(64,)`` of the bits of a feature's hash, -1 or +1."""
    digest = hashlib.blake2b(feature.encode(), digest_size=DIMENSIONS // 8).digest()
    return np.where(np.unpackbits(np.frombuffer(digest, np.uint8)), 1.0, -1.0)
