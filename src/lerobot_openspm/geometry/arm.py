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

import numpy as np

from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

MAX_FILE_BYTES, MAX_JOINTS = 2**22, 32
EE_LINK = "ee"
# A pose that the joints miss by more than this is out of reach.
OUT_OF_REACH_M, OUT_OF_REACH_RAD = 0.005, 0.05
# Errors that count as much as one another when joints are sought, and as joints this far from where they
# rest, which decides only where several positions put the hand there.
SCALE_M, SCALE_RAD, SCALE_REST_RAD = 0.001, 0.01, 10.0
SCALES = np.repeat([SCALE_M, SCALE_RAD], 3)
# A squared error of that scale below which a pose is met: a hundredth of it.
MET = 1e-4
# The search ends after so many steps, or where so many did not bring the cost below such a share of it.
MAX_STEPS, SETTLE_STEPS, SETTLED = 40, 5, 0.8
# Damping as a share of the steepest joint's slope, and what it is multiplied by after a step for the better
# or the worse.
DAMPING, LESS_DAMPING, MORE_DAMPING = 0.01, 0.2, 4.0
# Where joints are not found from where the arm stands, they are sought from so many other places.
MORE_STARTS = 10


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
    def base(self) -> Array:
        """Where the arm stands ``(3,)``: its first joint, in the world, metres."""
        return self.joints[0].T_before_joint[:3, 3]

    def ee_pose(self, angles: Array) -> Array:
        """``T_world_ee`` ``(4, 4)`` at joint angles ``(n,)``, radians."""
        return self._frames(np.asarray(angles, float)[None])[1][0]

    def stance(self, T_world_ee: Array) -> Array:
        """Joint angles ``(n,)`` with which the hand is at a pose; others may do so too."""
        return self.angles_for(T_world_ee, self.middle, self.middle)

    def angles_for(self, T_world_ee: Array, start: Array, rest: Array) -> Array:
        """Joint angles ``(n,)`` within the limits that bring the hand as near to a pose as they can.

        They are sought from elsewhere too where they are not found from the start.

        Args:
            T_world_ee: Where the hand is to be ``(4, 4)``.
            start: Angles ``(n,)`` to begin from.
            rest: Angles ``(n,)`` that a redundant arm keeps near to.
        """
        found, is_met = self._sought(T_world_ee, np.stack([start, rest]), rest)
        return found if is_met else self._sought(T_world_ee, np.stack([found, *self._elsewhere]), rest)[0]

    def misses(
        self, poses: Iterable[Array], T_world_ee: Array, stance: Array | None = None
    ) -> Iterator[tuple[float, float]]:
        """How far, metres and radians, the arm stays from each of some hand poses that it goes to in turn.

        It goes on from how it stands, and is not bent the other way on its way.

        Args:
            poses: Where the hand is to be, ``(4, 4)`` each.
            T_world_ee: Where the hand is ``(4, 4)``; how the arm stands there is how it rests.
            stance: Its joint angles ``(n,)`` there, if they were sought before.
        """
        rest = angles = self.stance(T_world_ee) if stance is None else stance
        for pose in poses:
            angles = self.onwards(pose, angles, rest)
            yield self.miss(pose, angles)

    def onwards(self, T_world_ee: Array, start: Array, rest: Array) -> Array:
        """Joint angles ``(n,)`` as :meth:`angles_for`, sought from where the arm is and from rest alone."""
        return self._sought(T_world_ee, np.stack([start, rest]), rest)[0]

    def room(self, angles: Array) -> float:
        """How far the joint that is nearest to a limit is from it at joint angles ``(n,)``, radians."""
        low, high = self._limits.T
        return float(np.minimum(angles - low, high - angles).min())

    def miss(self, T_world_ee: Array, angles: Array) -> tuple[float, float]:
        """How far, metres and radians, the hand is from a pose ``(4, 4)`` at joint angles ``(n,)``."""
        metres, radians = se3.distances(self.ee_pose(angles), T_world_ee)
        return float(metres), float(radians)

    def _sought(self, T_world_ee: Array, starts: Array, rest: Array) -> tuple[Array, bool]:
        """The best joint angles ``(n,)`` found from any of some starts ``(s, n)``, and whether they do.

        Levenberg and Marquardt's method, for all starts at once. A joint at its limit that would be turned
        beyond it is held.
        """
        low, high = self._limits.T
        angles, damping = np.clip(starts, low, high), np.full(len(starts), DAMPING)
        off, slopes = self._errors(angles, T_world_ee)
        costs = before = _costs(off, angles - rest)
        for step in range(MAX_STEPS):
            if (off**2).sum(1).min() < MET:
                break
            if step and step % SETTLE_STEPS == 0:
                if (costs > SETTLED * before).all():
                    break
                before = costs
            uphill = (slopes @ off[..., None])[..., 0] + (angles - rest) / SCALE_REST_RAD**2
            free = ~((angles <= low) & (uphill > 0) | (angles >= high) & (uphill < 0))
            change = _downhill(slopes * free[..., None], uphill * free, damping)
            tried = np.clip(angles + change, low, high)
            tried_off, tried_slopes = self._errors(tried, T_world_ee)
            tried_costs = _costs(tried_off, tried - rest)
            is_better = tried_costs < costs
            damping = damping * np.where(is_better, LESS_DAMPING, MORE_DAMPING)
            angles = np.where(is_better[:, None], tried, angles)
            off = np.where(is_better[:, None], tried_off, off)
            slopes = np.where(is_better[:, None, None], tried_slopes, slopes)
            costs = np.where(is_better, tried_costs, costs)
        best = int(np.argmin(costs))
        return angles[best], bool((off[best] ** 2).sum() < MET)

    def _errors(self, angles: Array, T_world_ee: Array) -> tuple[Array, Array]:
        """How far the hand is off at angles ``(s, n)``, scaled ``(s, 6)``, and its slopes ``(s, n, 6)``."""
        frames, hands = self._frames(angles)
        off = np.concatenate(
            [hands[:, :3, 3] - T_world_ee[:3, 3], _rotation_vectors(hands[:, :3, :3] @ T_world_ee[:3, :3].T)],
            1,
        )
        axes = (frames[..., :3, :3] @ self._axes[..., None])[..., 0]
        arms = hands[:, None, :3, 3] - frames[..., :3, 3]
        moves = np.stack([
            axes[..., 1] * arms[..., 2] - axes[..., 2] * arms[..., 1],
            axes[..., 2] * arms[..., 0] - axes[..., 0] * arms[..., 2],
            axes[..., 0] * arms[..., 1] - axes[..., 1] * arms[..., 0],
        ], -1)  # fmt: skip
        return off / SCALES, np.concatenate([moves, axes], -1) / SCALES

    def _frames(self, angles: Array) -> tuple[Array, Array]:
        """World poses ``(s, n, 4, 4)`` of the joints at angles ``(s, n)``, and of the hand ``(s, 4, 4)``."""
        still, sine, versine = self._turning
        turned = (
            still + np.sin(angles)[..., None, None] * sine + (1 - np.cos(angles))[..., None, None] * versine
        )
        frames = [turned[:, 0]]
        for i in range(1, len(self.joints)):
            frames.append(frames[-1] @ turned[:, i])
        return np.stack(frames, 1), frames[-1] @ self.T_last_ee

    @cached_property
    def _turning(self) -> tuple[Array, Array, Array]:
        """Rodrigues' formula of every joint: its pose is ``A + sin(q) B + (1 - cos(q)) C``, ``(n, 4, 4)``."""
        before = np.stack([joint.T_before_joint for joint in self.joints])
        cross = np.zeros_like(before)
        x, y, z = self._axes.T
        cross[:, 2, 1], cross[:, 0, 2], cross[:, 1, 0] = x, y, z
        cross -= cross.swapaxes(1, 2)
        return before, before @ cross, before @ cross @ cross

    @cached_property
    def _axes(self) -> Array:
        return np.stack([joint.axis for joint in self.joints])

    @cached_property
    def _limits(self) -> Array:
        return np.stack([joint.limits for joint in self.joints])

    @cached_property
    def _elsewhere(self) -> Array:
        """Joint angles ``(s, n)`` spread over the joints' ranges, always the same."""
        low, high = self._limits.T
        return np.random.default_rng(0).uniform(low, high, (MORE_STARTS, len(low)))


