"""Which entry an instruction is carried out by in a scene, and what its key poses touch there."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lerobot_openspm.control.clearance import crowding, lifted
from lerobot_openspm.control.feasibility import (
    Miss,
    TransferLimits,
    check_reach,
    check_transfer,
    find_stance,
    geometric_score,
)
from lerobot_openspm.control.pushes import pushed_by_landmark
from lerobot_openspm.control.transfer import (
    HALF_TURN,
    Target,
    Turn,
    half_turned,
    transfer,
)
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.language.meaning import means_the_same
from lerobot_openspm.language.names import TABLE_NAMES, NameSimilarity
from lerobot_openspm.memory.compose import Candidate
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose, RetrievalKey
from lerobot_openspm.memory.retrieval import Scored, retrieve
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.types import Execution, SubTask, Symmetry

logger = logging.getLogger(__name__)

# An object this far from where the key poses took it to be takes them along; less is noise.
MOVED_M, MOVED_RAD = 0.002, 0.05
# Of the entries so many are tried, and grasps of objects that turn into themselves are turned by so much or
# what their symmetry allows of it, radians.
MAX_TRIED = 3
TURNS = tuple(
    np.deg2rad([0, *(sign * turn for turn in range(30, 180, 30) for sign in (1, -1)), 180]).tolist()
)
# The hand is in much more of other objects if it is in so many times as many points of them.
MUCH_MORE = 2
# A memory that knows more objects than this knows several scenes, and not all objects are looked for.
MOST_IN_A_SCENE = 20
# Where an object is that was never seen.
NOWHERE = se3.transform(np.eye(3), np.full(3, np.inf))


@dataclass(frozen=True)
class PlanningContext:
    """What every environment shares: the memory, the robot, how to choose and how to follow.

    Attributes:
        entries: The memory's entries.
        yaw_periods: Angle by object that turns it into itself, radians.
        robot: The robot.
        limits: Of transferred key poses.
        execution: How key poses are followed.
        tracking: Whether objects are looked for again once a plan is made.
        step_s: Seconds that a control step takes.
        names: Tells which names in an instruction mean the same thing.
        points: Points ``(n, 3)`` of each object's surface in its frame, where its shape is known.
        hand_radius_m: Radius of the hand, with which it keeps clear of other objects.
        symmetries: How objects turn into themselves, of those that do.
    """

    entries: Sequence[MemoryEntry]
    yaw_periods: Mapping[str, float]
    robot: RobotModel
    limits: TransferLimits = field(default_factory=TransferLimits)
    execution: Execution = "closed_loop_trc"
    tracking: bool = True
    step_s: float = 0.05
    names: NameSimilarity = TABLE_NAMES
    points: Mapping[str, Array] = field(default_factory=dict[str, Array])
    hand_radius_m: float = 0.0
    symmetries: Mapping[str, Symmetry] = field(default_factory=dict[str, Symmetry])

    def __deepcopy__(self, memo: dict[int, object]) -> PlanningContext:
        """Itself: nothing here ever changes, and the memory may be large."""
        return self

    def object_meant(self, name: str) -> str:
        """The known object that a name in an instruction means; the name itself where there is none."""
        alike = {known: self.names.similarity(name, known) for known in self.yaw_periods}
        best = max(alike, key=lambda known: alike[known], default=name)
        return best if alike.get(best, 0.0) > 0 else name

    def objects_of_interest(self, entries: Sequence[MemoryEntry]) -> list[str]:
        """The objects that entries need, and what else is known, which may stand in the way.

        What is known of many scenes is mostly elsewhere, and left out.
        """
        needed = [name for one in entries for name in (*one.objects, *pushed_by_landmark(one).values())]
        return [*needed, *(self.points if len(self.points) <= MOST_IN_A_SCENE else ())]

    @property
    def surfaces(self) -> dict[str, Array]:
        """The table under its names, at the middle of where the hand was in the demonstrations."""
        low, high = self.robot.workspace
        middle = se3.transform(np.eye(3), [*(low[:2] + high[:2]) / 2, low[2]])
        return dict.fromkeys(self.names.lexicon.surfaces, middle)

    def rank(
        self, candidates: Sequence[Candidate], object_poses: Mapping[str, Array], T_world_ee: Array
    ) -> tuple[Scored, ...]:
        """Candidates by the paper's score, best first.

        The scene is the poses ``T_world_obj`` ``(4, 4)`` of the objects that were found, and the hand's.
        """
        scene = object_poses, self.yaw_periods, T_world_ee, self.robot, self.limits
        geometric = {id(one.entry): geometric_score(one.entry, *scene) for one in candidates}
        semantic = [(one.entry, one.semantic) for one in candidates]
        return tuple(retrieve(semantic, lambda entry: geometric[id(entry)], self.names))

    def choose(
        self, ranked: Sequence[Scored], object_poses: Mapping[str, Array], T_world_ee: Array
    ) -> tuple[Plan, list[str]]:
        """The best entry that the arm can follow, its grasps turned by an object's symmetry if need be.

        The hand goes the other way round, by half a turn about its approach axis, where nothing else does.
        Where it would be in other objects as it takes hold or lets go, grasps are turned too, and entries
        that mean the same are tried.

        Returns:
            The plan, and what keeps the hand from following it, in words. Where none of the first entries
            can be followed, or objects of the best one were not found, the best one as it is.
        """
        first = Plan(ranked[0].entry, object_poses, T_world_ee)
        if any(name not in object_poses for name in first.entry.objects):
            return first, []
        first = replace(first, stance=find_stance(self.robot, T_world_ee))
        points, crowded = self._points(object_poses), list[tuple[Plan, dict[str, int]]]()
        for entry in (one.entry for one in ranked[:MAX_TRIED] if one.geometric > 0):
            if crowded and not self._mean_the_same(entry, crowded[0][0].entry):
                continue
            for is_half_turned in (False, True):
                found = self._turned(replace(first, entry=entry, is_half_turned=is_half_turned), points)
                if found is not None and not found[1]:
                    return found[0], []
                crowded += [found] if found is not None else []
        if not crowded:
            return first, first.problems(self)
        plan, inside = min(crowded, key=_amount)
        logger.warning("%r: the hand may touch the %s where it takes hold or lets go",
                       plan.entry.language, " and the ".join(inside))  # fmt: skip
        return plan, []

    def _mean_the_same(self, entry: MemoryEntry, other: MemoryEntry) -> bool:
        return means_the_same(entry.key.sub_tasks, other.key.sub_tasks, self.names.lexicon)

    def _turned(self, plan: Plan, points: Mapping[str, Array]) -> tuple[Plan, dict[str, int]] | None:
        """A plan with its grasps turned by the least with which the arm can follow it clear of other objects.

        Where that is not to be had, they are turned only if the hand is in much less of them then. None where
        the arm cannot follow it at all.

        Args:
            plan: As it is.
            points: Points ``(n, 3)`` in the world of the objects that were found, by name.

        Returns:
            The plan, and how much of what the hand is in, see :func:`crowding`.
        """
        turning, ways = plan.symmetric_grasps(self), list[tuple[Plan, dict[str, int]]]()
        for turned in (replace(plan, turned=radians) for radians in plan.turns(self)):
            targets = turned.targets(self)
            if not check_transfer(targets, plan.T_world_ee, self.robot, self.limits):
                ways.append((turned, crowding(turned.entry, targets, points, self.hand_radius_m)))
        least = min(map(_amount, ways), default=0)
        for turned, inside in sorted(ways, key=lambda way: _amount(way) > MUCH_MORE * least):
            miss = turned.miss(self, turned.targets(self))
            if miss is None:
                return turned, inside
            if miss.target.key_pose.sub_task not in turning:
                return None  # turning the grasps leaves it where it is
        return None

    def _points(self, object_poses: Mapping[str, Array]) -> dict[str, Array]:
        """Points ``(n, 3)`` in the world of the objects that were found and whose shape is known."""
        return {
            name: se3.apply(object_poses[name], own)
            for name, own in self.points.items()
            if name in object_poses
        }

    def clear(self, plan: Plan) -> Plan:
        """A plan whose ways are lifted over what stands about.

        Where the arm cannot follow the lifted ways, the plan stays as it is, and that is said.
        """
        points = self._points(plan.object_poses)
        entry, crossed = lifted(plan.entry, plan.targets(self), plan.T_world_ee, points, self.hand_radius_m)
        if not crossed:
            return plan
        higher = replace(plan, entry=entry)
        if problems := higher.problems(self):
            logger.warning(
                "%r: goes straight although the %s may be in the way: lifted over it, %s",
                plan.entry.language, " and the ".join(crossed), "; ".join(problems),
            )  # fmt: skip
            return plan
        return higher


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
        is_half_turned: Whether the hand is turned by half a turn about its approach axis.
        stance: The arm's joint angles ``(n,)`` where the plan begins; None where they are not known, and
            reach is not checked by them.
    """

    entry: MemoryEntry
    object_poses: Mapping[str, Array]
    T_world_ee: Array
    turned: float = 0.0
    is_half_turned: bool = False
    stance: Array | None = None

    def targets(
        self,
        context: PlanningContext,
        gone: Mapping[int, float] | None = None,
        last: int | None = None,
    ) -> tuple[Target, ...]:
        """The key poses in the scene; see :func:`transfer`. Those after sub-task `last` are left out."""
        entry = self.entry if last is None else self.entry.until(last)
        turns = {
            sub_task: Turn(self.object_poses[name], context.symmetries[name].middle, self.turned)
            for sub_task, name in self.symmetric_grasps(context).items()
            if self.turned and name in self.object_poses
        }
        # Which pose of a symmetric object is meant is told by the hand as it was demonstrated.
        T_world_ee = self.T_world_ee @ HALF_TURN if self.is_half_turned else self.T_world_ee
        targets = transfer(entry, self.object_poses, context.yaw_periods, T_world_ee, gone, turns)
        return half_turned(targets) if self.is_half_turned else targets

    def symmetric_grasps(self, context: PlanningContext) -> dict[int, str]:
        """Objects that are grasped and turn into themselves, by sub-task."""
        grasps = (pose for pose in self.entry.key_poses if pose.phase == "grasp")
        return {p.sub_task: p.anchor.place for p in grasps if p.anchor.place in context.symmetries}

    def turns(self, context: PlanningContext) -> list[float]:
        """By how much its grasps may be turned, the least first, radians; none but 0 without a symmetry."""
        least = [context.symmetries[name].turn for name in self.symmetric_grasps(context).values()]
        return [
            radians
            for radians in TURNS
            if radians == 0 or (least and all(turn == 0 or _is_multiple(radians, turn) for turn in least))
        ]

    def problems(self, context: PlanningContext) -> list[str]:
        """What keeps the hand from following the plan, in words."""
        targets = self.targets(context)
        problems = check_transfer(targets, self.T_world_ee, context.robot, context.limits)
        if not problems and (miss := self.miss(context, targets)):
            return [str(miss)]
        return problems

    def miss(self, context: PlanningContext, targets: Sequence[Target]) -> Miss | None:
        """The first of its key poses in the scene that the arm's joints do not reach, as far as is known."""
        arm = context.robot.arm
        if arm is None or self.stance is None:
            return None
        return check_reach(targets, self.T_world_ee, arm, self.stance)

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

    def sub_task(self, pose: MemoryKeyPose) -> SubTask:
        """The sub-task that a key pose serves."""
        return self.entry.key.sub_tasks[pose.sub_task]


# Before the first plan: nothing is done, nowhere.
NO_PLAN = Plan(MemoryEntry(RetrievalKey((), ()), "", (), 0.0, 0, ""), {}, np.eye(4))


def _amount(way: tuple[Plan, Mapping[str, int]]) -> int:
    """In how many points of other objects the hand is."""
    return sum(way[1].values())


def _is_multiple(radians: float, turn: float) -> bool:
    """Whether an angle is some turns, to a degree."""
    return abs(radians / turn - round(radians / turn)) * turn < np.deg2rad(1)
