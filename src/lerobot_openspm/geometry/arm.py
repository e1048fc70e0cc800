"""An arm's kinematics: where its joints put the hand, and which joints put the hand there.

An arm is read from a URDF. Its root link is the world's frame, its link ``ee`` the hand's frame: a file of
the manufacturer's gets a fixed joint before it for where the arm stands, and one behind it for the tool.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy import optimize  # pyright: ignore[reportMissingTypeStubs]

from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

MAX_FILE_BYTES, MAX_JOINTS = 2**22, 32
EE_LINK = "ee"
# Errors that count as much as one another when joints are sought, and as joints this far from where they
# rest, which decides only where several positions put the hand there.
SCALE_M, SCALE_RAD, SCALE_REST_RAD = 0.001, 0.01, 10.0
# Steps of the search for joints.
MAX_EVALUATIONS = 60


@dataclass(frozen=True)
class Joint:
    """A revolute joint.

    Attributes:
        T_before_joint: Pose ``(4, 4)`` at angle 0 in the frame of the joint before, or in the world.
        axis: Unit vector ``(3,)`` in the joint's frame.
        limits: Least and largest angle ``(2,)``, radians.
    """

    T_before_joint: Array
    axis: Array
    limits: Array

    def turned(self, angle: float) -> Array:
        """The joint's frame ``(4, 4)`` at an angle, in that at angle 0: Rodrigues' formula."""
        turn = np.eye(3) + np.sin(angle) * self._cross + (1 - np.cos(angle)) * self._cross @ self._cross
        return se3.transform(turn, np.zeros(3))

    @cached_property
    def _cross(self) -> Array:
        """The matrix ``(3, 3)`` of the cross product with the axis."""
        x, y, z = self.axis
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True)
class Arm:
    """A chain of revolute joints.

    Attributes:
        joints: From the base to the hand.
        T_last_ee: The hand ``(4, 4)`` in the last joint's frame.
    """

    joints: tuple[Joint, ...]
    T_last_ee: Array

    @property
    def middle(self) -> Array:
        """The middle ``(n,)`` of every joint's range, radians."""
        return self._limits.mean(1)

    @property
    def _limits(self) -> Array:
        return np.stack([joint.limits for joint in self.joints])

    def ee_pose(self, angles: Array) -> Array:
        """``T_world_ee`` ``(4, 4)`` at joint angles ``(n,)``, radians."""
        return self._frames(angles)[-1]

    def _frames(self, angles: Array) -> list[Array]:
        """World poses of every joint at its angle, and of the hand."""
        frames = [np.eye(4)]
        for joint, angle in zip(self.joints, angles, strict=True):
            frames.append(frames[-1] @ joint.T_before_joint @ joint.turned(angle))
        return [*frames[1:], frames[-1] @ self.T_last_ee]

    def angles_for(self, T_world_ee: Array, start: Array, rest: Array) -> Array:
        """Joint angles ``(n,)`` within the limits that bring the hand as near to a pose as they can.

        Args:
            T_world_ee: Where the hand is to be ``(4, 4)``.
            start: Angles ``(n,)`` to begin from.
            rest: Angles ``(n,)`` that a redundant arm keeps near to.
        """
        low, high = self._limits.T
        weights = np.repeat([1 / SCALE_M, 1 / SCALE_RAD], 3)

        def errors(angles: Array) -> Array:
            T = self.ee_pose(angles)
            turn = se3.log_so3(T[:3, :3] @ T_world_ee[:3, :3].T)
            off = np.concatenate([T[:3, 3] - T_world_ee[:3, 3], turn])
            return np.concatenate([weights * off, (angles - rest) / SCALE_REST_RAD])

        def slopes(angles: Array) -> Array:
            *frames, hand = self._frames(angles)
            axes = np.stack([T[:3, :3] @ joint.axis for T, joint in zip(frames, self.joints, strict=True)])
            arms = hand[:3, 3] - np.stack([T[:3, 3] for T in frames])
            moves = np.concatenate([np.cross(axes, arms), axes], 1).T
            kept = np.eye(len(angles)) / SCALE_REST_RAD
            return np.asarray(np.concatenate([weights[:, None] * moves, kept]), float)

        begin = np.clip(start, low, high)
        solve = cast(Any, optimize).least_squares  # it has no stubs
        found = solve(errors, begin, slopes, bounds=(low, high), max_nfev=MAX_EVALUATIONS)
        return np.asarray(found.x, float)

    def misses(self, poses: Iterable[Array], T_world_ee: Array) -> Iterator[tuple[float, float]]:
        """How far, metres and radians, the arm stays from each of some hand poses that it goes to in turn.

        Args:
            poses: Where the hand is to be, ``(4, 4)`` each.
            T_world_ee: Where the hand is ``(4, 4)``; how the arm stands there is how it rests.
        """
        rest = angles = self.angles_for(T_world_ee, self.middle, self.middle)
        for pose in poses:
            angles = self.angles_for(pose, angles, rest)
            metres, radians = se3.distances(self.ee_pose(angles), pose)
            yield float(metres), float(radians)


