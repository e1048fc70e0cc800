"""The entries of a large memory, of which a retrieval reads only those whose keys are near what is asked.

Semantic candidates first, geometric feasibility after, as the paper outlines: the index finds the nearest
keys, they are scored exactly, and of the best keys the best entries are handed on to be scored in the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.index import make_index
from lerobot_openspm.memory.key_vector import key_vectors
from lerobot_openspm.memory.stored_entries import Key, StoredEntries
from lerobot_openspm.types import SubTask

# Memories of more entries are indexed; scoring fewer takes no longer than perception.
INDEX_FROM = 1000
# Keys that the index returns for each part of an instruction.
NEAREST_KEYS = 64
# Entries that are returned per key, the best by quality first, and in total.
ENTRIES_PER_KEY, ENTRIES_IN_ALL = 64, 256

# S_sem of what is asked and what is known.
Score = Callable[[Sequence[SubTask], Sequence[SubTask]], float]


class IndexedEntries(Sequence[MemoryEntry]):
    """Entries with an index over their keys, and over the sub-tasks of keys that have several.

    Args:
        entries: The memory's. Of :class:`StoredEntries` one entry of every different key is read, else all.

    Attributes:
        names: Of all objects that the entries are about.

    Raises:
        MemoryFormatError: An entry cannot be read.
    """

    def __init__(self, entries: Sequence[MemoryEntry]):
        self._entries = entries
        keys, numbers, qualities = _numbered_keys(entries)
        # Entries by key, the best of each first.
        self._order = np.lexsort((np.arange(len(entries)), -qualities, numbers))
        self._ends = np.searchsorted(numbers[self._order], np.arange(len(keys) + 1))
        # The rows of the index: every key, and every sub-task of those that have several; whose it is.
        self._rows: dict[Key, list[int]] = {key: [] for key in keys}
        for number, key in enumerate(keys):
            for row in dict.fromkeys([key, *((sub_task,) for sub_task in key if len(key) > 1)]):
                self._rows.setdefault(row, []).append(number)
        self._row_keys, self._keys = list(self._rows), keys
        self.names = _names(keys)
        self._index = make_index(key_vectors(self._row_keys))

    def __len__(self) -> int:
        return len(self._entries)

    @overload
    def __getitem__(self, item: int) -> MemoryEntry: ...
    @overload
    def __getitem__(self, item: slice) -> Sequence[MemoryEntry]: ...
    def __getitem__(self, item: int | slice) -> MemoryEntry | Sequence[MemoryEntry]:
        return self._entries[item]

    def near(self, asked: Sequence[SubTask], score: Score) -> list[MemoryEntry]:
        """The entries of the keys nearest to what is asked, and to every part of it; the best key first.

        For each part these are entries whose whole key is near, and entries of which one sub-task is: of
        either about :data:`ENTRIES_IN_ALL` at most. Of a key these are the best by quality: of one that has a
        score at most :data:`ENTRIES_PER_KEY`, of any other one, to be named where nothing is known of what is
        asked.

        Args:
            asked: The sub-tasks of an instruction.
            score: ``S_sem``, by which the keys are ranked that the index finds.
        """
        runs = [tuple(asked[i:j]) for i in range(len(asked)) for j in range(len(asked), i, -1)]
        _, found = self._index.search(key_vectors(runs), NEAREST_KEYS)
        entries: dict[int, None] = {}
        for run, rows in zip(runs, found, strict=True):
            keys = [self._row_keys[int(row)] for row in rows[rows >= 0]]
            scores = {key: score(run, key) for key in keys}
            wholes: dict[int, float] = {}
            parts: dict[int, float] = {}
            for key in sorted(keys, key=lambda key: -scores[key]):
                for number in self._rows[key][:NEAREST_KEYS]:
                    is_whole = len(self._keys[number]) == len(key)
                    if is_whole or len(key) == len(run):
                        (wholes if is_whole else parts).setdefault(number, scores[key])
            entries |= dict.fromkeys([*self._best_entries(wholes), *self._best_entries(parts)])
        return [self._entries[i] for i in entries]

    def _best_entries(self, scores: Mapping[int, float]) -> Iterator[int]:
        """The best entry of each key, and as many more of those with a score as there is room for."""
        left = max(0, ENTRIES_IN_ALL - len(scores))
        for number, score in scores.items():
            begin, end = self._ends[number], self._ends[number + 1]
            more = min(end - begin, ENTRIES_PER_KEY, 1 + left) - 1 if score > 0 else 0
            left -= more
            yield from (int(i) for i in self._order[begin : begin + 1 + more])


def indexed(entries: Sequence[MemoryEntry]) -> Sequence[MemoryEntry]:
    """The entries with an index, if there are many; else as they are."""
    if len(entries) <= INDEX_FROM or isinstance(entries, IndexedEntries):
        return entries
    return IndexedEntries(entries)


def known_names(entries: Sequence[MemoryEntry]) -> frozenset[str]:
    """Names of all objects that entries, as :func:`indexed` gave them, are about."""
    if isinstance(entries, IndexedEntries):
        return entries.names
    return _names({entry.key.sub_tasks for entry in entries})


def _names(keys: Iterable[Key]) -> frozenset[str]:
    return frozenset(name for key in keys for sub_task in key for name in sub_task.objects)


def near(asked: Sequence[SubTask], entries: Sequence[MemoryEntry], score: Score) -> Sequence[MemoryEntry]:
    """The entries to be considered for what is asked: of indexed ones the nearest, else all.

    Args:
        asked: The sub-tasks of an instruction.
        entries: Those of a memory, as :func:`indexed` gave them.
        score: ``S_sem``.
    """
    return entries.near(asked, score) if isinstance(entries, IndexedEntries) else entries


def _numbered_keys(
    entries: Sequence[MemoryEntry],
) -> tuple[list[Key], NDArray[np.int64], NDArray[np.float64]]:
    """The different keys, which of them each entry has ``(n,)``, and the entries' qualities ``(n,)``."""
    if isinstance(entries, StoredEntries):
        _, firsts, numbers = np.unique(entries.keys, return_index=True, return_inverse=True)
        return [entries[int(i)].key.sub_tasks for i in firsts], numbers, entries.qualities
    table: dict[Key, int] = {}
    rows = [(table.setdefault(entry.key.sub_tasks, len(table)), entry.quality) for entry in entries]
    numbers, qualities = np.array(rows, float).reshape(-1, 2).T
    return list(table), numbers.astype(np.int64), qualities
