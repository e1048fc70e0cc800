"""The files of a memory: a header that names and vouches for the others, and is renamed into place last.

The others are named by their content, so that the files of the memory before are still whole when the
header is renamed. That renaming is the one moment in which a memory changes.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from lerobot_openspm.errors import CalibrationError, MemoryFormatError
from lerobot_openspm.files import locked, rename, write_beside, written
from lerobot_openspm.geometry.camera import Camera, cameras_from_dict, cameras_to_dict, load_cameras
from lerobot_openspm.memory.bank import Lines, write_texts
from lerobot_openspm.memory.columns import Columns
from lerobot_openspm.memory.strict_json import loads

# Version 2: objects known by patches. Version 3: key poses with the axis of their constraint. Version 4:
# objects known by boxes, or by shapes whose pixels a segmenter finds. Version 5: a line for every entry.
# Version 6: outcomes, and sub-tasks kept by their own words.
FORMAT, VERSION = "openspm-memory", 6
MEMORY_JSON, CAMERAS_JSON = "memory.json", "cameras.json"
# Until version 4 the arrays had one name.
OLD_ARRAYS = "memory.safetensors"
ENTRIES, ARRAYS, CAMERAS = "memory.entries-{}.json", "memory.arrays-{}.safetensors", "memory.cameras-{}.json"
DATA_NAME = re.compile(r"memory\.(entries-[0-9a-f]{16}\.json|arrays-[0-9a-f]{16}\.safetensors)")
LEFTOVER = re.compile(rf"{DATA_NAME.pattern}|memory\.cameras-[0-9a-f]{{16}}\.json|\.memory\..*\.partial")
LOCK = ".memory.lock"
MAX_JSON_BYTES, MAX_ARRAY_BYTES = 512_000_000, 4_000_000_000
AGAIN = "train or pull it again"

Fields = dict[str, Any]
Arrays = dict[str, NDArray[Any]]


@contextmanager
def changing(directory: Path) -> Generator[None]:
    """Keep others from changing a memory while it is read, changed and saved."""
    # Where there is none yet, there is nothing that could be lost.
    with locked(directory / LOCK) if (directory / MEMORY_JSON).is_file() else nullcontext():
        yield


def write_files(
    directory: Path,
    header: Fields,
    texts: Iterable[bytes],
    arrays: Mapping[str, NDArray[Any]],
    cameras: Mapping[str, Camera],
) -> None:
    """Write a memory. Whatever interrupts this, the folder holds the one before or this one.

    Args:
        directory: Where to.
        header: What it says besides the names and checksums of the files.
        texts: The entries' JSON, as :func:`~lerobot_openspm.memory.bank.texts_of` gives it.
        arrays: Arrays by name.
        cameras: The calibration.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with changing(directory):
        entries_file, lines = _write_lines(directory, texts)
        blob = save_arrays({**_contiguous(arrays), **lines_to_arrays(lines)})
        arrays_file = _write_named(directory, ARRAYS, blob)
        calibration = _json(cameras_to_dict(cameras))
        pending = None
        if _read_if_there(directory / CAMERAS_JSON) != calibration:
            pending = _write_named(directory, CAMERAS, calibration)
        files = {
            "entries": {"file": entries_file},
            "arrays": {"file": arrays_file, "sha256": _sha256(blob)},
            "cameras": {"file": CAMERAS_JSON, "sha256": _sha256(calibration)},
        }
        write_beside(directory / MEMORY_JSON, _json(sealed({**header, "files": files})))
        if pending is not None:
            rename(directory / pending, directory / CAMERAS_JSON)
        _tidy(directory, keep={entries_file, arrays_file})


def _write_lines(directory: Path, texts: Iterable[bytes]) -> tuple[str, Lines]:
    beside = directory / ".memory.entries.json.partial"
    with written(beside) as file:
        lines, sha256 = write_texts(file, texts)
    name = ENTRIES.format(sha256[:16])
    rename(beside, directory / name)
    return name, lines


def _write_named(directory: Path, pattern: str, blob: bytes) -> str:
    name = pattern.format(_sha256(blob)[:16])
    write_beside(directory / name, blob)
    return name


def _tidy(directory: Path, keep: set[str]) -> None:
    """Remove the files of the memory before, and what interrupted writes have left."""
    for path in directory.iterdir():
        if path.name == OLD_ARRAYS or (LEFTOVER.fullmatch(path.name) and path.name not in keep):
            with suppress(OSError):  # what stays does no harm: nothing names it any more
                path.unlink()


def sealed(header: Fields) -> Fields:
    """A header with the checksum of its own content, whatever the order and spacing it is written in."""
    body = {key: value for key, value in header.items() if key != "sha256"}
    canonical = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    return {**body, "sha256": _sha256(canonical)}


def read_header(directory: Path) -> Fields:
    """Read ``memory.json``.

    Raises:
        MemoryFormatError: It is missing, malformed, changed, or of another format or a newer version.
    """
    path = directory / MEMORY_JSON
    header = loads(read_bytes(path, MAX_JSON_BYTES), str(path))
    if not isinstance(header, dict):
        raise MemoryFormatError(f"{path}: expected a JSON object, got {type(header).__name__}")
    if header.get("format") != FORMAT:
        raise MemoryFormatError(f"{path}: got format {header.get('format')!r}, expected {FORMAT!r}")
    version = header.get("version")
    if type(version) is not int or not 1 <= version <= VERSION:
        raise MemoryFormatError(
            f"{path}: got version {version!r}, this release reads up to {VERSION}; "
            "upgrade lerobot_policy_openspm"
        )
    if version >= 5 and header.get("sha256") != _seal_of(header):
        raise MemoryFormatError(
            f"{path}: its checksum is not that of its content: changed or damaged; {AGAIN}. To change a "
            "memory, use openspm memory export and add"
        )
    return header


