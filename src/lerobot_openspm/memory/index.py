"""Vector indexes over retrieval keys: which of many key vectors are nearest to a query's.

An index is made from the vectors in memory and never written to a file: a million take seconds, and an index
in FAISS's own format out of a downloaded checkpoint would be a file that FAISS does not read safely.
"""

from __future__ import annotations

import importlib.util
import logging
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.memory.key_vector import DIMENSIONS, Vectors

logger = logging.getLogger(__name__)

# Up to this many vectors, a query is compared with all of them.
EXACT_LIMIT = 200_000
# The number of lists grows with the square root of the number of vectors; a query looks into _PROBES lists.
# Of a million vectors in 1500 lists, 32,000 are compared.
_LISTS_PER_ROOT, _PROBES = 1.5, 48
# Samples and iterations of the k-means that finds the centres of the lists.
_SAMPLES_PER_LIST, _ROUNDS = 40, 5

Indices = NDArray[np.int64]


class KeyIndex(Protocol):
    """Finds the nearest of a fixed set of unit vectors by cosine."""

    def search(self, queries: Vectors, k: int) -> tuple[Vectors, Indices]:
        """The nearest vectors of every query.

        Args:
            queries: Unit vectors ``(q, 64)``.
            k: How many to find of each.

        Returns:
            Cosines ``(q, m)`` and numbers of the vectors ``(q, m)``, the nearest first; m is k, or the number
            of vectors if that is less. Where fewer are found, the rest has cosine ``-inf`` and number -1.
        """
        ...


class ExactIndex:
    """Compares a query with every vector."""

    def __init__(self, vectors: Vectors):
        self._vectors = np.ascontiguousarray(vectors)

    def search(self, queries: Vectors, k: int) -> tuple[Vectors, Indices]:
        """See :meth:`KeyIndex.search`."""
        m = min(k, len(self._vectors))
        cosines, found = np.zeros((len(queries), m), np.float32), np.zeros((len(queries), m), np.int64)
        if not m:
            return cosines, found
        for i, query in enumerate(queries):  # one by one: no table of all queries and vectors is needed
            scores = self._vectors @ query
            nearest = np.argpartition(-scores, m - 1)[:m]
            found[i] = nearest[np.lexsort((nearest, -scores[nearest]))]
            cosines[i] = scores[found[i]]
        return cosines, found


class FaissIndex:
    """Compares a query with the vectors of the lists whose centres are nearest to it (an inverted file).

    The vectors are kept in half precision, which halves the time and the memory. The same vectors make the
    same index: the centres are found by k-means from a fixed seed.

    Raises:
        ImportError: ``faiss-cpu`` is not installed.
    """

    def __init__(self, vectors: Vectors):
        import faiss

        n_lists = max(1, min(round(_LISTS_PER_ROOT * len(vectors) ** 0.5), len(vectors)))
        index: Any = faiss.IndexIVFScalarQuantizer(
            faiss.IndexFlatIP(DIMENSIONS), DIMENSIONS, n_lists,
            faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_INNER_PRODUCT,
        )  # fmt: skip
        index.cp.spherical, index.cp.seed = True, 1
        index.cp.niter, index.cp.max_points_per_centroid = _ROUNDS, _SAMPLES_PER_LIST
        index.cp.min_points_per_centroid = 1  # of few vectors FAISS warns on stderr
        vectors = np.ascontiguousarray(vectors)
        if len(vectors):
            index.train(vectors)
            index.add(vectors)
        index.nprobe = _PROBES
        self._index = index

    def search(self, queries: Vectors, k: int) -> tuple[Vectors, Indices]:
        """See :meth:`KeyIndex.search`."""
        if not (m := min(k, int(self._index.ntotal))):
            return np.zeros((len(queries), 0), np.float32), np.zeros((len(queries), 0), np.int64)
        cosines, found = self._index.search(np.ascontiguousarray(queries), m)
        cosines[found < 0] = -np.inf
        return cosines, found


def make_index(vectors: Vectors, where: str = "the memory") -> KeyIndex:
    """The index for a number of vectors: exact up to :data:`EXACT_LIMIT`, FAISS's beyond if it is installed.

    Args:
        vectors: Unit vectors ``(n, 64)``.
        where: Names the memory in the log.
    """
    if len(vectors) <= EXACT_LIMIT:
        return ExactIndex(vectors)
    if importlib.util.find_spec("faiss") is None:
        logger.warning(
            "%s holds %d different keys, and every one is compared at each retrieval; it is quicker with "
            "FAISS: pip install 'lerobot_policy_openspm[index]'",
            where,
            len(vectors),
        )
        return ExactIndex(vectors)
    return FaissIndex(vectors)
