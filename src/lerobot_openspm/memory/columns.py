"""What is kept of the entries of a large bank as columns, so that not all have to be read to find one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.types import SubTask

Key = tuple[SubTask, ...]


@runtime_checkable
class HasColumns(Protocol):
    """A bank that keeps digests of keys and qualities as columns, so that it need not be read for them.

    The digests only tell which entries have equal keys; one entry of each is read and compared with its
    digest, and digests of another release or another bank are not used.
    """

    def columns(self) -> Columns | None:
        """What was kept with the entries; None where nothing was."""
        ...


@dataclass(frozen=True)
class Columns:
    """What an index needs to know of every entry.

    Attributes:
        digests: :func:`key_digest` of every entry ``(n,)``, uint64.
        qualities: Its quality ``(n,)``, float64.
    """

    digests: NDArray[np.uint64]
    qualities: NDArray[np.float64]

    def __getitem__(self, rows: slice) -> Columns:
        return Columns(self.digests[rows], self.qualities[rows])


def key_digest(key: Sequence[SubTask]) -> int:
    """A number below ``2**64`` that tells a key from others, the same on every machine."""
    rows = [asdict(sub_task) for sub_task in key]
    # No words, no field: digests that were kept before there were any stay what they are.
    kept = [{name: value for name, value in row.items() if value or name != "words"} for row in rows]
    fields = json.dumps(kept, sort_keys=True)
    return int.from_bytes(hashlib.blake2b(fields.encode(), digest_size=8).digest(), "little")


def columns_of(entries: Sequence[MemoryEntry]) -> Columns:
    """The columns of some entries, as they were kept with them, or else made."""
    if isinstance(entries, HasColumns) and (kept := entries.columns()) is not None:
        return kept
    rows = [(entry.key.sub_tasks, entry.quality) for entry in entries]
    digests = {key: key_digest(key) for key in {key for key, _ in rows}}
    return Columns(
        np.array([digests[key] for key, _ in rows], np.uint64),
        np.array([quality for _, quality in rows], float),
    )
