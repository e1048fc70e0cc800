"""Known objects as JSON-able fields and NumPy arrays, and back, with everything that was read checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.perception.colour import N_BINS
from lerobot_openspm.perception.objects.model import (
    BoxModel,
    KnownObject,
    ObjectModel,
    Patch,
    PatchModel,
    Probe,
)

VERSION = 1
MAX_POINTS = 200_000
MAX_PROBES, MAX_PIXELS = 64, 10_000
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
# Name -> lowest and highest value that makes sense.
NUMBERS = {
    "spacing": (1e-6, 1.0),
    "height": (-100.0, 100.0),
    "yaw_period": (0.0, 2 * np.pi + 1e-9),
    "yaw_centre": (-7.0, 7.0),
    "yaw_halfwidth": (0.0, np.pi + 1e-9),
    "typical_overlap": (0.0, 1.0),
}
BOX_NUMBERS = ("height", "yaw_period", "yaw_centre", "typical_overlap")
BOX_SIZES = (1e-4, 10.0)
# Where the pixels of an object known by its shape come from.
COLOURS, SEGMENTER = "colours", "segmenter"


def to_parts(model: KnownObject) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Split a model into what belongs in JSON and what belongs in a safetensors file."""
    if isinstance(model, PatchModel):
        return _patches_to_parts(model)
    if isinstance(model, BoxModel):
        own = {name: float(getattr(model, name)) for name in BOX_NUMBERS}
        size = [float(side) for side in model.size]
        return {"version": VERSION, "kind": "box", "name": model.name, "size": size, **own}, {}
    numbers = {name: float(getattr(model, name)) for name in NUMBERS}
    arrays = {"points": model.points.astype(np.float32)}
    if model.log_odds is not None:
        arrays = {"log_odds": model.log_odds.astype(np.float32), **arrays}
    foreground = SEGMENTER if model.log_odds is None else COLOURS
    fields = {"version": VERSION, "kind": "shape", "foreground": foreground, "name": model.name, **numbers}
    return fields, arrays


def from_parts(data: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], where: str) -> KnownObject:
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
    kind = data.get("kind", "shape")
    if kind == "patches":
        return _patches_from_parts(name, data, arrays, where)
    if kind == "box":
        return _box_from_parts(name, data, where)
    if kind != "shape":
        raise MemoryFormatError(
            f"{where}: object {name!r} is of kind {kind!r}, expected shape, patches or box; learn it again"
        )
    # Until version 3 all memories held colours, and did not say so.
    foreground = data.get("foreground", COLOURS)
    if foreground not in (COLOURS, SEGMENTER):
        raise MemoryFormatError(
            f"{where}: 'foreground' of {name!r} is {foreground!r}, expected {COLOURS} or {SEGMENTER}"
        )
    numbers = {key: _number(data, key, *NUMBERS[key], where) for key in NUMBERS}
    log_odds = _array(arrays, "log_odds", (N_BINS,), where) if foreground == COLOURS else None
    points = _array(arrays, "points", (-1, 3), where)
    if not 8 <= len(points) <= MAX_POINTS:
        raise MemoryFormatError(f"{where}: 'points' has {len(points)} rows, expected 8 to {MAX_POINTS}")
    return ObjectModel(name=name, log_odds=log_odds, points=points, **numbers)


def _box_from_parts(name: str, data: Mapping[str, Any], where: str) -> BoxModel:
    numbers = {key: _number(data, key, *NUMBERS[key], where) for key in BOX_NUMBERS}
    sides = data.get("size")
    if not isinstance(sides, list) or len(sides) != 3:
        raise MemoryFormatError(f"{where}: 'size' of {name!r} is {sides!r}, expected a list of 3 lengths")
    size = [_number({"size": side}, "size", *BOX_SIZES, where) for side in sides]
    if size[0] < size[1] or (numbers["yaw_period"] == 0 and size[0] != size[1]):
        raise MemoryFormatError(
            f"{where}: 'size' of {name!r} is {sides}, expected the long side first, and both alike for a yaw "
            "period of 0; learn it again"
        )
    return BoxModel(name=name, size=np.array(size), **numbers)


