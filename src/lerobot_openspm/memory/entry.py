"""Memory entries, the paper's ``M_i = {k_i, l_i, {T_obj_ee, c, gamma}, r_i, nu_i}``."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import SubTask

Phase = Literal[
    "approach", "grasp", "lift", "pre-place", "place", "release", "retreat", "push", "open", "turn"
]
PHASES: tuple[str, ...] = get_args(Phase)
# The hand moves as the object allows.
CONSTRAINED_PHASES = ("push", "open", "turn")
# The hand touches something: these key poses are met precisely, the others in passing.
CONTACT_PHASES = ("grasp", "place", "release", *CONSTRAINED_PHASES)
# The hand is on the way to where what it carries ends, or there.
ARRIVING = ("pre-place", "place", "release")


@dataclass(frozen=True)
class RetrievalKey:
    """The paper's ``k_i``: operations with their objects, and the phase structure of the demonstration."""

    sub_tasks: tuple[SubTask, ...]
    phases: tuple[str, ...]


WORLD = "world"


@dataclass(frozen=True)
class Anchor:
    """The frame a key pose is kept in: the place of one object, with the axes of that or another one.

    The paper's anchors are those with ``axes == place``. But a bottle is set down on a rack however the rack
    is turned, and a box is let go over a bowl as it was taken: there the world's axes, or those of the object
    in the hand, are what the demonstrations have in common.

    Attributes:
        place: Object whose position is the origin.
        axes: Object whose orientation gives the axes, or :data:`WORLD`.
    """

    place: str
    axes: str

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects whose poses are needed."""
        return (self.place,) if self.axes in (self.place, WORLD) else (self.place, self.axes)

    def frame(self, object_poses: Mapping[str, Array]) -> Array:
        """The anchor's pose ``T_world_anchor`` ``(4, 4)``, given the objects' poses ``T_world_obj``."""
        rotation = np.eye(3) if self.axes == WORLD else object_poses[self.axes][:3, :3]
        return se3.transform(rotation, object_poses[self.place][:3, 3])


AxisKind = Literal["slide", "turn"]
# What the phases in which an object follows the hand along a constraint do.
AXIS_KINDS: dict[str, AxisKind] = {"open": "slide", "turn": "turn"}


@dataclass(frozen=True)
class Axis:
    """What an anchor that moves along a constraint allows: a drawer slides, a knob turns.

    The axis of a turn runs through the hand, which holds a knob at its middle.

    Attributes:
        kind: Whether it is a direction to slide in or an axis to turn about.
        direction: Unit vector ``(3,)`` in the anchor's frame.
        amount: How far the demonstration went, metres or radians.
    """

    kind: AxisKind
    direction: Array
    amount: float

    def follow(self, T: Array) -> Array:
        """Where a hand at ``T`` ``(4, 4)``, in the frame of the direction, ends that goes all the way."""
        if self.kind == "slide":
            return se3.transform(T[:3, :3], T[:3, 3] + self.amount * self.direction)
        return se3.transform(se3.exp_so3(self.amount * self.direction) @ T[:3, :3], T[:3, 3])

    def travel(self, T_start: Array, T: Array) -> float:
        """How far a hand at ``T`` has gone along the constraint since ``T_start``, metres or radians."""
        step = se3.increment(T_start, T)
        return float((step[:3] if self.kind == "slide" else step[3:]) @ self.direction)


@dataclass(frozen=True)
class MemoryKeyPose:
    """Where the hand was relative to the object that mattered, at one phase boundary.

    Attributes:
        anchor: The frame the pose is kept in.
        T_obj_ee: Pose ``(4, 4)`` of the hand in that frame, the paper's ``Delta T_j``.
        phase: The phase that ends here, one of :data:`PHASES`.
        confidence: The paper's ``gamma``, 0 to 1.
        closed: Whether the gripper is closed (or closing) on the way to this pose.
        opening: Gripper opening observed here, in the units of the robot's state.
        n_steps: Control steps the demonstration took to get here from the key pose before, pauses left out.
        dwell: Whether the hand stands still on the way here while the gripper opens or closes.
        axis: The constraint that the way here follows; None in free space.
        sub_task: Which of the entry's sub-tasks the pose serves, counted from 0.
        covariance: Spread ``(6, 6)`` of the merged demonstrations around the pose, over increments
            ``(translation, rotation vector)`` in the anchor's frame, metres and radians; None for a pose of
            one demonstration.
    """

    anchor: Anchor
    T_obj_ee: Array
    phase: str
    confidence: float
    closed: bool
    opening: float
    n_steps: int
    dwell: bool
    axis: Axis | None = None
    sub_task: int = 0
    covariance: Array | None = None


# How far an object may fall after the hand has let go of it: into a bowl, a drawer or a basket.
MAX_FALL_M = 0.06


@dataclass(frozen=True)
class Outcome:
    """Where a sub-task leaves its target: what "done" means for it.

    Attributes:
        sub_task: Which of the entry's sub-tasks, counted from 0.
        target: The object that was moved.
        anchor: The frame in which the demonstrations agree most on where it ended.
        position: Where the target ends ``(3,)`` in that frame, metres: what the demonstrations have in
            common.
        shown: The same of this demonstration alone.
        tolerance_m: The sub-task is done while the target is at most this far from there; it may lie lower by
            :data:`MAX_FALL_M`, because what is let go falls.
        middle: Where the target is, x and y in its own frame, metres: on the axis about which it turns into
            itself, so that it is there however it is turned.
    """

    sub_task: int
    target: str
    anchor: Anchor
    position: Array
    shown: Array
    tolerance_m: float
    middle: tuple[float, float] = (0.0, 0.0)

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects whose poses are needed to judge it."""
        return tuple(dict.fromkeys((self.target, *self.anchor.objects)))

    def target_at(self, object_poses: Mapping[str, Array]) -> Array:
        """Where the target is ``(3,)`` in the world, given the objects' poses ``T_world_obj``."""
        return se3.apply(object_poses[self.target], np.array([[*self.middle, 0.0]]))[0]

    def place_shown(self, object_poses: Mapping[str, Array]) -> Array:
        """Where the demonstration left the target ``(3,)`` in the world, given its objects' poses."""
        return se3.apply(self.anchor.frame(object_poses), self.shown[None])[0]

    def place(self, object_poses: Mapping[str, Array]) -> Array:
        """Where the target should end ``(3,)`` in the world, given the objects' poses ``T_world_obj``."""
        return se3.apply(self.anchor.frame(object_poses), self.position[None])[0]

    def is_met(self, object_poses: Mapping[str, Array]) -> bool:
        """Whether the target is where it should be, given the objects' poses ``T_world_obj``."""
        off = self.target_at(object_poses) - self.place(object_poses)
        beside = float(np.linalg.norm(off[:2]))
        return beside <= self.tolerance_m and -MAX_FALL_M <= float(off[2]) <= self.tolerance_m

    def is_met_either_way(self, object_poses: Mapping[str, Array], yaw_periods: Mapping[str, float]) -> bool:
        """Whether it is met whichever way round a landmark that turns into itself was seen.

        Args:
            object_poses: Poses ``T_world_obj`` ``(4, 4)``.
            yaw_periods: Angle by object that turns it into itself, radians.
        """
        axes = self.anchor.axes
        if axes == WORLD:
            return self.is_met(object_poses)
        turned = se3.yaw_equivalents(object_poses[axes], yaw_periods.get(axes, 2 * np.pi))
        return any(self.is_met({**object_poses, axes: T}) for T in turned)


