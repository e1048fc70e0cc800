"""JSON as the standard has it: no NaN, no key twice, no nesting without end."""

from __future__ import annotations

import json
from typing import Any

from lerobot_openspm.errors import MemoryFormatError


def loads(text: bytes, where: str) -> Any:
    """Read JSON text.

    Args:
        text: The text, UTF-8.
        where: Names its origin in errors.

    Raises:
        MemoryFormatError: It is not JSON, holds NaN or an infinity, has a key twice, or is nested too deeply.
    """
    try:
        return _DECODER.decode(text.decode())
    except (ValueError, RecursionError) as error:
        raise MemoryFormatError(
            f"{where}: truncated, changed or not JSON ({error}); train or pull it again"
        ) from error


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in fields if keys.count(key) > 1)
        raise ValueError(f"key {twice!r} twice")
    return fields


def _constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")


_DECODER = json.JSONDecoder(object_pairs_hook=_object, parse_constant=_constant)
