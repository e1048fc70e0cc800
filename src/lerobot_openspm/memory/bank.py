"""The entries of a memory as one file: a JSON list with an entry on every line, read a line at a time.

Where every line ends and its digest are kept beside the file, so that a memory of a million entries is loaded
without reading them, and nothing that was changed or damaged is read without being noticed.
"""

from __future__ import annotations

import hashlib
import json
import os
import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, overload

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.memory.columns import Columns
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.fields import LIMIT, MALFORMED
from lerobot_openspm.memory.store import entry_from_fields, entry_to_fields
from lerobot_openspm.memory.strict_json import loads

HEAD, BETWEEN, TAIL = b"[\n", b",\n", b"\n]\n"
DIGEST_BYTES = 16
MAX_LINE_BYTES = 4_000_000
# So many of the entries read last are kept in memory.
KEPT_ENTRIES = 4096


@dataclass(frozen=True)
class Lines:
    """Where the lines of a file of entries are.

    Attributes:
        ends: Byte ``(n,)`` after the end of every entry's text, int64.
        digests: BLAKE2b digests ``(n, 16)`` of the texts, uint8.
    """

    ends: NDArray[np.int64]
    digests: NDArray[np.uint8]

    @property
    def n_bytes(self) -> int:
        """Size of the whole file."""
        return (int(self.ends[-1]) if len(self.ends) else len(HEAD)) + len(TAIL)

    def check(self, where: str) -> None:
        """Raise MemoryFormatError unless the arrays are such as :func:`write_texts` returns."""
        n = len(self.ends)
        if self.ends.dtype != np.int64 or self.ends.shape != (n,):
            raise MemoryFormatError(
                f"{where}: array 'entries.ends' is {self.ends.dtype} of {self.ends.shape}, expected int64 of "
                f"{(n,)}; train or pull it again"
            )
        if self.digests.dtype != np.uint8 or self.digests.shape != (n, DIGEST_BYTES):
            raise MemoryFormatError(
                f"{where}: array 'entries.digests' is {self.digests.dtype} of {self.digests.shape}, expected "
                f"uint8 of {(n, DIGEST_BYTES)}; train or pull it again"
            )
        lengths = np.diff(self.ends, prepend=len(HEAD) - len(BETWEEN)) - len(BETWEEN)
        if n and not (lengths.min() > 0 and lengths.max() <= MAX_LINE_BYTES):
            raise MemoryFormatError(
                f"{where}: array 'entries.ends' does not count up line by line: lines of {lengths.min()} to "
                f"{lengths.max()} bytes, expected 1 to {MAX_LINE_BYTES}; train or pull it again"
            )


class _Opened:
    """A file that is read here and there, and closed when nobody has it any more.

    It is not mapped: reading a mapped file that somebody has truncated ends the process.
    """

    def __init__(self, path: Path, n_bytes: int):
        self._path = path
        try:
            self._descriptor = os.open(path, os.O_RDONLY)
        except OSError as error:
            raise MemoryFormatError(
                f"no memory at {path}: {error}; not pulled; train again, or pull the whole checkpoint"
            ) from error
        weakref.finalize(self, os.close, self._descriptor)
        if (size := os.fstat(self._descriptor).st_size) != n_bytes:
            raise MemoryFormatError(
                f"{path}: {size} bytes, expected {n_bytes}: truncated or changed; train or pull it again"
            )

    def read(self, start: int, n_bytes: int, what: str) -> bytes:
        """So many bytes from a place on. Raises MemoryFormatError where there are fewer."""
        try:
            found = os.pread(self._descriptor, n_bytes, start)
        except OSError as error:
            raise MemoryFormatError(f"{self._path}: {what} cannot be read: {error}; try again") from error
        if len(found) != n_bytes:
            raise MemoryFormatError(
                f"{self._path}: {what} has {len(found)} bytes, expected {n_bytes}: truncated since it was "
                "opened; train or pull it again"
            )
        return found


