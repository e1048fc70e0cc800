"""Reading and writing a memory: ``memory.json``, and the arrays that it names.

``memory.json`` holds the header first, then the entries, one on every line, so that people can read it too.
The arrays are in a safetensors file whose name is its checksum: saving never overwrites the arrays of the
memory before. Renaming ``memory.json`` into place is the one moment in which a memory changes.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Generator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct, field
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.files import locked, rename, write_beside, written
from lerobot_openspm.geometry.camera import cameras_from_dict, cameras_to_dict, load_cameras
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.not_learned import MAX_RECORDS, NotLearned
from lerobot_openspm.memory.schema import (
    AGAIN,
    VERSION,
    Count,
    Name,
    Origin,
    Record,
    checked,
    loads,
    memory_from,
    origin_of,
    record_of,
)
from lerobot_openspm.memory.stored_entries import (
    Columns,
    OpenFile,
    StoredEntries,
    anchored_objects,
    write_entries,
)
from lerobot_openspm.perception.objects.base import KnownObject
from lerobot_openspm.perception.objects.store import from_parts as object_from_parts
from lerobot_openspm.perception.objects.store import to_parts as object_to_parts

FORMAT = "openspm-memory"
# Where a checkpoint keeps the memories of other workplaces than the first.
WORKPLACES = "workplaces"
MEMORY_JSON, ARRAYS, LOCK = "memory.json", "memory-{}.safetensors", ".memory.lock"
# The arrays of earlier saves, and what interrupted saves have left.
LEFTOVER = re.compile(r"memory-[0-9a-f]{64}\.safetensors|\.memory[.-].*\.partial")
# A JSON string holds no raw line break, so these bytes occur in no name or text.
SEAL, ENTRIES = b',\n "sha256": "', b'",\n "entries": [\n'
BEGINNING = re.compile(rb'\{\s*"format":\s*"openspm-memory",\s*"version":\s*(\d{1,9})\b')
FIRST_BYTES, MAX_HEADER_BYTES, MAX_ARRAY_BYTES = 2**16, 2**24, 2**32
# Memories up to this size are read at once; the entries of a larger one when they are asked for.
READ_AT_LOAD = 2000

NO_FILE = (FileNotFoundError, NotADirectoryError, IsADirectoryError)

Arrays = Mapping[str, NDArray[Any]]


class _NotLearned(Record):
    what: Literal["object", "demonstrations", "instruction"]
    name: Name
    demonstrations: Count
    reason: Name


class Header(Origin):
    """What ``memory.json`` says before its entries.

    Attributes:
        cameras: A calibration, as :func:`~lerobot_openspm.geometry.camera.cameras_to_dict` gives it.
        objects: Fields of the objects' models; their arrays are "objects.NAME.ARRAY".
        anchored: Names of all objects that entries have key poses at.
        n_entries: How many of the entries are in use; those after them are superseded.
        arrays: Name of the file of arrays; its SHA-256 is part of the name.
        not_learned: What the demonstrations could not teach.
        workplaces: Of how many workplaces the checkpoint holds memories.
    """

    cameras: dict[str, Any]
    objects: list[dict[str, Any]]
    anchored: list[Name]
    n_entries: Count
    arrays: Annotated[str, Meta(pattern=r"\Amemory-[0-9a-f]{64}\.safetensors\Z")]
    not_learned: Annotated[list[_NotLearned], Meta(max_length=MAX_RECORDS)] = field(default_factory=list)
    workplaces: Annotated[int, Meta(ge=1, le=1000)] = 1


class _Named(Struct):
    name: Name


@contextmanager
def changing(directory: Path) -> Generator[None]:
    """Keep other processes from changing a memory while it is read, changed and saved."""
    # A folder without a memory needs no lock: there is nothing to lose.
    with locked(directory / LOCK) if (directory / MEMORY_JSON).is_file() else nullcontext():
        yield


def write_memory(memory: Memory, directory: Path) -> None:
    """Write a memory. If this is interrupted, the folder still holds the memory before, or this one.

    Raises:
        MemoryFormatError: Something in it could not be read again.
    """
    directory.mkdir(parents=True, exist_ok=True)
    header, arrays = _header_of(memory)
    beside = directory / ".memory.json.partial"
    with changing(directory):
        with written(beside) as file:
            file.write(_sealed(header))
            columns = write_entries(file, [memory.entries, memory.superseded])
            blob = save_arrays({**arrays, **columns.to_arrays()})
            header.arrays = ARRAYS.format(hashlib.sha256(blob).hexdigest())
            write_beside(directory / header.arrays, blob)
            file.seek(0)
            file.write(_sealed(header))  # of the same length: only two checksums differ
        rename(beside, directory / MEMORY_JSON)
        for path in directory.iterdir():
            if LEFTOVER.fullmatch(path.name) and path.name != header.arrays:
                with suppress(OSError):  # a file that stays does no harm: nothing names it
                    path.unlink()


def _header_of(memory: Memory) -> tuple[Header, Arrays]:
    """The header, except for the name of the arrays, and the arrays of the objects' models."""
    objects: list[dict[str, Any]] = []
    arrays: dict[str, NDArray[Any]] = {}
    for model in memory.objects.values():
        fields, own = object_to_parts(model)
        objects.append(fields)
        arrays |= {f"objects.{model.name}.{key}": np.ascontiguousarray(own[key]) for key in own}
    anchored = sorted(anchored_objects(memory.entries) | anchored_objects(memory.superseded))
    fields = {
        **origin_of(memory, FORMAT),
        "cameras": cameras_to_dict(memory.cameras),
        "objects": objects,
        "anchored": anchored,
        "n_entries": len(memory.entries),
        "arrays": ARRAYS.format("0" * 64),
        "not_learned": memory.not_learned,
        "workplaces": memory.workplaces,
    }
    return record_of(fields, Header, "the memory"), arrays


