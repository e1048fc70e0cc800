"""An entry, and the scene that its key poses are carried over to."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from lerobot_openspm.control.feasibility import Miss, check_reach, check_transfer
from lerobot_openspm.control.finger_room import dodged, shifted
from lerobot_openspm.control.joint_room import FURTHER_M, reach_left
from lerobot_openspm.control.pushes import pushed_by_landmark
from lerobot_openspm.control.putting import put_aside, put_turned
from lerobot_openspm.control.transfer import (
    HALF_TURN,
    RETREAT_M,
    Put,
    Target,
    Turn,
    as_shown,
    half_turned,
    transfer,
)
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose, Outcome, RetrievalKey
from lerobot_openspm.types import SubTask, Symmetry

if TYPE_CHECKING:
    from lerobot_openspm.control.planning import PlanningContext

# An object this far from where the key poses took it to be takes them along; less is noise.
MOVED_M, MOVED_RAD = 0.002, 0.05
# Grasps of objects that turn into themselves are turned by so much or what their symmetry allows of it,
# radians.
TURNS = tuple(
    np.deg2rad([0, *(sign * turn for turn in range(30, 180, 30) for sign in (1, -1)), 180]).tolist()
)
# How long a retreat of our own is, metres: the first of these that the arm reaches.
RETREATS_M = (RETREAT_M, RETREAT_M / 2, 0.0)
# Where something overhangs the place of what is carried, it is put down beside it by one of
# these, metres, in one of so many directions; as long as the place has not moved by so much.
ASIDE_M, ASIDE_DIRECTIONS, ASIDE_KEPT_M = (0.01, 0.02, 0.03), 12, 0.03
# What slipped out of the fingers is taken hold of again so much deeper, metres.
DEEPER_M = 0.008
# Where an object is that was never seen.
NOWHERE = se3.transform(np.eye(3), np.full(3, np.inf))


@dataclass(frozen=True)
class Plan:
    """An entry, and the scene that its key poses are carried over to.

    Attributes:
        entry: What is acted by.
        object_poses: Poses ``T_world_obj`` ``(4, 4)`` that the key poses are carried over by. For what the
            hand has touched they are those from before.
        T_world_ee: The hand's pose ``(4, 4)`` where the plan begins.
        turned: How far the hand is turned about the axis of objects that it grasps, which turn into
            themselves by that, radians.
        put: How it is turned where it puts them.
        is_half_turned: Whether the hand is turned by half a turn about its approach axis.
        stance: The arm's joint angles ``(n,)`` where the plan begins; None where they are not known, and
            reach is not checked by them.
        retreat_m: How far the hand backs off at the end of a demonstration that was cut before it did.
        aside: How far beside its place what is carried is put down, x and y in the world, metres.
        around: How far it is turned where it is put on or in something round, radians.
        out: How far ``(3,)`` beside key poses the hand passes by, by their index, in the world, metres.
        shifts: How far the hand goes to one side as it takes hold, by sub-task, along its y axis, metres.
        dodges: The same, instead, from what kept the hand from going down there before.
        deeper: How much further the hand goes as it takes hold, by sub-task, along its z axis, metres.
        not_meant: By name, poses ``T_world_obj`` ``(4, 4)`` of others of its kind, which stand about.
    """

    entry: MemoryEntry
    object_poses: Mapping[str, Array]
    T_world_ee: Array
    turned: float = 0.0
    put: Put = "turned"
    is_half_turned: bool = False
    stance: Array | None = None
    retreat_m: float = RETREAT_M
    aside: tuple[float, float] = (0.0, 0.0)
    around: float = 0.0
    out: Mapping[int, Array] = field(default_factory=dict[int, Array])
    shifts: Mapping[int, float] = field(default_factory=dict[int, float])
    dodges: Mapping[int, float] = field(default_factory=dict[int, float])
    deeper: Mapping[int, float] = field(default_factory=dict[int, float])
    not_meant: Mapping[str, Sequence[Array]] = field(default_factory=dict[str, Sequence[Array]])

    def targets(
        self, context: PlanningContext, gone: Mapping[int, float] | None = None
    ) -> tuple[Target, ...]:
        """The key poses in the scene; see :func:`transfer`."""
        entry = self.entry
        object_poses = as_shown(entry, self.object_poses, context.symmetries)
        turns = {
            sub_task: Turn(name, object_poses[name], context.symmetries[name].middle, self.turned, self.put)
            for sub_task, name in self.symmetric_grasps(context).items()
            if (self.turned or self.put != "turned") and name in object_poses
        }
        # Which pose of a symmetric object is meant is told by the hand as it was demonstrated.
        T_world_ee = self.T_world_ee @ HALF_TURN if self.is_half_turned else self.T_world_ee
        scene = object_poses, context.yaw_periods, T_world_ee
        targets = transfer(entry, *scene, gone, turns, self.retreat_m)
        if any(self.aside):
            targets = put_aside(targets, np.array(self.aside))
        if self.around:
            targets = put_turned(targets, self.around, entry.carried, object_poses, context.symmetries)
        if self.out:
            targets = tuple(_beside(target, self.out.get(i)) for i, target in enumerate(targets))
        targets = half_turned(targets) if self.is_half_turned else targets
        return shifted(targets, {**self.shifts, **self.dodges}, self.deeper)

    def grasp(self, sub_task: int, context: PlanningContext) -> Target:
        """The key pose in the scene at which a sub-task takes hold of something; it has one."""
        poses = (target for target in self.targets(context) if target.key_pose.sub_task == sub_task)
        return next(target for target in poses if target.key_pose.phase == "grasp")

    def symmetric_grasps(self, context: PlanningContext) -> dict[int, str]:
        """What is grasped to be carried and turns into itself, by sub-task; a handle is on one side only."""
        return {i: name for i, name in self.entry.carried.items() if name in context.symmetries}

    def turns(self, context: PlanningContext) -> list[Plan]:
        """The plan with its grasps turned as the objects' shapes allow, the least first; as it is at first.

        It is put down as it was shown too, the hand being turned only where it grasps. What is round is also
        put with the hand as it grasped it, where the landmark is turned.
        """
        least = [context.symmetries[name].turn for name in self.symmetric_grasps(context).values()]
        puts: tuple[Put, ...] = ("turned", "as_shown") if any(least) else ("turned", "as_shown", "kept")
        turns = [
            radians
            for radians in TURNS
            if least and all(turn == 0 or _is_multiple(radians, turn) for turn in least)
        ]
        # What is not turned is put turned as it is put as shown.
        ways = [(turned, put) for turned in turns for put in puts if turned or put != "as_shown"]
        others = [way for way in ways if way != (self.turned, self.put)]
        return [self, *(replace(self, turned=turned, put=put) for turned, put in others)]

    def otherwise_put(self, context: PlanningContext) -> list[Plan]:
        """The plan, putting down what is carried turned, where its landmark is round, or beside its place.

        It is put no further beside it than counts as there. In a basket or a drawer, its wall is beside it.
        """
        symmetries = context.symmetries
        onto = [symmetries.get(one.anchor.place) for one in self._puts if one.target in symmetries]
        is_round = any(landmark is not None and landmark.turn == 0 for landmark in onto)
        ways: list[Plan] = [replace(self, around=radians) for radians in TURNS if radians and is_round]
        most = min((one.tolerance_m for one in self._puts), default=0.0)
        if any(self.entry.key.sub_tasks[one.sub_task].relation == "in" for one in self._puts):
            return ways
        yaws = np.linspace(0, 2 * np.pi, ASIDE_DIRECTIONS, endpoint=False)
        return ways + [
            replace(self, aside=(metres * float(np.cos(yaw)), metres * float(np.sin(yaw))))
            for metres in ASIDE_M
            for yaw in yaws
            if metres <= most
        ]

    def following(self, moved: Mapping[str, Array]) -> Plan:
        """The plan with some objects elsewhere, at poses ``T_world_obj`` ``(4, 4)``, led aside nowhere yet.

        Beside a place that has moved, things may stand otherwise. What a hand dodged is still there where
        the object has hardly moved.
        """
        far = {
            name for name, T in moved.items()
            if se3.distances(T, self.object_poses.get(name, NOWHERE))[0] >= ASIDE_KEPT_M
        }  # fmt: skip
        dodges = {i: metres for i, metres in self.dodges.items() if self.entry.carried.get(i) not in far}
        poses = {**self.object_poses, **moved}
        plan = replace(self, object_poses=poses, out={}, shifts={}, dodges=dodges)
        if far & {name for one in self._puts for name in one.anchor.objects}:
            plan = replace(plan, aside=(0.0, 0.0), around=0.0)
        return plan

    def deepened(self, sub_task: int, context: PlanningContext) -> Plan | None:
        """The plan that takes hold deeper of a load that slipped out.

        None for one that slipped out before, and where the hand may not go deeper.
        """
        if sub_task not in self.entry.carried:
            return self  # a handle is where it is
        if sub_task in self.deeper:
            return None
        plan = replace(self, deeper={**self.deeper, sub_task: DEEPER_M})
        return None if plan.check(context, plan.targets(context)) else plan

    def dodging(self, sub_task: int, pushed_m: float, context: PlanningContext) -> Plan | None:
        """The plan that takes hold of a load a little aside of what was in the way of one finger.

        None where it is not known of which, the hand went aside before, or the arm cannot follow.

        Args:
            sub_task: In which the hand did not get down.
            pushed_m: How far it was pushed aside there, along its y axis, metres.
            context: What all environments share.
        """
        name, grasp = self.entry.carried.get(sub_task), self.grasp(sub_task, context)
        if name is None or sub_task in self.dodges:
            return None
        middle = 0.0
        if name in context.symmetries and name in self.object_poses:
            own = np.array([[*context.symmetries[name].middle, 0.0]])
            middle = float(se3.apply(se3.inverse(grasp.T_world_ee) @ self.object_poses[name], own)[0, 1])
        metres = dodged(grasp, pushed_m, middle, context.robot.open_width)
        shifts = {i: m for i, m in self.shifts.items() if i != sub_task}
        plan = replace(self, shifts=shifts, dodges={**self.dodges, sub_task: metres})
        return plan if metres and not plan.followed(context)[1] else None

    def as_if_in_place(
        self, object_poses: Mapping[str, Array], symmetries: Mapping[str, Symmetry]
    ) -> dict[str, Array]:
        """Object poses as outcomes are told: what was put aside moved back, what is round turned as shown."""
        back = se3.from_yaw(np.array([-self.aside[0], -self.aside[1], 0.0]), 0.0)
        put = {one.target for one in self._puts}
        shown = as_shown(self.entry, object_poses, symmetries)
        return {name: back @ T if name in put else T for name, T in shown.items()}

    def missed(
        self, object_poses: Mapping[str, Array], recognised: Collection[str], context: PlanningContext
    ) -> list[Outcome] | None:
        """The outcomes that are seen not to be met, see :meth:`MemoryEntry.missed`."""
        poses = self.as_if_in_place(object_poses, context.symmetries)
        return self.entry.missed(poses, recognised, context.yaw_periods)

    @property
    def _puts(self) -> list[Outcome]:
        """The outcomes of what is grasped and put somewhere; what is pushed is put nowhere."""
        carried = self.entry.carried
        return [one for one in self.entry.served_outcomes if carried.get(one.sub_task) == one.target]

    def followed(self, context: PlanningContext) -> tuple[Plan, list[str]]:
        """The plan, backing off as far as the arm reaches, and what keeps the hand from following it."""
        problems = self.check(context, self.targets(context))
        if problems:
            return self, problems
        plan, miss = self.backing_off(context)
        return plan, [] if miss is None else [str(miss)]

    def check(self, context: PlanningContext, targets: Sequence[Target]) -> list[str]:
        """What is wrong with its key poses in the scene, the joints' reach left out."""
        joints_known = self.stance is not None
        return check_transfer(targets, self.T_world_ee, context.robot, context.limits, joints_known)

    def miss(self, context: PlanningContext, targets: Sequence[Target]) -> Miss | None:
        """The first of its key poses in the scene that the arm's joints do not reach, as far as is known."""
        arm = context.robot.arm
        if arm is None or self.stance is None:
            return None
        return check_reach(targets, self.T_world_ee, arm, self.stance)

    def reach_left(self, context: PlanningContext) -> float:
        """How much further out the arm could go as it grasps, see :func:`reach_left`; metres."""
        arm = context.robot.arm
        if arm is None or self.stance is None:
            return FURTHER_M[0]
        # Turning the grasps leaves the hand where it is at a handle.
        carrying = [one for one in self.targets(context) if one.key_pose.sub_task in self.entry.carried]
        return reach_left(carrying, arm, self.stance)

    def backing_off(self, context: PlanningContext) -> tuple[Plan, Miss | None]:
        """The plan, backing off as far as the arm reaches, and the first key pose that it does not reach.

        Only a retreat of our own is shortened: what was demonstrated has to be reached.
        """
        plan, miss = self, None
        for metres in RETREATS_M:
            plan = replace(self, retreat_m=metres)
            miss = plan.miss(context, plan.targets(context))
            if miss is None or miss.index < len(self.entry.key_poses):
                break
        return plan, miss

    def is_same_scene(self, object_poses: Mapping[str, Array], T_world_ee: Array) -> bool:
        """Whether the same objects, and the hand, are where the plan was made for."""
        is_still = float(se3.distance(self.T_world_ee, T_world_ee)) < MOVED_M
        is_known = object_poses.keys() == self.object_poses.keys()
        return is_still and is_known and not self.moved(list(object_poses), object_poses)

    def moved(self, names: Sequence[str], object_poses: Mapping[str, Array]) -> dict[str, Array]:
        """The poses of those objects that are elsewhere now than where the plan takes them to be."""
        moved: dict[str, Array] = {}
        for name in (name for name in names if name in object_poses):
            T = object_poses[name]
            metres, radians = se3.distances(T, self.object_poses.get(name, NOWHERE))
            if metres > MOVED_M or radians > MOVED_RAD:
                moved[name] = T
        return moved

    def objects(self, index: int, altered: Collection[str]) -> list[str]:
        """Objects of the key poses from an index on, without those that look different by now."""
        ahead = self.entry.key_poses[index:]
        names = dict.fromkeys(name for pose in ahead for name in pose.anchor.objects)
        # What is pushed is needed until the push begins, also if no key pose belongs to it.
        pushed = pushed_by_landmark(self.entry)
        for pose in ahead[1:]:
            if pose.phase == "push" and pose.sub_task in pushed:
                names[pushed[pose.sub_task]] = None
        return [name for name in names if name not in altered]

    def touched(self, passed: Sequence[Target]) -> set[str]:
        """What the hand took hold of or moved at the key poses passed: it is elsewhere from then on."""
        touched: set[str] = set()
        for pose in (target.key_pose for target in passed):
            if pose.phase == "push":  # its anchor may be where the target goes
                touched.add(self.sub_task(pose).target)
            elif pose.phase in ("grasp", "open", "turn"):
                touched.add(pose.anchor.place)
        return touched

    def regrasped(self, index: int) -> set[str]:
        """What is grasped from a key pose on, within its sub-task: it is not in the hand any more."""
        ahead = self.entry.key_poses[index:]
        own = [pose for pose in ahead if pose.sub_task == ahead[0].sub_task]
        return {pose.anchor.place for pose in own if pose.phase in ("approach", "grasp")}

    def begin_of(self, sub_task: int) -> int:
        """The first key pose of a sub-task."""
        return next(i for i, pose in enumerate(self.entry.key_poses) if pose.sub_task == sub_task)

    def sub_task(self, pose: MemoryKeyPose) -> SubTask:
        """The sub-task that a key pose serves."""
        return self.entry.key.sub_tasks[pose.sub_task]


# Before the first plan: nothing is done, nowhere.
NO_PLAN = Plan(MemoryEntry(RetrievalKey((), ()), "", (), 0.0, 0, ""), {}, np.eye(4))


def _beside(target: Target, by: Array | None) -> Target:
    """A key pose that the hand passes by ``(3,)`` beside it in the world, metres."""
    T = target.T_world_ee
    return target if by is None else replace(target, T_world_ee=se3.transform(T[:3, :3], T[:3, 3] + by))


def _is_multiple(radians: float, turn: float) -> bool:
    """Whether an angle is some turns, to a degree."""
    return abs(radians / turn - round(radians / turn)) * turn < np.deg2rad(1)