def _patches_to_parts(model: PatchModel) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    probes, arrays = [], {}
    for i, probe in enumerate(model.probes):
        probes.append({"camera": probe.camera, "std_m": probe.std_m})
        arrays[f"{i}.calibration"] = np.array(
            [getattr(probe.calibration, name) for name in INTRINSICS], float
        )
        arrays[f"{i}.T_world_cam"] = probe.T_world_cam.astype(float)
        arrays[f"{i}.corners"] = np.stack([patch.corner for patch in probe.patches]).astype(float)
        arrays[f"{i}.points"] = np.stack([patch.point_world for patch in probe.patches]).astype(float)
        for j, patch in enumerate(probe.patches):
            arrays[f"{i}.patch.{j}"] = patch.image
    fields = {"height": model.height, "typical_correlation": model.typical_correlation, "probes": probes}
    return {"version": VERSION, "kind": "patches", "name": model.name, **fields}, arrays


def _patches_from_parts(
    name: str, data: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], where: str
) -> PatchModel:
    rows = data.get("probes")
    if not isinstance(rows, list) or not 1 <= len(rows) <= MAX_PROBES:
        raise MemoryFormatError(f"{where}: 'probes' of {name!r} must be a list of 1 to {MAX_PROBES} objects")
    probes = tuple(_probe(row, i, arrays, where) for i, row in enumerate(rows))
    height = _number(data, "height", *NUMBERS["height"], where)
    return PatchModel(name, probes, height, _number(data, "typical_correlation", 0.0, 1.0, where))


def _probe(row: Any, index: int, arrays: Mapping[str, NDArray[Any]], where: str) -> Probe:
    if not isinstance(row, Mapping) or not isinstance(row.get("camera"), str):
        raise MemoryFormatError(f"{where}: probe {index} has no 'camera'; learn the objects again")
    intrinsics = _array(arrays, f"{index}.calibration", (len(INTRINSICS),), where, np.float64)
    width, height, fx, fy, cx, cy = (float(number) for number in intrinsics)
    T_world_cam = _array(arrays, f"{index}.T_world_cam", (4, 4), where, np.float64)
    if not (1 <= width <= MAX_PIXELS and 1 <= height <= MAX_PIXELS and fx != 0 and fy > 0):
        raise MemoryFormatError(f"{where}: the camera of probe {index} has impossible intrinsics")
    if not se3.is_rigid(T_world_cam):
        raise MemoryFormatError(f"{where}: the camera of probe {index} has no rigid pose")
    camera = Camera(int(width), int(height), fx, fy, cx, cy, "world", T_world_cam)
    corners = _array(arrays, f"{index}.corners", (-1, 2), where, np.float64)
    points = _array(arrays, f"{index}.points", (len(corners), 3), where, np.float64)
    if len(corners) == 0:
        raise MemoryFormatError(f"{where}: probe {index} has no patches; learn the objects again")
    patches = []
    for j, (corner, point) in enumerate(zip(corners, points, strict=True)):
        image = _array(arrays, f"{index}.patch.{j}", (-1, -1, 3), where, np.uint8)
        end = np.add(corner, [image.shape[1], image.shape[0]])
        if min(image.shape) < 1 or (corner < 0).any() or (end > [width, height]).any():
            raise MemoryFormatError(f"{where}: patch {j} of probe {index} does not lie in its image")
        patches.append(Patch(image, corner, point))
    return Probe(row["camera"], camera, T_world_cam, tuple(patches), _number(row, "std_m", 1e-9, 1.0, where))


def _number(data: Mapping[str, Any], key: str, low: float, high: float, where: str) -> float:
    value = data.get(key)
    # bool is an int to Python but no number in a file.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise MemoryFormatError(f"{where}: {key!r} is {value!r}, expected a number from {low:g} to {high:g}")
    return float(value)


def _array(
    arrays: Mapping[str, NDArray[Any]],
    key: str,
    shape: tuple[int, ...],
    where: str,
    dtype: type[np.generic] = np.float32,
) -> NDArray[Any]:
    array = arrays.get(key)
    if array is None:
        raise MemoryFormatError(f"{where}: array {key!r} is missing; learn the objects again")
    array = np.asarray(array)
    fits = array.ndim == len(shape) and all(
        want in (-1, got) for want, got in zip(shape, array.shape, strict=True)
    )
    if array.dtype != dtype or not fits:
        raise MemoryFormatError(
            f"{where}: array {key!r} is {array.dtype} of {array.shape}, expected {np.dtype(dtype)} of "
            f"{shape} (-1: any)"
        )
    if not np.isfinite(array).all():
        raise MemoryFormatError(f"{where}: array {key!r} holds values that are not finite")
    return array