def _sealed(header: Header) -> bytes:
    """The text of a header up to its entries, with its own checksum."""
    body = json.dumps(msgspec.to_builtins(header), indent=1, allow_nan=False, ensure_ascii=False).encode()
    body = body.removesuffix(b"\n}")
    head = body + SEAL + hashlib.sha256(body).hexdigest().encode() + ENTRIES
    if len(head) > MAX_HEADER_BYTES:
        raise MemoryFormatError(
            f"the memory's objects and cameras take {len(head)} bytes, expected up to {MAX_HEADER_BYTES}: "
            "they could never be loaded again, so nothing was saved"
        )
    return head


def read_memory(directory: Path, cameras: Path | None = None) -> Memory:
    """Read a memory.

    Args:
        directory: Folder of a checkpoint or of a mined memory.
        cameras: Calibration file to use instead of the memory's own.

    Raises:
        MemoryFormatError: A file is missing, truncated, changed, malformed, too large, or of another version.
        CalibrationError: The calibration is malformed.
    """
    while True:
        file, header, start = _opened(directory)
        try:
            return _loaded(file, header, start, cameras)
        except MemoryFormatError:
            # If another process has saved a newer memory meanwhile, its arrays have another name.
            if header == _opened(directory)[1]:
                raise


def arrays_file(directory: Path) -> str:
    """Name of the file that a memory needs beside ``memory.json``. Raises MemoryFormatError."""
    return _opened(directory)[1].arrays


def workplaces_of(directory: Path) -> int:
    """Of how many workplaces a checkpoint holds memories. Raises MemoryFormatError."""
    return _opened(directory)[1].workplaces


def _opened(directory: Path) -> tuple[OpenFile, Header, int]:
    """``memory.json``, its header, and where its first entry starts."""
    path = directory / MEMORY_JSON
    try:
        file, n_bytes = OpenFile(path), FIRST_BYTES
        blob = file.read(0, n_bytes)
        while ENTRIES not in blob and n_bytes < min(file.n_bytes, MAX_HEADER_BYTES):
            n_bytes *= 2
            blob = file.read(0, n_bytes)
    except NO_FILE as error:
        raise MemoryFormatError(_missing(path)) from error
    _check_version(blob, path)
    head, mark, _ = blob.partition(ENTRIES)
    body, _, seal = head.rpartition(SEAL)
    if not mark or seal != hashlib.sha256(body).hexdigest().encode():
        raise MemoryFormatError(
            f"{path}: its checksum is not that of its content: truncated, changed or damaged; {AGAIN}. To "
            "change a memory, use openspm memory export and add"
        )
    return file, checked(loads(body + b"}", str(path)), Header, str(path)), len(head) + len(mark)


