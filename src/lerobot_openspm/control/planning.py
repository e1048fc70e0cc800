"""Which entry an instruction is carried out by in a scene."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from lerobot_openspm.control.clearance import crowding, lifted, taken
from lerobot_openspm.control.feasibility import TransferLimits, find_stance, geometric_score
from lerobot_openspm.control.finger_room import finger_room, fingers_elsewhere
from lerobot_openspm.control.joint_room import FURTHER_M, ways_out
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.pushes import pushed_by_landmark
from lerobot_openspm.control.transfer import as_shown, half_turned
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.language.meaning import means_the_same
from lerobot_openspm.language.names import TABLE_NAMES, NameSimilarity
from lerobot_openspm.memory.compose import Candidate
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.looks import Looks
from lerobot_openspm.memory.retrieval import Scored, retrieve
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.types import Execution, Symmetry

logger = logging.getLogger(__name__)

# Of the entries so many are tried.
MAX_TRIED = 3
# A hand that is in so few points of other objects is clear of them. Else it is in much more of them in one
# plan than in another if it is in so many times as many points.
FEW_POINTS, MUCH_MORE = 10, 2
# A memory that knows more objects than this knows several scenes, and not all objects are looked for.
MOST_IN_A_SCENE = 20
# An object usually stands at one place if so many demonstrations at least show it, all of them this near to
# that, metres and radians. Patches reach as far.
MIN_SHOWN, USUAL_M, USUAL_RAD = 3, 0.035, np.deg2rad(15)


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

    @cached_property
    def feet(self) -> dict[str, Array]:
        """The middle ``(3,)`` of each object from above, at its lowest height, where its shape is known."""
        feet: dict[str, Array] = {}
        for name, points in self.points.items():
            low, high = np.percentile(points, (5, 95), axis=0)
            feet[name] = np.array([*(low + high)[:2] / 2, low[2]])
        return feet

    @cached_property
    def usual(self) -> dict[str, Array]:
        """Where the objects stood ``(4, 4)`` that hardly moved between all demonstrations, by name."""
        usual: dict[str, Array] = {}
        for name in self.points:
            shown = [entry.object_poses[name] for entry in self.entries if name in entry.object_poses]
            if len(shown) < MIN_SHOWN:
                continue
            places = np.stack(shown)[:, :3, 3]
            middle = shown[int(np.linalg.norm(places - np.median(places, axis=0), axis=1).argmin())]
            if all(_is_at(T, middle) for T in shown):
                usual[name] = middle
        return usual

    @cached_property
    def looks(self) -> Looks:
        """What decides how one object takes the place of another."""
        return Looks(self.points, self.symmetries)

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
        rest = self.yaw_periods, T_world_ee, self.robot, self.limits
        entries = [one.entry for one in candidates]
        poses = [as_shown(entry, object_poses, self.symmetries) for entry in entries]
        geometric = {id(e): geometric_score(e, own, *rest) for e, own in zip(entries, poses, strict=True)}
        semantic = [(one.entry, one.semantic) for one in candidates]
        return tuple(retrieve(semantic, lambda entry: geometric[id(entry)], self.names))

    def choose(
        self,
        ranked: Sequence[Scored],
        object_poses: Mapping[str, Array],
        T_world_ee: Array,
        not_meant: Mapping[str, Sequence[Array]] | None = None,
    ) -> tuple[Plan, list[str]]:
        """The best entry that the arm can follow, its grasps turned by an object's symmetry if need be.

        The hand goes the other way round, by half a turn about its approach axis, where nothing else does.
        Where it would be in other objects as it takes hold or lets go, grasps are turned too. Then the next
        entries are tried, of those that mean the same.

        Returns:
            The plan, and what keeps the hand from following it, in words. Where none of the first entries
            can be followed, or objects of the best one were not found, the best one as it is.
        """
        first = Plan(ranked[0].entry, object_poses, T_world_ee, not_meant=not_meant or {})
        if any(name not in object_poses for name in first.entry.objects):
            return first, []
        first, meant = replace(first, stance=find_stance(self.robot, T_world_ee)), first.entry.key.sub_tasks
        points, crowded = self._points(first), list[tuple[Plan, dict[str, int]]]()
        sought = set(self.points) if len(self.points) <= MOST_IN_A_SCENE else set[str]()
        if unseen := sorted(sought - set(points)):
            logger.info(
                "%r: does not keep clear of what is not found: %s", first.entry.language, ", ".join(unseen)
            )
        tried, occupied = self._tried(first, ranked, points)
        for entry in tried:
            if any(name not in object_poses for name in entry.objects):
                continue
            if not means_the_same(entry.key.sub_tasks, meant, self.names.lexicon):
                continue
            for is_half_turned in (False, True):
                plan = replace(first, entry=entry, is_half_turned=is_half_turned)
                found = self._clearest(plan.turns(self), points)
                if found is not None and _amount(found) <= FEW_POINTS:
                    return found[0], []
                crowded += [found] if found is not None else []
        if not crowded:
            return (first, occupied) if occupied else first.followed(self)
        best = _clearest_first(crowded)[0]
        plan, inside = next(iter(self._beside(*best, points)), best)
        if sum(inside.values()) <= FEW_POINTS:
            return plan, []
        logger.warning("%r: hand or load may touch the %s where it takes hold or lets go",
                       plan.entry.language, " and the ".join(inside))  # fmt: skip
        return plan, []

    def _tried(
        self, first: Plan, ranked: Sequence[Scored], points: Mapping[str, Array]
    ) -> tuple[list[MemoryEntry], list[str]]:
        """The first entries of which no place is taken, and what stands at the places of those before."""
        tried, occupied = list[MemoryEntry](), list[str]()
        for entry in (one.entry for one in ranked):
            if len(tried) == MAX_TRIED:
                break
            is_found = all(name in first.object_poses for name in entry.objects)
            targets = replace(first, entry=entry).targets(self) if is_found else ()
            if problems := taken(entry, targets, first.object_poses, points, first.not_meant):
                occupied = occupied or problems
            else:
                tried.append(entry)
        return tried, occupied

    def otherwise(self, plan: Plan, sub_task: int) -> Plan:
        """A plan that takes hold from another side, the furthest as clear; itself if the arm follows none."""
        straight = replace(plan, shifts={}, dodges={})  # they would lead the hand elsewhere there
        ways = [replace(way, is_half_turned=half) for way in straight.turns(self) for half in (False, True)]
        kept_from, *grasps = (way.grasp(sub_task, self) for way in (plan, *ways))
        order = fingers_elsewhere(kept_from, grasps, plan.T_world_ee, self.robot.open_width)
        allowed = (ways[i] for i in order if not ways[i].check(self, ways[i].targets(self)))
        led = [replace(way, out=self._ways_out(way)) for way in allowed]
        found = self._clearest(led, self._points(plan))
        return plan if found is None else self._with_finger_room(found[0])

    def _clearest(
        self, turned: Sequence[Plan], points: Mapping[str, Array]
    ) -> tuple[Plan, dict[str, int]] | None:
        """The first of some plans that the arm can follow, unless the hand is in much less of others in one.

        One that stretches the arm out comes after others as clear, the more the later. None if none can be.

        Args:
            turned: A plan with its grasps turned, see :meth:`Plan.turns`.
            points: Points ``(n, 3)`` in the world of the objects that were found, by name.

        Returns:
            The plan, and how much of what the hand is in, see :func:`crowding`.
        """
        stretched, most, limit, hopeless = None, -1.0, np.inf, set[bool]()
        for plan, inside in _clearest_first(self._crowded(turned, points)):
            if sum(inside.values()) > limit:
                break
            if plan.is_half_turned in hopeless:
                continue
            reaching, miss = plan.backing_off(self)
            if miss is None:
                if (left := reaching.reach_left(self)) == FURTHER_M[0]:
                    return reaching, inside
                limit = min(limit, max(MUCH_MORE * sum(inside.values()), FEW_POINTS))
                if left > most:
                    stretched, most = (reaching, inside), left
            elif miss.target.key_pose.sub_task not in plan.symmetric_grasps(self):
                hopeless.add(plan.is_half_turned)  # turning the grasps leaves it where it is
        return stretched

    def _beside(
        self, plan: Plan, inside: Mapping[str, int], points: Mapping[str, Array]
    ) -> list[tuple[Plan, dict[str, int]]]:
        """The plan that puts things down turned or a little beside their place, if that is much clearer."""
        for way in sorted(self._crowded(plan.otherwise_put(self), points), key=_amount):
            if MUCH_MORE * _amount(way) >= sum(inside.values()):
                break
            if way[0].miss(self, way[0].targets(self)) is None:
                return [way]
        return []

    def _crowded(
        self, plans: Sequence[Plan], points: Mapping[str, Array]
    ) -> list[tuple[Plan, dict[str, int]]]:
        """Of some plans those within the limits of transfer, each with how much of what the hand is in."""
        allowed = [plan for plan in plans if not plan.check(self, plan.targets(self))]
        radius = self.hand_radius_m
        return [(one, crowding(one.entry, one.targets(self), points, radius)) for one in allowed]

    def _points(self, plan: Plan) -> dict[str, Array]:
        """Points ``(n, 3)`` in the world of the objects that were found and whose shape is known."""
        found: dict[str, Array] = {}
        for name, own in self.points.items():
            if name in plan.object_poses:
                found[name] = se3.apply(plan.object_poses[name], own)
            for i, T in enumerate(plan.not_meant.get(name, ()), 1):
                found[f"other {name} {i}"] = se3.apply(T, own)
        return found

    def clear(self, plan: Plan) -> Plan:
        """A plan whose ways are lifted over what stands about and leave the joints room, where they can."""
        return self._with_room(self._with_finger_room(self._lifted(plan)))

    def _lifted(self, plan: Plan) -> Plan:
        points, targets = self._points(plan), plan.targets(self)
        if plan.is_half_turned:  # key poses are kept as the hand was before
            targets = half_turned(targets)
        usual = [name for name, T in self.usual.items() if _is_at(plan.object_poses.get(name), T)]
        entry, crossed = lifted(plan.entry, targets, plan.T_world_ee, points, self.hand_radius_m, usual)
        if not crossed:
            return plan
        higher, problems = replace(plan, entry=entry).followed(self)
        if problems:
            logger.warning(
                "%r: goes straight although the %s may be in the way: lifted over it, %s",
                plan.entry.language, " and the ".join(crossed), "; ".join(problems),
            )  # fmt: skip
            return plan
        return higher

    def following(self, plan: Plan, moved: Mapping[str, Array]) -> tuple[Plan, list[str]]:
        """The plan with some objects elsewhere, and what keeps the hand from following it; in words.

        Args:
            plan: The plan.
            moved: Where they are now, ``T_world_obj`` ``(4, 4)`` by name.
        """
        return self._with_room(self._with_finger_room(plan.following(moved))).followed(self)

    def _with_finger_room(self, plan: Plan) -> Plan:
        """A plan that takes hold beside what stands close, where the arm can follow it so."""
        room = finger_room(plan.entry, plan.targets(self), self._points(plan), self.robot.open_width)
        shifts = {i: metres for i, metres in room.items() if i not in plan.dodges}
        aside = replace(plan, shifts=shifts)
        return plan if not shifts or aside.followed(self)[1] else aside

    def _with_room(self, plan: Plan) -> Plan:
        """A plan that is led out where the arm's joints have no room."""
        out = self._ways_out(plan)
        further, problems = replace(plan, out=out).followed(self) if out else (plan, [])
        if problems:
            logger.warning(
                "%r: a joint comes near its limit as the hand rises: led further out, %s",
                plan.entry.language, "; ".join(problems),
            )  # fmt: skip
            return plan
        return further

    def _ways_out(self, plan: Plan) -> dict[int, Array]:
        """See :func:`ways_out`; nothing where the arm is not known, nor of a retreat of our own."""
        if self.robot.arm is None or plan.stance is None:
            return {}
        targets = replace(plan, out={}).targets(self)[: len(plan.entry.key_poses)]
        return ways_out(targets, self.robot.arm, plan.stance)


def _is_at(T: Array | None, T_usual: Array) -> bool:
    """Whether a pose ``(4, 4)`` is known, and near to another one."""
    if T is None:
        return False
    metres, radians = se3.distances(T, T_usual)
    return bool(metres <= USUAL_M and radians <= USUAL_RAD)


def _clearest_first(ways: Sequence[tuple[Plan, dict[str, int]]]) -> list[tuple[Plan, dict[str, int]]]:
    """Plans in order, those last in which the hand is in much more of other objects than in the best one."""
    most = max(MUCH_MORE * min(map(_amount, ways), default=0), FEW_POINTS)
    return sorted(ways, key=lambda way: _amount(way) > most)


def _amount(way: tuple[Plan, Mapping[str, int]]) -> int:
    """In how many points of other objects the hand is."""
    return sum(way[1].values())
