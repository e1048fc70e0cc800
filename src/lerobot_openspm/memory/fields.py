"""Fields of a JSON object, read with their types. An error names the field, and what it holds."""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

# What reading a field of another kind, or a number beyond what Python converts, ends in.
MALFORMED = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)

Fields = Mapping[str, Any]

MAX = sys.float_info.max


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


def text(fields: Fields, name: str) -> str:
    """A text. Raises ValueError for anything else."""
    if type(value := fields[name]) is not str:
        raise ValueError(f"{name!r} is {value!r}, expected text")
    return value


def texts(fields: Fields, name: str) -> tuple[str, ...]:
    """A list of texts. Raises ValueError for anything else."""
    value: Any = fields[name]
    if type(value) is not list or any(type(item) is not str for item in value):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        raise ValueError(f"{name!r} is {value!r}, expected a list of texts")
    return tuple(value)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]


def flag(fields: Fields, name: str) -> bool:
    """True or false. Raises ValueError for anything else."""
    if type(value := fields[name]) is not bool:
        raise ValueError(f"{name!r} must be true or false, got {value!r}")
    return value


def integer(fields: Fields, name: str, low: int = 0) -> int:
    """A whole number of at least `low`. Raises ValueError for anything else."""
    if type(value := fields[name]) is not int or value < low:
        raise ValueError(f"{name!r} is {value!r}, expected a whole number of at least {low}")
    return value


def number(fields: Fields, name: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number from `low` to `high`. Raises ValueError for anything else."""
    value = fields[name]
    # bool is an int to Python but no number in a file.
    # An int may be beyond floats, which math.isfinite cannot be asked about.
    if type(value) not in (float, int) or not (abs(value) <= MAX and low <= value <= high):
        within = "" if math.isinf(low) else f" from {low:g} to {high:g}"
        raise ValueError(f"{name!r} is {value!r}, expected a number{within}")
    return float(value)


def numbers(value: Any, shape: tuple[int, ...], what: str) -> NDArray[np.float64]:
    """An array of finite numbers. Raises ValueError for anything else, and for another shape."""
    try:
        array = np.array(value)
    except ValueError:  # ragged
        array = np.array(None)
    if array.shape != shape or array.dtype.kind not in "if" or not np.isfinite(array).all():
        raise ValueError(f"{what} must hold {' x '.join(map(str, shape))} finite numbers")
    return array.astype(np.float64, copy=False)