def _check_version(blob: bytes, path: Path) -> None:
    found = BEGINNING.match(blob)
    if found is None:
        raise MemoryFormatError(
            f"{path}: truncated, changed or no memory: it begins with {blob[:60]!r}, expected format "
            f"{FORMAT!r} and version {VERSION}; {AGAIN}"
        )
    if (version := int(found[1])) != VERSION:
        do = "train again: lerobot-train --policy.type=openspm --dataset.repo_id=NAME --policy.cameras=FILE"
        raise MemoryFormatError(
            f"{path}: got version {version}, expected {VERSION}; "
            f"{'upgrade lerobot_policy_openspm' if version > VERSION else do}"
        )


def _loaded(file: OpenFile, header: Header, start: int, cameras_file: Path | None) -> Memory:
    where = str(file.path)
    arrays = _read_arrays(file.path.with_name(header.arrays))
    columns = Columns.from_arrays(arrays, str(file.path.with_name(header.arrays)))
    stored = StoredEntries(file, start, columns, frozenset(header.anchored))
    if header.n_entries > len(stored):
        raise MemoryFormatError(
            f"{where}: 'n_entries' is {header.n_entries}, but it holds {len(stored)}; {AGAIN}"
        )
    entries, superseded = stored[: header.n_entries], stored[header.n_entries :]
    is_small = len(stored) <= READ_AT_LOAD
    cameras = cameras_from_dict(header.cameras, where) if cameras_file is None else load_cameras(cameras_file)
    return memory_from(
        header,
        where,
        entries=tuple(entries) if is_small else entries,
        superseded=tuple(superseded) if is_small else superseded,
        objects=_objects(header.objects, arrays, where),
        cameras=cameras,
        not_learned=tuple(NotLearned(**msgspec.structs.asdict(one)) for one in header.not_learned),
        workplaces=header.workplaces,
    )


def _objects(records: list[dict[str, Any]], arrays: Arrays, where: str) -> dict[str, KnownObject]:
    models: dict[str, KnownObject] = {}
    for i, fields in enumerate(records):
        name = checked(fields, _Named, f"{where}: objects[{i}]").name
        if name in models:
            raise MemoryFormatError(
                f"{where}: 'objects' has {name!r} twice, expected each name once; {AGAIN}"
            )
        prefix = f"objects.{name}."
        own = {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
        models[name] = object_from_parts(fields, own, where)
    return models


def _read_arrays(path: Path) -> Arrays:
    """Read arrays, whose file is named by its checksum."""
    try:
        if (size := path.stat().st_size) > MAX_ARRAY_BYTES:
            raise MemoryFormatError(f"{path}: {size} bytes, more than the {MAX_ARRAY_BYTES} that are read")
        blob = path.read_bytes()
    except NO_FILE as error:
        raise MemoryFormatError(_missing(path)) from error
    if path.name != ARRAYS.format(hashlib.sha256(blob).hexdigest()):
        raise MemoryFormatError(f"{path}: its checksum is not its name: truncated or changed; {AGAIN}")
    try:
        return load_arrays(blob)
    except (SafetensorError, KeyError) as error:  # KeyError: a type that NumPy does not have
        raise MemoryFormatError(f"{path}: not safetensors ({error}); {AGAIN}") from error


def _missing(path: Path) -> str:
    return (
        f"no memory at {path}: a checkpoint of this policy holds {MEMORY_JSON} and the file that it names; "
        "train with lerobot-train --policy.type=openspm, or pull the whole checkpoint. In a training's "
        "folder it is checkpoints/last/pretrained_model"
    )