class EntryBank(Sequence[MemoryEntry]):
    """Entries in a file, each read and checked when it is asked for.

    The file is content-addressed and never changed, only removed when nobody names it any more; what is open
    stays readable. Reading raises MemoryFormatError for a line that is not what was written.
    """

    def __init__(
        self,
        path: Path,
        lines: Lines,
        columns: Columns,
        objects: frozenset[str],
        rows: range | None = None,
        opened: _Opened | None = None,
    ):
        """Open a file.

        Args:
            path: The file.
            lines: Where its lines are.
            columns: What is kept of all its entries, to find one by.
            objects: The objects that its entries have key poses at.
            rows: Which of them this is about; all if not given.
            opened: The file, where it is open already.

        Raises:
            MemoryFormatError: The file is missing, of another size, or the lines cannot be.
        """
        self._path, self._lines, self._columns, self.objects = path, lines, columns, objects
        self._rows = range(len(lines.ends)) if rows is None else rows
        lines.check(str(path))
        _check_columns(columns, len(lines.ends), str(path))
        self._opened = _Opened(path, lines.n_bytes) if opened is None else opened
        self._entry = lru_cache(KEPT_ENTRIES)(self._read)

    def __reduce__(self) -> tuple[type[EntryBank], tuple[Path, Lines, Columns, frozenset[str], range]]:
        return type(self), (self._path, self._lines, self._columns, self.objects, self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> MemoryEntry: ...
    @overload
    def __getitem__(self, index: slice) -> EntryBank: ...
    def __getitem__(self, index: int | slice) -> MemoryEntry | EntryBank:
        if isinstance(index, slice):
            rows = self._rows[index]
            return EntryBank(self._path, self._lines, self._columns, self.objects, rows, self._opened)
        return self._entry(self._rows[index])

    def __iter__(self) -> Iterator[MemoryEntry]:
        # Past the cache: going through all entries must neither hold them all nor push out those in use.
        return (self._read(row) for row in self._rows)

    def columns(self) -> Columns:
        """What is kept of the entries, to find one without reading all."""
        rows = np.arange(self._rows.start, self._rows.stop, self._rows.step)
        return Columns(self._columns.digests[rows], self._columns.qualities[rows])

    def texts(self) -> Iterator[bytes]:
        """The entries' JSON, unread but known to be what was written."""
        return (self._text(row) for row in self._rows)

    def _text(self, row: int) -> bytes:
        start = int(self._lines.ends[row - 1]) + len(BETWEEN) if row else len(HEAD)
        text = self._opened.read(start, int(self._lines.ends[row]) - start, f"entries[{row}]")
        if _digest(text) != self._lines.digests[row].tobytes():
            raise MemoryFormatError(
                f"{self._path}: entries[{row}] is not what its digest says: changed or damaged; train or "
                "pull it again. To change entries, use openspm memory export and add"
            )
        return text

    def _read(self, row: int) -> MemoryEntry:
        where = f"{self._path}: entries[{row}]"
        entry = entry_from_json(self._text(row), where)
        if unknown := set(entry.objects) - self.objects:
            raise MemoryFormatError(
                f"{where} has key poses at {sorted(unknown)}, which memory.json does not list"
            )
        if entry.quality != self._columns.qualities[row]:
            raise MemoryFormatError(f"{where} has another quality than array 'entries.qualities' says")
        return entry


def _check_columns(columns: Columns, n: int, where: str) -> None:
    for name, array, dtype in (("keys", columns.digests, np.uint64), ("qualities", columns.qualities, float)):
        if array.dtype != dtype or array.shape != (n,):
            raise MemoryFormatError(
                f"{where}: array 'entries.{name}' is {array.dtype} of {array.shape}, expected "
                f"{np.dtype(dtype)} of {(n,)}; train or pull it again"
            )


def anchored_objects(entries: Sequence[MemoryEntry]) -> frozenset[str]:
    """Names of all objects that entries have key poses at."""
    if isinstance(entries, EntryBank):
        return entries.objects
    return frozenset(name for entry in entries for name in entry.objects)


def entry_from_json(text: bytes, where: str) -> MemoryEntry:
    """Read one entry's JSON; `where` names it in errors.

    Raises:
        MemoryFormatError: It is not JSON, or a field is missing, unknown, of another type, or out of range.
    """
    fields = loads(text, where)
    try:
        return entry_from_fields(fields)
    except MALFORMED as error:
        raise MemoryFormatError(f"{where} is malformed: {error!r}; train or pull it again") from error


def entry_to_json(entry: MemoryEntry) -> bytes:
    """One entry as JSON on one line.

    Raises:
        ValueError: A number is not finite.
        MemoryFormatError: It has counted further than what is read again.
    """
    for name in ("version", "trials"):
        if (count := getattr(entry, name)) > LIMIT:
            raise MemoryFormatError(
                f"the entry of {entry.source!r} has {name!r} {count}, expected up to {LIMIT:g}: it could "
                "never be loaded again, so nothing was saved; export it, correct the number, and add it again"
            )
    return json.dumps(entry_to_fields(entry), allow_nan=False, ensure_ascii=False).encode()


def texts_of(entries: Sequence[MemoryEntry]) -> Iterator[bytes]:
    """The JSON of every entry, a line each; what lies in a file already is taken from there as it is."""
    return entries.texts() if isinstance(entries, EntryBank) else map(entry_to_json, entries)


def write_texts(file: BinaryIO, texts: Iterable[bytes]) -> tuple[Lines, str]:
    """Write entries, given as :func:`texts_of` gives them, as one JSON list.

    Returns:
        Where the lines are, and the SHA-256 of the file in hexadecimal.

    Raises:
        MemoryFormatError: An entry is longer than what is read again.
    """
    sha256, position = hashlib.sha256(), 0
    ends: list[int] = []
    digests: list[bytes] = []

    def write(blob: bytes) -> int:
        file.write(blob)
        sha256.update(blob)
        return position + len(blob)

    position = write(HEAD)
    for text in texts:
        _check_length(text, len(ends))
        position = write(BETWEEN + text if ends else text)
        ends.append(position)
        digests.append(_digest(text))
    write(TAIL)
    rows = np.frombuffer(b"".join(digests), np.uint8).reshape(-1, DIGEST_BYTES)
    return Lines(np.array(ends, np.int64), rows), sha256.hexdigest()


def _check_length(text: bytes, row: int) -> None:
    if len(text) > MAX_LINE_BYTES:
        raise MemoryFormatError(
            f"entries[{row}] has {len(text)} bytes as JSON, expected up to {MAX_LINE_BYTES}: it could never "
            f"be loaded again, so nothing was saved. It begins with {text[:80].decode(errors='replace')}; "
            "shorten its texts, or leave it out"
        )


def _digest(text: bytes) -> bytes:
    return hashlib.blake2b(text, digest_size=DIGEST_BYTES).digest()
