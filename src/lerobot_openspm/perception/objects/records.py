"""Checks of what is read from the record of a known object."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError

# Points of an object, the fewest and how far from its frame, metres.
MIN_POINTS, LARGEST_M = 8, 3.0
# Name -> lowest and highest value that makes sense.
BOUNDS = {
    "spacing": (1e-6, 1.0),
    "height": (-100.0, 100.0),
    "yaw_period": (0.0, 2 * np.pi + 1e-9),
    "yaw_centre": (-7.0, 7.0),
    "yaw_halfwidth": (0.0, np.pi + 1e-9),
    "typical_overlap": (0.0, 1.0),
    "typical_correlation": (0.0, 1.0),
}


def numbers(fields: Mapping[str, Any], keys: tuple[str, ...], where: str) -> dict[str, float]:
    """Fields that are numbers within :data:`BOUNDS`. Raises MemoryFormatError."""
    return {key: number(fields, key, *BOUNDS[key], where) for key in keys}


def number(fields: Mapping[str, Any], key: str, low: float, high: float, where: str) -> float:
    """A field that is a number within bounds. Raises MemoryFormatError."""
    value = fields.get(key)
    # bool is an int to Python but no number in a file.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise MemoryFormatError(f"{where}: {key!r} is {value!r}, expected a number from {low:g} to {high:g}")
    return float(value)


def points(arrays: Mapping[str, NDArray[Any]], where: str, most: int) -> NDArray[Any]:
    """The points ``(n, 3)`` of an object in its frame, metres. Raises MemoryFormatError."""
    found = array(arrays, "points", (-1, 3), where)
    if not MIN_POINTS <= len(found) <= most:
        raise MemoryFormatError(f"{where}: 'points' has {len(found)} rows, expected {MIN_POINTS} to {most}")
    if (farthest := float(np.abs(found).max())) > LARGEST_M:
        raise MemoryFormatError(
            f"{where}: 'points' lie {farthest:g} m from the object's frame, expected {LARGEST_M:g} at most"
        )
    return found


def array(
    arrays: Mapping[str, NDArray[Any]],
    key: str,
    shape: tuple[int, ...],
    where: str,
    dtype: type[np.generic] = np.float32,
) -> NDArray[Any]:
    """An array of a type and a shape, -1 for any length, all finite. Raises MemoryFormatError."""
    found = arrays.get(key)
    if found is None:
        raise MemoryFormatError(f"{where}: array {key!r} is missing; learn the objects again")
    fits = found.ndim == len(shape) and all(
        want in (-1, got) for want, got in zip(shape, found.shape, strict=True)
    )
    if found.dtype != dtype or not fits:
        raise MemoryFormatError(
            f"{where}: array {key!r} is {found.dtype} of {found.shape}, expected {np.dtype(dtype)} of "
            f"{shape} (-1: any)"
        )
    if not np.isfinite(found).all():
        raise MemoryFormatError(f"{where}: array {key!r} holds values that are not finite")
    return found