def _costs(off: Array, from_rest: Array) -> Array:
    """What is to be least ``(s,)``: scaled errors ``(s, 6)``, and a little the way ``(s, n)`` from rest."""
    return (off**2).sum(1) + (from_rest**2).sum(1) / SCALE_REST_RAD**2


def _downhill(slopes: Array, uphill: Array, damping: Array) -> Array:
    """Steps of the joints ``(s, n)`` by slopes ``(s, n, 6)`` and gradients ``(s, n)`` of the cost."""
    curvature = slopes @ slopes.swapaxes(1, 2)
    steepest = curvature.diagonal(axis1=1, axis2=2).max(1)
    added = (damping * steepest + 1 / SCALE_REST_RAD**2)[:, None, None] * np.eye(uphill.shape[1])
    return np.asarray(-np.linalg.solve(curvature + added, uphill[..., None])[..., 0], float)


def _rotation_vectors(R: Array) -> Array:
    """Rotation vectors ``(s, 3)`` of rotation matrices, as :func:`se3.log_so3` but in a tenth of its time."""
    cosines = (R.trace(axis1=1, axis2=2) - 1) / 2
    if cosines.min() < -0.99:  # near half a turn the axis is not told by the difference
        return se3.log_so3(R)
    twice = R - R.swapaxes(1, 2)
    axes = np.stack([twice[:, 2, 1], twice[:, 0, 2], twice[:, 1, 0]], 1) / 2
    sines = np.sqrt((axes**2).sum(1))
    return axes * (np.arctan2(sines, cosines) / np.maximum(sines, 1e-12))[:, None]


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
