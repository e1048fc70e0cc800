"""Writing files so that none is ever half-written."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


def write_beside(path: Path, blob: bytes) -> None:
    """Write a file beside its place, then rename it there."""
    beside = path.with_name(f".{path.name}.partial")
    with beside.open("wb") as file:
        file.write(blob)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)


def write_json(path: Path, data: Any) -> None:
    """Write data as JSON, as a whole or not at all."""
    write_beside(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode())