def episode_of(source: str) -> int:
    """Number of the episode that an entry was mined from: 20 of the source "name#20", or "name#20.2"."""
    return int(source.rpartition("#")[2].partition(".")[0])


@dataclass(frozen=True)
class MemoryEntry:
    """One demonstration, compressed.

    Attributes:
        key: What the entry is found by, ``k_i``.
        language: The instruction of the demonstration, ``l_i``.
        key_poses: In the order of execution.
        quality: The paper's ``r_i``, 0 to 1: how closely the demonstration agrees with others of its task
            and how firmly it held what it carried, updated by how it fared at deployment.
        version: The paper's ``nu_i``: counts up when an entry is replaced.
        source: Dataset and episode the entry was mined from, "name#20"; "name#20.2" where the episode did
            this a second time.
        object_poses: Poses ``T_world_obj`` ``(4, 4)`` of the objects at the start of the demonstration.
        trials: How often the entry was acted by at deployment, where it is known whether that succeeded.
        successes: How many of these succeeded.
        outcomes: Where the sub-tasks leave what they move, for those of which it is known.
    """

    key: RetrievalKey
    language: str
    key_poses: tuple[MemoryKeyPose, ...]
    quality: float
    version: int
    source: str
    object_poses: dict[str, Array] = field(default_factory=dict[str, Array])
    trials: int = 0
    successes: int = 0
    outcomes: tuple[Outcome, ...] = ()

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects the entry needs a pose of, each once, in the order of their first use."""
        return tuple(dict.fromkeys(name for pose in self.key_poses for name in pose.anchor.objects))

    @property
    def carried(self) -> dict[int, str]:
        """What the hand grasps and takes along, by sub-task; a handle that it opens or turns stays there."""
        held = {pose.sub_task for pose in self.key_poses if pose.phase in AXIS_KINDS}
        grasps = (pose for pose in self.key_poses if pose.phase == "grasp" and pose.sub_task not in held)
        return {pose.sub_task: pose.anchor.place for pose in grasps}

    def demonstrated(self, pose: MemoryKeyPose) -> Array:
        """``T_world_ee`` ``(4, 4)`` of a key pose in the demonstration."""
        return pose.anchor.frame(self.object_poses) @ pose.T_obj_ee

    @property
    def served_outcomes(self) -> list[Outcome]:
        """The outcomes that the key poses can bring about; others could not be mended."""
        served = {pose.sub_task for pose in self.key_poses}
        return [one for one in self.outcomes if one.sub_task in served]

    def missed(
        self, poses: Mapping[str, Array], recognised: Collection[str], yaw_periods: Mapping[str, float]
    ) -> list[Outcome] | None:
        """The outcomes that are seen not to be met, in order; None where none is, but not all are seen.

        One is seen where its target was recognised and the poses of its objects are known.
        """
        outcomes = self.served_outcomes
        seen = [one for one in outcomes if one.target in recognised and poses.keys() >= set(one.objects)]
        missed = [one for one in seen if not one.is_met_either_way(poses, yaw_periods)]
        return missed if missed or len(seen) == len(outcomes) else None