def load_arm(path: Path) -> Arm:
    """Read an arm from a URDF. Raises CalibrationError naming the file and what is wrong."""
    if not path.is_file():
        raise CalibrationError(f"no URDF at {path}; pass --policy.arm=FILE (see configs/arms)")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise CalibrationError(f"{path}: larger than {MAX_FILE_BYTES} bytes, not an arm's URDF")
    try:
        robot = ElementTree.fromstring(path.read_bytes())
        joints = {_link(joint, "child"): joint for joint in robot.findall("joint")}
        return _chain(joints, str(path))
    except (ElementTree.ParseError, ValueError, KeyError) as error:
        raise CalibrationError(f"{path}: not a URDF that can be read: {error}") from error


def _chain(joints: dict[str, ElementTree.Element], where: str) -> Arm:
    """The revolute joints from the root to the hand; fixed ones are part of the one after them."""
    if EE_LINK not in joints:
        raise CalibrationError(
            f"{where}: no joint leads to a link {EE_LINK!r}, the frame of the hand; links are "
            f"{', '.join(sorted(joints)) or 'missing'}; add a fixed joint from the last one to {EE_LINK!r}"
        )
    way: list[ElementTree.Element] = []
    link = EE_LINK
    while link in joints:
        way.insert(0, joints[link])
        link = _link(joints[link], "parent")
        if len(way) > 2 * MAX_JOINTS:
            raise CalibrationError(
                f"{where}: the joints to {EE_LINK!r} go round in a circle, or are too many"
            )
    found, T_before = list[Joint](), np.eye(4)
    for joint in way:
        T_before = T_before @ _origin(joint)
        kind = joint.get("type")
        if kind == "fixed":
            continue
        if kind != "revolute":
            raise CalibrationError(
                f"{where}: joint {joint.get('name')!r} is of type {kind!r}, expected revolute or fixed"
            )
        axis, limits = _numbers(joint, "axis", "xyz", "1 0 0"), joint.find("limit")
        if limits is None or not (length := float(np.linalg.norm(axis))):
            raise CalibrationError(f"{where}: joint {joint.get('name')!r} has no limits, or no axis")
        bounds = np.array([float(limits.get("lower", "0")), float(limits.get("upper", "0"))])
        if not (np.isfinite(bounds).all() and bounds[0] < bounds[1] and np.ptp(bounds) <= 4 * math.pi):
            raise CalibrationError(
                f"{where}: limits of joint {joint.get('name')!r} are {bounds.tolist()}, expected the lower, "
                "then the upper one in radians, up to two turns apart"
            )
        found.append(Joint(T_before, axis / length, bounds))
        T_before = np.eye(4)
    if not 1 <= len(found) <= MAX_JOINTS:
        raise CalibrationError(
            f"{where}: {len(found)} joints lead to {EE_LINK!r}, expected 1 to {MAX_JOINTS}"
        )
    return Arm(tuple(found), T_before)


def _link(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    if element is None:
        raise ValueError(f"joint {joint.get('name')!r} has no {end}")
    return element.attrib["link"]


def _origin(joint: ElementTree.Element) -> Array:
    """A joint's frame ``(4, 4)`` in its parent link's."""
    roll, pitch, yaw = (se3.exp_so3(turn) for turn in np.diag(_numbers(joint, "origin", "rpy", "0 0 0")))
    return se3.transform(yaw @ pitch @ roll, _numbers(joint, "origin", "xyz", "0 0 0"))


def _numbers(joint: ElementTree.Element, tag: str, key: str, default: str) -> Array:
    element = joint.find(tag)
    text = default if element is None else element.get(key, default)
    numbers = np.array([float(word) for word in text.split()])
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise ValueError(f"{key} of joint {joint.get('name')!r} is {text!r}, expected three numbers")
    return numbers
