"""What an observation may bring of an image besides its colours: numbers of objects, and depth.

The image ``observation.images.<camera>`` may have ``observation.masks.<camera>``, the number of the object
that each pixel shows and 0 for none, and ``observation.depth.<camera>``, metres along the optical axis and 0
where not measured. Both are ``(environments, 1, H, W)``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_openspm.errors import ObservationError

IMAGES, MASKS, DEPTH = "observation.images.", "observation.masks.", "observation.depth."
MAX_LABEL = np.iinfo(np.int32).max


def find_layers(batch: Mapping[str, Any], environments: int) -> dict[str, torch.Tensor]:
    """Masks and depths ``(environments, 1, H, W)`` of a batch by key.

    Raises:
        ObservationError: One is no tensor with four axes, or is of another number of environments.
    """
    found = {key: value for key, value in batch.items() if key.startswith((MASKS, DEPTH))}
    for key, value in found.items():
        shape = tuple(getattr(value, "shape", ()))
        if not isinstance(value, torch.Tensor) or len(shape) != 4 or shape[0] != environments:
            raise ObservationError(
                f"{key!r} is a {type(value).__name__} of shape {shape}, expected a tensor of "
                f"({environments}, 1, height, width); give one layer an environment"
            )
    return found


def labels_of(
    layers: Mapping[str, torch.Tensor], image_key: str, size: tuple[int, ...]
) -> NDArray[np.int32] | None:
    """Numbers of objects ``(H, W)`` of an image; None where the observation has none.

    Args:
        layers: ``(1, H, W)`` by key, of one environment.
        image_key: ``observation.images.<camera>``.
        size: Height and width of that image.

    Raises:
        ObservationError: Of another size than the image, or not whole numbers from 0 on.
    """
    key, array = _layer(layers, MASKS, image_key, size)
    if array is None:
        return None
    # Not by type: LeRobot makes floating point numbers of whatever an environment observes.
    if array.min() < 0 or array.max() > MAX_LABEL or (array != np.floor(array)).any():
        raise ObservationError(
            f"{key!r} holds values from {array.min():g} to {array.max():g} that are no numbers of objects, "
            "expected 0, 1, 2, ...; do not normalise or interpolate masks"
        )
    return array.astype(np.int32)


def depth_of(
    layers: Mapping[str, torch.Tensor], image_key: str, size: tuple[int, ...]
) -> NDArray[np.float32] | None:
    """Metres along the optical axis ``(H, W)`` of an image; None where the observation has none.

    Args:
        layers: ``(1, H, W)`` by key, of one environment.
        image_key: ``observation.images.<camera>``.
        size: Height and width of that image.

    Raises:
        ObservationError: Of another size than the image, not floating point, not finite, or negative.
    """
    key, array = _layer(layers, DEPTH, image_key, size)
    if array is None:
        return None
    if not np.issubdtype(array.dtype, np.floating) or array.min() < 0:
        raise ObservationError(
            f"{key!r} is of {array.dtype} and at least {array.min():g}, expected metres as floating point, 0 "
            "where not measured; divide millimetres by 1000"
        )
    return array.astype(np.float32)


def _layer(
    layers: Mapping[str, torch.Tensor], prefix: str, image_key: str, size: tuple[int, ...]
) -> tuple[str, NDArray[Any] | None]:
    key = prefix + image_key.removeprefix(IMAGES)
    if not image_key.startswith(IMAGES) or key not in layers:
        return key, None
    array = layers[key].detach().cpu().numpy()
    if array.shape != (1, *size):
        raise ObservationError(
            f"{key!r} has shape {array.shape}, expected {(1, *size)}, the size of {image_key!r}; give it at "
            "the image's size"
        )
    if not np.isfinite(array).all():
        raise ObservationError(
            f"{key!r} holds NaN or infinite values, expected finite ones; give 0 where nothing is known"
        )
    return key, array[0]
