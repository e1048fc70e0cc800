"""Entries that go from one memory to another: as a memory's folder, or as a JSON file that people edit."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.files import write_beside
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.merging import SOURCES
from lerobot_openspm.memory.schema import (
    VERSION,
    Name,
    Origin,
    checked,
    entry_from_fields,
    entry_to_json,
    loads,
    memory_from,
    origin_of,
    record_of,
)
from lerobot_openspm.memory.stored_entries import anchored_objects
from lerobot_openspm.perception.objects.base import KnownObject
from lerobot_openspm.perception.objects.store import to_parts as object_to_parts

FORMAT = "openspm-entries"
MAX_FILE_BYTES = 512_000_000


class EntriesFile(Origin):
    """A file of entries.

    Attributes:
        objects: By name, :func:`digest` of the model of every object that the entries have key poses at.
        entries: The entries, each as :func:`~lerobot_openspm.memory.schema.entry_to_json` writes it.
    """

    objects: dict[Name, str]
    entries: list[Any]


@dataclass(frozen=True)
class EntryImport:
    """Entries from elsewhere.

    Attributes:
        memory: The entries and what they were mined with. One from a file has no objects and no cameras.
        digests: By name, what tells apart the models of the objects that the entries have key poses at.
        is_edited: Whether an entry takes the place of one from the same source whatever both hold.
    """

    memory: Memory
    digests: Mapping[str, str]
    is_edited: bool


def digest(model: KnownObject) -> str:
    """What tells a model of an object from any other one."""
    fields, arrays = object_to_parts(model)
    sha256 = hashlib.sha256(json.dumps(fields, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        sha256.update(f"{name} {array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return sha256.hexdigest()[:16]


def write_entries_file(memory: Memory, path: Path) -> None:
    """Write the entries of a memory as one JSON file, an entry on every line."""
    names = anchored_objects(memory.entries) & memory.objects.keys()
    objects = {name: digest(memory.objects[name]) for name in sorted(names)}
    fields = {**origin_of(memory, FORMAT), "objects": objects, "entries": []}
    origin = msgspec.to_builtins(record_of(fields, EntriesFile, "the file"))
    del origin["entries"]
    head = json.dumps(origin, indent=1, ensure_ascii=False).removesuffix("\n}").encode()
    lines = b",\n".join(map(entry_to_json, memory.entries))
    write_beside(path, head + b',\n "entries": [\n' + lines + b"\n ]\n}\n")


def read_import(path: Path) -> EntryImport:
    """Read entries from a memory's folder or from a file that :func:`write_entries_file` wrote.

    Raises:
        MemoryFormatError: There is none, or it is malformed. Names file and field.
        CalibrationError: The memory's calibration is malformed.
    """
    if path.is_dir():
        memory = read_memory(path)
        return EntryImport(memory, {name: digest(memory.objects[name]) for name in memory.objects}, False)
    if not path.is_file():
        raise MemoryFormatError(
            f"nothing at {path}; expected a checkpoint's folder, or a file that `openspm memory export` wrote"
        )
    if (size := path.stat().st_size) > MAX_FILE_BYTES:
        raise MemoryFormatError(
            f"{path}: {size} bytes, expected up to {MAX_FILE_BYTES}; export fewer entries"
        )
    fields = loads(path.read_bytes(), str(path))
    got = [fields.get(name) for name in ("format", "version")] if isinstance(fields, dict) else [fields]
    if got != [FORMAT, VERSION]:
        raise MemoryFormatError(
            f"{path}: got format and version {str(got)[:100]}, expected {FORMAT!r} and {VERSION}, as "
            "`openspm memory export` writes it"
        )
    file = checked(fields, EntriesFile, str(path))
    entries = tuple(entry_from_fields(e, f"{path}: entries[{i}]") for i, e in enumerate(file.entries))
    memory = memory_from(file, str(path), entries=entries, objects={}, cameras={})
    return EntryImport(memory, file.objects, is_edited=True)


def combined(ours: Memory, imported: EntryImport, where: str) -> Memory:
    """A memory with the imported entries that it does not hold yet; what they replace is superseded.

    Args:
        ours: The memory. Where nothing is new, it is returned itself.
        imported: What is added.
        where: Names their origin in errors.

    Raises:
        MemoryFormatError: It comes from another robot, from another perception, or has key poses in
            the frames of other models of objects. Or it is a file with two entries of one source and
            instruction, or with an edited entry that was merged into another one.
    """
    theirs = imported.memory
    for name in ("perception", "segmentation", "shape", "simulator_objects"):
        mine, other = getattr(ours, name), getattr(theirs, name)
        if mine != other:
            raise MemoryFormatError(
                f"{where}: {name} is {other!r}, the memory's {mine!r}: its key poses are in other frames. "
                "Mine its demonstrations into this memory: openspm teach, or --policy.memory_update=append"
            )
    _check_objects(ours, imported, where)
    if imported.is_edited:
        _check_twice(theirs.entries, where)
    new = _not_held(ours, imported, where)
    after = (
        _with_edited(ours, new, theirs)
        if imported.is_edited
        else ours.appended(replace(theirs, entries=new, superseded=()))
    )
    return after if new else ours


def _not_held(ours: Memory, imported: EntryImport, where: str) -> tuple[MemoryEntry, ...]:
    """The imported entries that a memory does not hold: neither as they are, nor within merged ones.

    From another memory, nothing is taken that this one has superseded: what was replaced, merged or removed
    stays so until it is restored. A file that people edit may well bring back what an entry was before.
    """
    held = {entry_to_json(entry) for entry in ours.entries}
    superseded = {entry_to_json(entry) for entry in ours.superseded}
    merged = {(part, e.key): e.source for e in ours.entries for part in _merged_sources(e)}
    new: list[MemoryEntry] = []
    for i, entry in enumerate(imported.memory.entries):
        text, within = entry_to_json(entry), merged.get((entry.source, entry.key))
        if text in held or (text in superseded and (within or not imported.is_edited)):
            continue
        if within and imported.is_edited:
            raise MemoryFormatError(
                f"{where}: entries[{i}] is an edited {entry.source!r}, which is part of the merged entry "
                f"{within!r} by now; export and edit that one, or remove it and restore what it was made of"
            )
        if not within:
            new.append(entry)
    return tuple(new)


def _merged_sources(entry: MemoryEntry) -> Sequence[str]:
    parts = entry.source.split(SOURCES)
    return parts if len(parts) > 1 else ()


def _check_twice(entries: Sequence[MemoryEntry], where: str) -> None:
    """Of one source and instruction there may be one entry in a file, as each takes the place of another."""
    first: dict[tuple[str, str], int] = {}
    for i, entry in enumerate(entries):
        if (before := first.setdefault((entry.source, entry.language), i)) != i:
            raise MemoryFormatError(
                f"{where}: entries[{before}] and entries[{i}] are both of source {entry.source!r} and "
                f"instruction {entry.language!r}, expected one of each; leave one out, or give it another "
                "source"
            )


def _with_edited(ours: Memory, new: Sequence[MemoryEntry], theirs: Memory) -> Memory:
    """The memory with edited entries in the place of those of the same source and instruction."""
    edited = {(entry.source, entry.language): entry for entry in new}
    gone = [entry for entry in ours.entries if (entry.source, entry.language) in edited]
    versions = {(entry.source, entry.language): entry.version for entry in gone}
    added = [
        replace(entry, version=max(entry.version, 1 + versions.get(key, 0))) for key, entry in edited.items()
    ]
    kept = tuple(entry for entry in ours.entries if (entry.source, entry.language) not in edited)
    rest = replace(ours, entries=kept).appended(replace(theirs, entries=tuple(added)))
    return replace(rest, superseded=(*ours.superseded, *gone))


def _check_objects(ours: Memory, imported: EntryImport, where: str) -> None:
    """Every object that entries have key poses at has to be known by the same model, or to come along."""
    theirs = imported.memory
    for name in sorted(anchored_objects(theirs.entries)):
        model = ours.objects.get(name)
        if model is None and name not in theirs.objects and ours.perception != "oracle":
            raise MemoryFormatError(
                f"{where}: entries have key poses at {name!r}, which the memory knows no model of; it knows "
                f"{', '.join(sorted(ours.objects))}. Add from the checkpoint's folder, which holds the models"
            )
        if model is not None and imported.digests.get(name) != digest(model):
            raise MemoryFormatError(
                f"{where}: 'objects': {name!r} is known by another model there, so its key poses are in "
                "another frame. Mine its demonstrations into this memory: openspm teach, or "
                "--policy.memory_update=append"
            )
