"""The entries of a memory as lines of one file, each read and checked when it is asked for.

Columns beside the file hold the end of each entry's line, a digest of the line, and what the entry is found
by. So a memory of a million entries is loaded without reading them, and a changed or damaged line is noticed
when it is read.
"""

from __future__ import annotations

import hashlib
import json
import os
import weakref
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, overload

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.schema import AGAIN, entry_from_json, entry_to_json
from lerobot_openspm.types import SubTask

BETWEEN, TAIL = b",\n", b"\n ]\n}\n"
DIGEST_BYTES = 16
MAX_LINE_BYTES = 4_000_000
# The entries read last stay in memory, up to this many.
KEPT_ENTRIES = 4096

Key = tuple[SubTask, ...]


@lru_cache(KEPT_ENTRIES)
def key_digest(key: Key) -> int:
    """A number below ``2**64`` that tells a key from others, the same on every machine."""
    text = json.dumps([asdict(sub_task) for sub_task in key], sort_keys=True)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


@dataclass(frozen=True)
class Columns:
    """What is kept of every entry.

    Attributes:
        ends: Where its line ends, bytes from the first one's start ``(n,)``, int64.
        digests: BLAKE2b digest of its line ``(n, 16)``, uint8.
        keys: :func:`key_digest` of its key ``(n,)``, uint64.
        qualities: Its quality ``(n,)``, float64.
    """

    ends: NDArray[np.int64]
    digests: NDArray[np.uint8]
    keys: NDArray[np.uint64]
    qualities: NDArray[np.float64]

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays by their names in a safetensors file."""
        return {f"entries.{field.name}": getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], where: str) -> Columns:
        """Inverse of :meth:`to_arrays`. Raises MemoryFormatError naming file and array."""
        n = len(arrays["entries.ends"]) if "entries.ends" in arrays else 0
        shapes = {"ends": (np.int64, n), "digests": (np.uint8, n, DIGEST_BYTES), "keys": (np.uint64, n)}
        for name, (dtype, *shape) in {**shapes, "qualities": (np.float64, n)}.items():
            found = arrays.get(f"entries.{name}")
            if found is None or found.dtype != dtype or found.shape != tuple(shape):
                got = "missing" if found is None else f"{found.dtype} of {found.shape}"
                raise MemoryFormatError(
                    f"{where}: array 'entries.{name}' is {got}, expected {np.dtype(dtype)} of "
                    f"{tuple(shape)}; {AGAIN}"
                )
        columns = cls(*(arrays[f"entries.{field.name}"] for field in fields(cls)))
        lengths = np.diff(columns.ends, prepend=-len(BETWEEN)) - len(BETWEEN)
        if n and not (lengths.min() > 0 and lengths.max() <= MAX_LINE_BYTES):
            raise MemoryFormatError(
                f"{where}: array 'entries.ends' does not count up line by line: lines of {lengths.min()} to "
                f"{lengths.max()} bytes, expected 1 to {MAX_LINE_BYTES}; {AGAIN}"
            )
        return columns


class OpenFile:
    """A file that is read at any place, and closed with its last user.

    It is not mapped into memory: reading a mapped file that was truncated kills the process.

    Raises:
        OSError: It cannot be opened.
    """

    def __init__(self, path: Path):
        self.path = path
        self._descriptor = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._descriptor)
        self.n_bytes = os.fstat(self._descriptor).st_size

    def read(self, start: int, n_bytes: int) -> bytes:
        """Up to `n_bytes` bytes from `start`; fewer at the end of the file."""
        try:
            return os.pread(self._descriptor, n_bytes, start)
        except OSError as error:
            raise MemoryFormatError(f"{self.path}: cannot be read: {error}; try again") from error


class StoredEntries(Sequence[MemoryEntry]):
    """Entries in a file, each read and checked when it is asked for.

    What is open stays readable when a newer memory takes the file's name. Reading raises MemoryFormatError
    for a line that is not what was written.

    Args:
        file: The file.
        start: Where its first line starts.
        columns: What is kept of all its entries.
        objects: The objects that its entries have key poses at.
        rows: Which of the entries this is about; all if not given.

    Raises:
        MemoryFormatError: The file is of another size.
    """

    def __init__(
        self,
        file: OpenFile,
        start: int,
        columns: Columns,
        objects: frozenset[str],
        rows: range | None = None,
    ):
        self._file, self._start, self._columns, self.objects = file, start, columns, objects
        self._rows = range(len(columns.ends)) if rows is None else rows
        expected = start + (int(columns.ends[-1]) if len(columns.ends) else 0) + len(TAIL)
        if file.n_bytes != expected:
            raise MemoryFormatError(
                f"{file.path}: {file.n_bytes} bytes, expected {expected}: truncated or changed; {AGAIN}"
            )
        self._entry = lru_cache(KEPT_ENTRIES)(self._read)

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> MemoryEntry: ...
    @overload
    def __getitem__(self, index: slice) -> StoredEntries: ...
    def __getitem__(self, index: int | slice) -> MemoryEntry | StoredEntries:
        if isinstance(index, slice):
            return StoredEntries(self._file, self._start, self._columns, self.objects, self._rows[index])
        return self._entry(self._rows[index])

    def __iter__(self) -> Iterator[MemoryEntry]:
        # Without the cache: a pass over all entries must not hold them all, nor push out those in use.
        return (self._read(row) for row in self._rows)

    def __deepcopy__(self, _: dict[int, Any]) -> StoredEntries:
        return self  # nothing of it ever changes

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopened, (self._file.path, self._start, self._columns, self.objects, self._rows)

    @property
    def keys(self) -> NDArray[np.uint64]:
        """The digests of the entries' keys ``(n,)``."""
        return self._columns.keys[self._numbers]

    @property
    def qualities(self) -> NDArray[np.float64]:
        """The entries' qualities ``(n,)``."""
        return self._columns.qualities[self._numbers]

    @property
    def _numbers(self) -> NDArray[np.int64]:
        return np.arange(self._rows.start, self._rows.stop, self._rows.step)

    def lines(self) -> Iterator[tuple[bytes, int, float]]:
        """Each entry's JSON, checked against its digest but not parsed; its key's digest and its quality."""
        for row in self._rows:
            yield self._text(row), int(self._columns.keys[row]), float(self._columns.qualities[row])

    def _text(self, row: int) -> bytes:
        ends = self._columns.ends
        begin, end = int(ends[row - 1]) + len(BETWEEN) if row else 0, int(ends[row])
        text = self._file.read(self._start + begin, end - begin)
        if _digest(text) != self._columns.digests[row].tobytes():
            raise MemoryFormatError(
                f"{self._file.path}: entries[{row}] is not what its digest says: truncated, changed or "
                f"damaged; {AGAIN}. To change entries, use openspm memory export and add"
            )
        return text

    def _read(self, row: int) -> MemoryEntry:
        where = f"{self._file.path}: entries[{row}]"
        entry = entry_from_json(self._text(row), where)
        if unknown := set(entry.objects) - self.objects:
            raise MemoryFormatError(
                f"{where} has key poses at {sorted(unknown)}, which 'anchored' does not list; {AGAIN}"
            )
        kept = int(self._columns.keys[row]), float(self._columns.qualities[row])
        if kept != (key_digest(entry.key.sub_tasks), entry.quality):
            raise MemoryFormatError(
                f"{where} has another key or quality than arrays 'entries.keys' and 'entries.qualities' say; "
                f"{AGAIN}"
            )
        return entry


