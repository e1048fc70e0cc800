"""Known objects as JSON-able fields and NumPy arrays, and back, with everything that was read checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.perception.objects.base import KnownObject, Record
from lerobot_openspm.perception.objects.kinds import KINDS

VERSION = 1


def to_parts(known: KnownObject) -> Record:
    """Split an object into what belongs in JSON and what belongs in a safetensors file."""
    fields, arrays = known.to_record()
    return {"version": VERSION, **fields}, arrays


def from_parts(fields: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], where: str) -> KnownObject:
    """Put an object together again; ``where`` names its origin in errors.

    Raises:
        MemoryFormatError: A field or array is missing, of a wrong type or shape, not finite, or out of range.
    """
    version, name, kind = fields.get("version"), fields.get("name"), fields.get("kind")
    if version != VERSION:
        raise MemoryFormatError(
            f"{where}: object model of version {version!r}, expected {VERSION}; learn the objects again"
        )
    if not isinstance(name, str) or not name:
        raise MemoryFormatError(f"{where}: 'name' is {name!r}, expected a noun phrase")
    if not isinstance(kind, str) or kind not in KINDS:
        raise MemoryFormatError(
            f"{where}: object {name!r} is of kind {kind!r}, expected one of {', '.join(KINDS)}; learn it "
            "again"
        )
    return KINDS[kind].from_record(fields, arrays, where)
