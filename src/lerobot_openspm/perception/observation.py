"""One environment's observation, taken out of LeRobot's batch and checked.

Besides its image ``observation.images.<camera>``, a camera may give ``observation.masks.<camera>``, the
number of the object that each pixel shows and 0 for none, and ``observation.depth.<camera>``, metres along
the optical axis and 0 where not measured. Both layers are ``(environments, 1, H, W)``.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from numpy.typing import NDArray

from lerobot_openspm.errors import ObservationError
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.geometry.vector_layout import VectorLayout
from lerobot_openspm.perception.oracle import decode_object_poses
from lerobot_openspm.types import Hand, View

# Named by the environment that gives them: position and quat_wxyz per object (oracle ablation only).
OBJECT_POSES = "observation.object_poses"
IMAGES, MASKS, DEPTH = "observation.images.", "observation.masks.", "observation.depth."
MAX_LABEL = np.iinfo(np.int32).max


@dataclass(frozen=True)
class Observation:
    """What the policy sees of one environment at one step.

    Attributes:
        instruction: The task string.
        state: State vector as it came.
        hand: Hand pose and opening, read from it.
        images: Images ``(3, H, W)`` by camera, still as tensors: few of them are ever looked at. A
            mapping that makes them when they are asked for will do.
        object_poses: Simulator poses ``(n * 7,)``, or None.
        layers: Masks and depths ``(1, H, W)`` of some cameras, by key.
    """

    instruction: str
    state: Array
    hand: Hand
    images: Mapping[str, torch.Tensor]
    object_poses: Array | None
    layers: Mapping[str, torch.Tensor] = field(default_factory=dict)

    def fingerprint(self) -> int:
        """A number that tells this observation from others, by its state and images."""
        parts = [
            self.state.tobytes(),
            *(self.images[key].cpu().numpy().tobytes() for key in sorted(self.images)),
        ]
        return zlib.crc32(b"".join(parts))

    def views(self, cameras: Mapping[str, Camera]) -> dict[str, View]:
        """Images of the calibrated cameras with the cameras' present poses, depths and labels.

        Raises:
            ObservationError: A calibrated camera is missing, or its image is no finite RGB picture, or its
                masks or depth do not fit it.
            CalibrationError: An image has another shape than the calibration.
        """
        return {key: self._view(key, camera) for key, camera in cameras.items()}

    def usable_views(self, cameras: Mapping[str, Camera]) -> tuple[dict[str, View], dict[str, str]]:
        """Views of the cameras that have one, and what is wrong with the others.

        Raises:
            CalibrationError: An image has another shape than the calibration.
        """
        views, absent = {}, {}
        for key, camera in cameras.items():
            try:
                views[key] = self._view(key, camera)
            except ObservationError as error:
                absent[key] = str(error)
        return views, absent

    def _view(self, key: str, camera: Camera) -> View:
        if key not in self.images:
            raise ObservationError(
                f"the observation has no camera {key!r} that the calibration names; it has "
                f"{sorted(self.images)}. Rename with --rename_map, or pass --policy.cameras=FILE"
            )
        image = _as_uint8(self.images[key], key)
        scaled = camera.scaled(image.shape[1], image.shape[0])
        size = image.shape[:2]
        depth, labels = depth_of(self.layers, key, size), labels_of(self.layers, key, size)
        return View(image, scaled, scaled.T_world_cam(self.hand.T_world_ee), depth, labels)

    def simulator_poses(self, names: Sequence[str]) -> dict[str, Array]:
        """Simulator poses ``T_world_obj`` by name (oracle ablation only)."""
        if self.object_poses is None:
            raise ObservationError(
                f"perception=oracle needs {OBJECT_POSES!r}, which this environment does not give; pass "
                "--env.object_poses=true on the tabletop, or use --policy.perception=demonstrations"
            )
        if self.object_poses.shape != (7 * len(names),):
            raise ObservationError(
                f"{OBJECT_POSES!r} has shape {self.object_poses.shape}, expected ({7 * len(names)},): "
                f"position and quat_wxyz of {', '.join(names)}, as in the demonstrations"
            )
        if not np.isfinite(self.object_poses).all():
            raise ObservationError(
                f"{OBJECT_POSES!r} is not finite: {self.object_poses}; check the simulation"
            )
        return decode_object_poses(self.object_poses, names)


def split_batch(batch: Mapping[str, Any], state_layout: VectorLayout) -> list[Observation]:
    """Take a batch apart into one observation per environment.

    Raises:
        ObservationError: There is no state or instruction, or the state is not finite.
        LayoutError: The state has another size than its layout.
    """
    if OBS_STATE not in batch:
        raise ObservationError(
            f"the observation has no {OBS_STATE!r}; it has {sorted(batch)}. Rename with --rename_map"
        )
    states = batch[OBS_STATE].detach().cpu().numpy().astype(float)
    if states.ndim != 2:
        raise ObservationError(
            f"{OBS_STATE!r} has shape {states.shape}, expected (environments, numbers); pass batches through "
            "the policy's preprocessor"
        )
    if not np.isfinite(states).all():
        raise ObservationError(
            f"{OBS_STATE!r} is not finite: {states}; stop the robot and check its driver or the simulation"
        )
    tasks = batch.get("task")
    if tasks is None:
        raise ObservationError(
            f"the observation has no 'task', the instruction; it has {sorted(batch)}. Add one string an "
            "environment under 'task'"
        )
    tasks = [tasks] * len(states) if isinstance(tasks, str) else list(tasks)
    if len(tasks) != len(states) or not all(isinstance(task, str) for task in tasks):
        raise ObservationError(
            f"'task' is {tasks!r}, expected an instruction for each of {len(states)} states"
        )
    T_world_ee, openings = state_layout.poses(states), state_layout.openings(states)
    images = {
        k: v for k, v in batch.items() if k.startswith("observation.image") and isinstance(v, torch.Tensor)
    }
    layers = find_layers(batch, len(states))
    poses = batch[OBJECT_POSES].detach().cpu().numpy().astype(float) if OBJECT_POSES in batch else None
    return [
        Observation(
            instruction=tasks[i],
            state=states[i],
            hand=Hand(T_world_ee[i], float(openings[i])),
            images={key: value[i] for key, value in images.items()},
            object_poses=None if poses is None else poses[i],
            layers={key: value[i] for key, value in layers.items()},
        )
        for i in range(len(states))
    ]


def _as_uint8(image: torch.Tensor, key: str) -> NDArray[np.uint8]:
    if image.ndim != 3 or image.shape[0] != 3:
        raise ObservationError(
            f"camera {key!r} gave shape {tuple(image.shape)}, expected (3, height, width); give RGB images"
        )
    array = image.detach().cpu().numpy().transpose(1, 2, 0)
    if array.dtype == np.uint8:
        return array
    if not np.isfinite(array).all():
        raise ObservationError(
            f"camera {key!r} gave an image with NaN or infinite values, expected 0 to 1; check the camera"
        )
    return np.round(np.clip(array, 0, 1) * 255).astype(np.uint8)


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