def _reopened(path: Path, *rest: Any) -> StoredEntries:
    """The entries in another process."""
    return StoredEntries(OpenFile(path), *rest)


def anchored_objects(entries: Sequence[MemoryEntry]) -> frozenset[str]:
    """Names of all objects that entries have key poses at."""
    if isinstance(entries, StoredEntries):
        return entries.objects
    return frozenset(name for entry in entries for name in entry.objects)


def write_entries(file: BinaryIO, groups: Sequence[Sequence[MemoryEntry]]) -> Columns:
    """Write groups of entries, one after the other, a line each; then the end of the file.

    Raises:
        MemoryFormatError: An entry could not be read again.
    """
    ends, digests, keys, qualities = array("q"), bytearray(), array("Q"), array("d")
    position = -len(BETWEEN)
    for text, key, quality in (line for group in groups for line in _lines(group)):
        if len(text) > MAX_LINE_BYTES:
            raise MemoryFormatError(
                f"entries[{len(ends)}] has {len(text)} bytes as JSON, expected up to {MAX_LINE_BYTES}: it "
                f"could never be loaded again, so nothing was saved. It begins with "
                f"{text[:80].decode(errors='replace')}; shorten its texts, or leave it out"
            )
        file.write(BETWEEN + text if ends else text)
        position += len(BETWEEN) + len(text)
        ends.append(position)
        digests += _digest(text)
        keys.append(key)
        qualities.append(quality)
    file.write(TAIL)
    return Columns(
        np.array(ends, np.int64),
        np.frombuffer(digests, np.uint8).reshape(-1, DIGEST_BYTES),
        np.array(keys, np.uint64),
        np.array(qualities, np.float64),
    )


def _lines(entries: Sequence[MemoryEntry]) -> Iterator[tuple[bytes, int, float]]:
    if isinstance(entries, StoredEntries):  # their lines are copied, not parsed
        return entries.lines()
    return ((entry_to_json(e), key_digest(e.key.sub_tasks), e.quality) for e in entries)


def _digest(text: bytes) -> bytes:
    return hashlib.blake2b(text, digest_size=DIGEST_BYTES).digest()
