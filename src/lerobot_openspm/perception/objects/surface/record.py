"""Reading a surface model back from what was written down of it, every number checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.perception.objects import records
from lerobot_openspm.perception.objects.patches import model as patches
from lerobot_openspm.perception.objects.patches.model import PatchModel
from lerobot_openspm.perception.objects.surface.backdrop import TABLE_MARGIN_M, Backdrop, Colour
from lerobot_openspm.perception.objects.surface.model import UNCOLOURED, SurfaceModel
from lerobot_openspm.perception.objects.surface.shown import MAX_SHOWN
from lerobot_openspm.perception.objects.surface.sight import Surface

# What a record may hold: points, coloured ones at least, and the table's length and width in metres, rounded.
MAX_POINTS, MIN_COLOURED, MAX_TABLE_M, ROUNDING_M = 60_000, 8, 10.0, 1e-3
# The frame of what stands on the table is this far above or below it at most, metres.
MAX_ABOVE_M = 3.0
BOUNDS = {
    "height": (-100.0, 100.0),
    "typical_agreement": (0.05, 1.0),
    "rival_agreement": (0.0, 1.0),
    "spacing": (1e-6, 1.0),
    "pattern": (0.0, 1.0),
    "table_height": (-100.0, 100.0),
}


def from_record(fields: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], where: str) -> SurfaceModel:
    """Inverse of :meth:`SurfaceModel.to_record`. Raises MemoryFormatError, which names ``where``."""
    name, near, cameras = fields["name"], fields.get("near", ""), fields.get("hand_cameras")
    if near is not None and (not isinstance(near, Mapping) or near.get("kind") != PatchModel.kind):
        raise MemoryFormatError(
            f"{where}: 'near' of {name!r} must be an object of kind {PatchModel.kind}, or null"
        )
    if not isinstance(cameras, list) or not all(isinstance(one, str) for one in cameras):
        raise MemoryFormatError(f"{where}: 'hand_cameras' of {name!r} must be a list of camera keys")
    points = records.points(arrays, where, MAX_POINTS)
    normals = records.array(arrays, "normals", (len(points), 3), where)
    colours = records.array(arrays, "colours", (len(points), 2, 3), where).copy()
    colours[(colours <= UNCOLOURED).any((1, 2))] = np.nan
    if (coloured := int(np.isfinite(colours[:, 0, 0]).sum())) < MIN_COLOURED:
        raise MemoryFormatError(
            f"{where}: {coloured} points of {name!r} have colours, expected {MIN_COLOURED} or more; "
            "learn the objects again"
        )
    table = records.array(arrays, "table_colour", (4, 3), where).astype(float)
    area = records.array(arrays, "table_area", (2, 2), where).astype(float)
    sides = area[1] - area[0]
    if sides.min() < 2 * TABLE_MARGIN_M - ROUNDING_M or sides.max() > MAX_TABLE_M:
        raise MemoryFormatError(
            f"{where}: 'table_area' is {area.tolist()}, expected least and largest x and y, "
            f"{2 * TABLE_MARGIN_M} to {MAX_TABLE_M} m apart"
        )
    hand = {
        camera: records.array(arrays, f"hand.{i}", (-1, -1), where, np.uint8).astype(bool)
        for i, camera in enumerate(cameras)
    }
    if any(mask.size == 0 for mask in hand.values()):
        raise MemoryFormatError(f"{where}: a picture of the hand has no pixels; learn the objects again")
    numbers = {key: records.number(fields, key, *BOUNDS[key], where) for key in BOUNDS}
    if abs(numbers["height"] - numbers["table_height"]) > MAX_ABOVE_M:
        raise MemoryFormatError(
            f"{where}: 'height' is {numbers['height']:g} and 'table_height' {numbers['table_height']:g}, "
            f"expected {MAX_ABOVE_M:g} m between them at most"
        )
    backdrop = Backdrop(Colour(table[0], table[1:]), numbers["table_height"], area, {}, hand)
    own = {key.removeprefix("near."): value for key, value in arrays.items() if key.startswith("near.")}
    return SurfaceModel(
        name, Surface(points, normals, colours, numbers["spacing"], numbers["pattern"]), backdrop,
        numbers["height"],
        numbers["typical_agreement"], numbers["rival_agreement"],
        None if near is None else patches.from_record(near, own, where),
        _shown(name, arrays, where, 1 if near is None else 0),
    )  # fmt: skip


def _shown(name: str, arrays: Mapping[str, NDArray[Any]], where: str, least: int) -> NDArray[np.float64]:
    """Where an object was shown (x, y, z), and how well first pictures agreed there ``(k, 4)``."""
    shown = records.array(arrays, "shown", (-1, 4), where, np.float64)
    if not least <= len(shown) <= MAX_SHOWN or (shown[:, 3] < 0).any() or (shown[:, 3] > 1).any():
        raise MemoryFormatError(
            f"{where}: {name!r} was shown at {len(shown)} places, expected {least} to {MAX_SHOWN}, each with "
            "an agreement of 0 to 1; learn the objects again"
        )
    return shown
