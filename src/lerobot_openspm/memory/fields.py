"""Fields of a JSON object, read with their types. An error names the field, and what it holds."""

from __future__ import annotations

import unicodedata
from collections.abc import Collection, Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

# What reading a field of another kind, or a number beyond what Python converts, ends in.
MALFORMED = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)

Fields = Mapping[str, Any]

# Beyond what any robot, unit or count needs, and such that sums and products stay finite and exact.
LIMIT = 1e9
# What a text may hold of the characters that are not printed.
WHITESPACE = "\t\n\r"


def known(fields: Any, names: Collection[str], what: str) -> Fields:
    """The fields of an object that may hold some names alone.

    Raises:
        TypeError: It is no object.
        ValueError: It has a field of another name.
    """
    if type(fields) is not dict:
        raise TypeError(f"{what} is {fields!r}, expected an object")
    found = cast(Fields, fields)
    if unknown := [name for name in found if name not in names]:
        raise ValueError(f"{what} has unknown fields {unknown}")
    return found


def readable(value: Any, what: str, line: bool = False) -> str:
    """A text that can be written as UTF-8 and shown.

    Args:
        value: What should be one.
        what: Names it in errors.
        line: Whether it has to be one line, and not empty.

    Raises:
        ValueError: It is anything else.
    """
    if type(value) is not str:
        raise ValueError(f"{what} is {_short(value)}, expected text")
    # Cc and Cs: a terminal obeys control characters, and no file takes a lone surrogate.
    allowed = "" if line else WHITESPACE
    if odd := [c for c in value if unicodedata.category(c) in ("Cc", "Cs") and c not in allowed]:
        raise ValueError(f"{what} is {_short(value)}, expected text without {odd[0]!r}")
    if line and not value.strip():
        raise ValueError(f"{what} is {_short(value)}, expected text that is not empty")
    return value


def text(fields: Fields, name: str) -> str:
    """A text. Raises ValueError for anything else."""
    return readable(fields[name], f"{name!r}")


def line(fields: Fields, name: str) -> str:
    """A text of one line, not empty. Raises ValueError for anything else."""
    return readable(fields[name], f"{name!r}", line=True)


def choice(fields: Fields, name: str, choices: Collection[str]) -> str:
    """One of several texts. Raises ValueError for anything else."""
    if (value := text(fields, name)) not in choices:
        raise ValueError(f"{name!r} is {value!r}, expected one of {', '.join(map(repr, choices))}")
    return value


def texts(fields: Fields, name: str) -> tuple[str, ...]:
    """A list of texts. Raises ValueError for anything else."""
    value: Any = fields[name]
    if type(value) is not list:
        raise ValueError(f"{name!r} is {value!r}, expected a list of texts")
    return tuple(readable(item, f"{name!r}") for item in cast(list[Any], value))


def flag(fields: Fields, name: str) -> bool:
    """True or false. Raises ValueError for anything else."""
    if type(value := fields[name]) is not bool:
        raise ValueError(f"{name!r} must be true or false, got {value!r}")
    return value


def integer(fields: Fields, name: str, low: int = 0, high: int = int(LIMIT)) -> int:
    """A whole number from `low` to `high`. Raises ValueError for anything else."""
    if type(value := fields[name]) is not int or not low <= value <= high:
        raise ValueError(f"{name!r} is {_short(value)}, expected a whole number from {low} to {high}")
    return value


def number(fields: Fields, name: str, low: float = -LIMIT, high: float = LIMIT) -> float:
    """A number from `low` to `high`. Raises ValueError for anything else."""
    value = fields[name]
    # bool is an int to Python but no number in a file.
    if type(value) not in (float, int) or not low <= value <= high:
        raise ValueError(f"{name!r} is {_short(value)}, expected a number from {low:g} to {high:g}")
    return float(value)


def numbers(value: Any, shape: tuple[int, ...], what: str) -> NDArray[np.float64]:
    """An array of numbers within :data:`LIMIT`. Raises ValueError for anything else, or another shape."""
    try:
        array = np.array(value)
    except ValueError:  # ragged
        array = np.array(None)
    if array.shape != shape or array.dtype.kind not in "if" or not (np.abs(array) <= LIMIT).all():
        size = " x ".join(map(str, shape))
        raise ValueError(f"{what} must hold {size} numbers from {-LIMIT:g} to {LIMIT:g}")
    return array.astype(np.float64, copy=False)


def _short(value: Any) -> str:
    """A value as errors show it: cut. Python refuses to write out integers of thousands of digits."""
    if type(value) is int and value.bit_length() > 100:
        return f"about {'-' if value < 0 else ''}2**{value.bit_length()}"
    return shown if len(shown := repr(value)) <= 200 else f"{shown[:200]}..."
