"""Object models as JSON-able numbers and NumPy arrays, and back, with everything that was read checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.perception.colour import N_BINS
from lerobot_openspm.perception.model import ObjectModel

VERSION = 1
MAX_POINTS = 200_000
# Name -> lowest and highest value that makes sense.
NUMBERS = {
    "spacing": (1e-6, 1.0),
    "height": (-100.0, 100.0),
    "yaw_period": (0.0, 2 * np.pi + 1e-9),
    "yaw_centre": (-7.0, 7.0),
    "yaw_halfwidth": (0.0, np.pi + 1e-9),
    "typical_overlap": (0.0, 1.0),
}


def to_parts(model: ObjectModel) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Split a model into what belongs in JSON and what belongs in a safetensors file."""
    numbers = {name: float(getattr(model, name)) for name in NUMBERS}
    arrays = {"log_odds": model.log_odds.astype(np.float32), "points": model.points.astype(np.float32)}
    return {"version": VERSION, "name": model.name, **numbers}, arrays


def from_parts(data: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], where: str) -> ObjectModel:
    """Put a model together again; ``where`` names its origin in errors.

    Raises:
        MemoryFormatError: A field or array is missing, of a wrong type or shape, not finite, or out of range.
    """
    version = data.get("version")
    if version != VERSION:
        raise MemoryFormatError(
            f"{where}: object model of version {version!r}, expected {VERSION}; learn the objects again"
        )
    name = data.get("name")
    if not isinstance(name, str) or not name:
        raise MemoryFormatError(f"{where}: 'name' is {name!r}, expected a noun phrase")
    numbers = {key: _number(data, key, where) for key in NUMBERS}
    log_odds = _array(arrays, "log_odds", (N_BINS,), where)
    points = _array(arrays, "points", (-1, 3), where)
    if not 8 <= len(points) <= MAX_POINTS:
        raise MemoryFormatError(f"{where}: 'points' has {len(points)} rows, expected 8 to {MAX_POINTS}")
    return ObjectModel(name=name, log_odds=log_odds, points=points, **numbers)


def _number(data: Mapping[str, Any], key: str, where: str) -> float:
    value, (low, high) = data.get(key), NUMBERS[key]
    # bool is an int to Python but no number in a file.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise MemoryFormatError(f"{where}: {key!r} is {value!r}, expected a number from {low:g} to {high:g}")
    return float(value)


def _array(
    arrays: Mapping[str, NDArray[Any]], key: str, shape: tuple[int, ...], where: str
) -> NDArray[np.float32]:
    array = arrays.get(key)
    if array is None:
        raise MemoryFormatError(f"{where}: array {key!r} is missing; learn the objects again")
    array = np.asarray(array)
    fits = array.ndim == len(shape) and all(
        want in (-1, got) for want, got in zip(shape, array.shape, strict=True)
    )
    if array.dtype != np.float32 or not fits:
        raise MemoryFormatError(
            f"{where}: array {key!r} is {array.dtype} of {array.shape}, expected float32 of {shape} (-1: any)"
        )
    if not np.isfinite(array).all():
        raise MemoryFormatError(f"{where}: array {key!r} holds values that are not finite")
    return array