def _seal_of(header: Fields) -> str | None:
    try:
        return sealed(header)["sha256"]
    except (ValueError, RecursionError):  # an infinity, or nested just not too deeply to be read
        return None


def data_files(directory: Path) -> list[str]:
    """Names of the files that ``memory.json`` needs beside ``cameras.json``. Raises MemoryFormatError."""
    header = read_header(directory)
    if header["version"] < 5:
        return [OLD_ARRAYS]
    return [file_field(header, kind, directory)["file"] for kind in ("entries", "arrays")]


def file_field(header: Mapping[str, Any], kind: str, directory: Path) -> Fields:
    """What a header says of a file: its name and checksum. Raises MemoryFormatError."""
    where = f"{directory / MEMORY_JSON}: files[{kind!r}]"
    try:
        found = header["files"][kind]
        name = str(found["file"])
    except (KeyError, TypeError) as error:
        raise MemoryFormatError(f"{where} is missing or malformed: {error!r}; {AGAIN}") from error
    # Anything else could be a file anywhere.
    if name != CAMERAS_JSON and not DATA_NAME.fullmatch(name):
        raise MemoryFormatError(
            f"{where} has the name {name!r}, expected one like {ENTRIES.format('0' * 16)}"
        )
    return found


def read_arrays(path: Path, sha256: object) -> Arrays:
    """Read arrays that somebody vouches for. Raises MemoryFormatError where they are others."""
    blob = read_bytes(path, MAX_ARRAY_BYTES)
    if _sha256(blob) != sha256:
        raise MemoryFormatError(
            f"{path}: its checksum is not the one in {MEMORY_JSON}: truncated, changed, or from another "
            f"checkpoint; {AGAIN}"
        )
    try:
        return load_arrays(blob)
    except (SafetensorError, KeyError) as error:  # KeyError: a type that NumPy does not have
        raise MemoryFormatError(f"{path}: not safetensors ({error}); {AGAIN}") from error


def read_cameras(directory: Path, header: Mapping[str, Any]) -> dict[str, Camera]:
    """Read ``cameras.json``, which the header vouches for since version 5.

    Raises:
        CalibrationError: It is missing, malformed, or another one.
    """
    path = directory / CAMERAS_JSON
    if header["version"] < 5:
        return load_cameras(path)
    sha256 = file_field(header, "cameras", directory).get("sha256")
    # A save that has just renamed the header has yet to rename this one, or was interrupted before it did.
    # It is looked for under both names in the order of that renaming: so it is not missed in between.
    pending = directory / CAMERAS.format(str(sha256)[:16])
    for file in (pending, path):
        if (blob := _read_if_there(file)) is not None and _sha256(blob) == sha256:
            return cameras_from_dict(loads(blob, str(file)), str(file))
    cameras = load_cameras(path)
    raise CalibrationError(
        f"{path}: its checksum is not the one in {MEMORY_JSON}: changed, or from another checkpoint. To use "
        f"its {len(cameras)} cameras, pass --policy.cameras={path}, or put them into the checkpoint with "
        f"openspm memory cameras --path={directory} --file={path}"
    )


def lines_to_arrays(lines: Lines) -> Arrays:
    """The arrays that say where the entries' lines are."""
    return {"entries.ends": lines.ends, "entries.digests": lines.digests}


def lines_from_arrays(arrays: Mapping[str, NDArray[Any]], where: str) -> Lines:
    """Inverse of :func:`lines_to_arrays`. Raises MemoryFormatError naming file and array."""
    lines = Lines(*_named(arrays, ("entries.ends", "entries.digests"), where))
    lines.check(where)
    return lines


def columns_to_arrays(groups: Sequence[Columns]) -> Arrays:
    """The arrays that entries are found by, of several groups one after the other."""
    return {
        "entries.keys": np.concatenate([columns.digests for columns in groups]),
        "entries.qualities": np.concatenate([columns.qualities for columns in groups]),
    }


def columns_from_arrays(arrays: Mapping[str, NDArray[Any]], where: str) -> Columns:
    """Inverse of :func:`columns_to_arrays`. Raises MemoryFormatError naming file and array."""
    return Columns(*_named(arrays, ("entries.keys", "entries.qualities"), where))


def _named(
    arrays: Mapping[str, NDArray[Any]], names: tuple[str, str], where: str
) -> tuple[NDArray[Any], NDArray[Any]]:
    for name in names:
        if name not in arrays:
            raise MemoryFormatError(f"{where}: array {name!r} is missing, got {sorted(arrays)}; {AGAIN}")
    return arrays[names[0]], arrays[names[1]]


def read_bytes(path: Path, limit: int) -> bytes:
    """Read a file of a memory, of a bounded size. Raises MemoryFormatError."""
    try:
        size = path.stat().st_size
        if size > limit:
            raise MemoryFormatError(f"{path}: {size} bytes, more than the {limit} this release reads")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        raise MemoryFormatError(
            f"no memory at {path}: a checkpoint of this policy holds {MEMORY_JSON} and the files that it "
            "names; train with lerobot-train --policy.type=openspm, or pull the whole checkpoint. In a "
            "training's folder it is checkpoints/last/pretrained_model"
        ) from error


def _contiguous(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    return {key: np.ascontiguousarray(value) for key, value in arrays.items()}


def _read_if_there(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None


def _sha256(blob: bytes) -> str:
    return hashlib.sha256(blob).hexdigest()


def _json(data: object) -> bytes:
    return (json.dumps(data, indent=1, allow_nan=False) + "\n").encode()
