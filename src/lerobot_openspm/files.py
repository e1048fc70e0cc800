"""Writing files so that none is ever half-written, and changing a folder one process at a time."""

from __future__ import annotations

import json
import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from filelock import FileLock, Timeout

from lerobot_openspm.errors import OpenSPMError

LOCK_WAIT_S = 60.0


def write_beside(path: Path, blob: bytes) -> None:
    """Write a file beside its place, then rename it there."""
    beside = path.with_name(f".{path.name}.partial")
    with written(beside) as file:
        file.write(blob)
    rename(beside, path)


def write_json(path: Path, data: Any) -> None:
    """Write data as JSON, as a whole or not at all."""
    write_beside(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode())


@contextmanager
def written(path: Path) -> Generator[BinaryIO]:
    """A file to write; it is on the disk when the block ends."""
    with path.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


def rename(source: Path, target: Path) -> None:
    """Rename a file, over another one if there is one; a power cut leaves the one or the other."""
    os.replace(source, target)
    if os.name == "posix":  # elsewhere folders cannot be opened
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


@contextmanager
def locked(path: Path) -> Generator[None]:
    """Keep other processes from changing what a lock file stands for; may be nested in one process.

    Raises:
        OpenSPMError: Another process goes on holding it.
    """
    # The same lock wherever this process asks for it, hence the nesting. The file itself stays: whoever
    # removed it could remove it from under another one that waits for it.
    lock = FileLock(path, timeout=LOCK_WAIT_S, is_singleton=True)
    try:
        lock.acquire()
    except Timeout as error:
        raise OpenSPMError(
            f"{path}: another process has been changing this for {LOCK_WAIT_S:.0f} s; try again"
            " when it is done"
        ) from error
    try:
        yield
    finally:
        lock.release()


def read_text(path: Path, max_bytes: int) -> str:
    """The text of a small file, whoever named it. Raises OSError where it is too long or no regular file."""
    if path.exists() and not path.is_file():  # "/dev/zero" never ends
        raise OSError("it is no file")
    if (size := path.stat().st_size) > max_bytes:
        raise OSError(f"it has {size} bytes, expected up to {max_bytes}")
    return path.read_text("utf-8")
