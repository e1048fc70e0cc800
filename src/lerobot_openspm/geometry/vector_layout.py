"""Which number of a state or action vector means what, by name and never by index.

A layout is a list of names, one per dimension, taken from the dataset's feature names or from the
configuration. Aliases that robots use for the same thing are folded into one vocabulary:

    position  x y z                 (actions: delta_x ...)
    rotation  axis_angle_x/y/z | quat_x/y/z/w | roll pitch yaw (extrinsic xyz), or none at all
    gripper   any number of names that hold "finger" or "gripper"
"""

from __future__ import annotations

# SciPy has no stubs.
# pyright: reportMissingTypeStubs=false
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lerobot_openspm.errors import LayoutError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

RotationKind = Literal["none", "axis_angle", "quat", "euler"]

_POSITION = ("x", "y", "z")
_ROTATIONS: dict[RotationKind, tuple[str, ...]] = {
    "axis_angle": ("axis_angle_x", "axis_angle_y", "axis_angle_z"),
    "quat": ("quat_x", "quat_y", "quat_z", "quat_w"),
    "euler": ("roll", "pitch", "yaw"),
}
_ALIASES = {
    **{f"{p}{a}": a for p in ("pos_", "p", "d", "ee_", "eef_", "ee_pos_", "eef_pos_") for a in _POSITION},
    **{f"{p}{a}": f"axis_angle_{a}" for p in ("r", "dr", "rot_", "rotvec_", "axisangle_") for a in _POSITION},
    **{f"q{a}": f"quat_{a}" for a in "xyzw"},
}


@dataclass(frozen=True)
class VectorLayout:
    """Where position, rotation and gripper stand in a vector of `size` numbers.

    Attributes:
        names: The names the layout was read from, one per dimension.
        position: Indices of x, y, z.
        rotation: Indices of the rotation's numbers, empty when there is none.
        rotation_kind: How the rotation is written.
        gripper: Indices of the finger positions or of the gripper command.
    """

    names: tuple[str, ...]
    position: tuple[int, ...]
    rotation: tuple[int, ...]
    rotation_kind: RotationKind
    gripper: tuple[int, ...]

    @property
    def size(self) -> int:
        """How many numbers a vector has."""
        return len(self.names)

    def poses(self, vectors: ArrayLike) -> Array:
        """Poses ``(..., 4, 4)`` of state vectors ``(..., size)``; not rotated where they hold no rotation."""
        vectors = self._checked(vectors)
        return se3.transform(self._matrices(vectors), vectors[..., list(self.position)])

    def openings(self, vectors: ArrayLike) -> Array:
        """Gripper opening ``(...)``: the sum of the fingers' distances from closed, in the state's units."""
        vectors = self._checked(vectors)
        return np.abs(vectors[..., list(self.gripper)]).sum(axis=-1)

    def decode_actions(self, vectors: ArrayLike) -> Array:
        """Canonical actions ``(..., 7)``: position increment, rotation vector, gripper; units as they are."""
        vectors = self._checked(vectors)
        turn = se3.log_so3(self._matrices(vectors)) if self.rotation_kind != "axis_angle" else None
        rotvec = vectors[..., list(self.rotation)] if turn is None else turn
        gripper = vectors[..., list(self.gripper)].mean(axis=-1, keepdims=True)
        return np.concatenate([vectors[..., list(self.position)], rotvec, gripper], axis=-1)

    def encode_actions(self, actions: ArrayLike) -> Array:
        """Vectors ``(..., size)`` of canonical actions ``(..., 7)``; what has no place in them is dropped."""
        actions = np.asarray(actions, float)
        vectors = np.zeros((*actions.shape[:-1], self.size))
        vectors[..., list(self.position)] = actions[..., :3]
        vectors[..., list(self.gripper)] = actions[..., 6:]
        if self.rotation_kind != "none":
            vectors[..., list(self.rotation)] = self._numbers(actions[..., 3:6])
        return vectors

    def _checked(self, vectors: ArrayLike) -> Array:
        vectors = np.asarray(vectors, float)
        if vectors.shape[-1:] != (self.size,):
            raise LayoutError(
                f"got vectors of shape {vectors.shape}, expected a last axis of {self.size} laid out as "
                f"{list(self.names)}; set --policy.state_layout or --policy.action_layout to match the robot"
            )
        return vectors

    def _matrices(self, vectors: Array) -> Array:
        numbers = vectors[..., list(self.rotation)]
        if self.rotation_kind == "none":
            return np.broadcast_to(np.eye(3), (*vectors.shape[:-1], 3, 3))
        if self.rotation_kind == "axis_angle":
            return se3.exp_so3(numbers)
        flat = numbers.reshape(-1, numbers.shape[-1])
        rotation = (
            Rotation.from_quat(flat) if self.rotation_kind == "quat" else Rotation.from_euler("xyz", flat)
        )
        return rotation.as_matrix().reshape(*vectors.shape[:-1], 3, 3)

    def _numbers(self, rotvec: Array) -> Array:
        if self.rotation_kind == "axis_angle":
            return rotvec
        rotation = Rotation.from_rotvec(rotvec.reshape(-1, 3))
        numbers = rotation.as_quat() if self.rotation_kind == "quat" else rotation.as_euler("xyz")
        return numbers.reshape(*rotvec.shape[:-1], -1)


def parse_layout(names: Sequence[str], what: str, rotation_kind: RotationKind | None = None) -> VectorLayout:
    """Read a layout from names.

    Args:
        names: One name per dimension.
        what: "state" or "action", for errors.
        rotation_kind: Overrides what the names say about the rotation (the public LIBERO dataset calls its
            axis-angle numbers roll, pitch and yaw). ``"none"`` ignores a rotation.

    Raises:
        LayoutError: x, y or z is missing, a rotation is incomplete, or there is no gripper.
    """
    folded = [_fold(name) for name in names]
    hint = f"set --policy.{what}_layout to one name per dimension, e.g. [x, y, z, axis_angle_x, ..., gripper]"
    if missing := [axis for axis in _POSITION if axis not in folded]:
        raise LayoutError(f"{what} names {list(names)} lack {missing}; {hint}")
    found: list[RotationKind] = [
        kind for kind, parts in _ROTATIONS.items() if all(part in folded for part in parts)
    ]
    if len(found) > 1:
        raise LayoutError(f"{what} names {list(names)} hold several rotations: {found}; {hint}")
    partial = any(part in folded for parts in _ROTATIONS.values() for part in parts)
    if partial and not found:
        raise LayoutError(f"{what} names {list(names)} hold an incomplete rotation; {hint}")
    gripper = tuple(i for i, name in enumerate(folded) if name == "gripper")
    if not gripper:
        raise LayoutError(f"{what} names {list(names)} hold no gripper or finger; {hint}")
    named: RotationKind = found[0] if found else "none"
    rotation = tuple(folded.index(part) for part in _ROTATIONS[named]) if found else ()
    kind = rotation_kind or named
    if kind != "none" and len(rotation) != len(_ROTATIONS[kind]):
        raise LayoutError(
            f"{what} names {list(names)} hold {len(rotation)} rotation numbers, "
            f"but rotation {kind!r} has {len(_ROTATIONS[kind])}; {hint}"
        )
    position = tuple(folded.index(axis) for axis in _POSITION)
    return VectorLayout(tuple(names), position, rotation if kind != "none" else (), kind, gripper)


def _fold(name: str) -> str:
    name = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    name = re.sub(r"^(delta|d|action|state)_", "", name)
    if "finger" in name or "gripper" in name:
        return "gripper"
    return _ALIASES.get(name, name)
