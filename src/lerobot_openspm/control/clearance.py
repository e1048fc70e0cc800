"""Clear of what stands about: the hand is lifted over it, and what it would be in at a key pose is told.

Key poses say where the hand has to be, not how it gets there; on the way it goes nearly straight. Where other
objects stand elsewhere than in the demonstration, one may be in the way, and so may a large one that the hand
leaves or goes to from another side. Then the hand first rises, crosses above it and comes down: two more key
poses, of the same objects as those before and after. This is the paper's check of the minimum distance, for
objects.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree  # pyright: ignore[reportMissingTypeStubs]

from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MAX_FALL_M, MemoryEntry, MemoryKeyPose

# Phases that cross free space.
CROSSING = ("approach", "pre-place")
# The hand comes down where it points down, by the cosine of its lean; otherwise it goes as it was shown.
UPRIGHT = 0.9
# A way shorter than this, horizontally, crosses nothing, metres.
SHORTEST_M = 0.03
# The hand stays this far above what it crosses, metres, ...
CLEARANCE_M = 0.03
# ... and in the middle of a way as much higher as this share of its length: it goes up to that far below the
# straight way.
SAG_SHARE = 0.1
# It passes beside what stands about at this many times its radius: a hand is wider across its fingers than on
# average.
BESIDE = 1.5
# What is put down comes straight down over this height, metres. What is this near to it, seen from above, is
# in its way.
FROM_ABOVE_M, OVER_M = 0.35, 0.02
# So many places of a way are compared with what stands about.
STEPS = 25
# Where the fingers close and open, the hand is beside objects.
FINGERS_MOVE = ("grasp", "release")
# Palm and fingers in the hand's frame, which is between the fingertips: half their length along x and y as
# shares of the hand's radius, and from where to where they reach along z, metres. Fingers open along y.
PARTS = ((0.45, 1.35, -0.16, -0.05), (0.2, 0.75, -0.05, -0.01))
# Fewer points of an object than this inside the hand are noise, and what is this near to what is grasped,
# metres, is the same thing by another name; also at a place, if it is as large but for so much.
NOISE_POINTS, SAME_THING_M, SAME_SIZE_M = 5, 0.02, 0.04
# A place is taken where the middle of something else is at most this far beside it, metres.
TAKEN_M = 0.03
# Two things of a kind cannot stand closer together than this, as far as is known, metres.
ALIKE_M = 0.05


@dataclass(frozen=True)
class Way:
    """The nearly straight way of the hand to a key pose.

    Attributes:
        start: Where the fingertips are ``(3,)``, world.
        goal: Where they go ``(3,)``.
        below: How far what is in the hand reaches below them, metres.
        is_empty: Whether nothing is in it.
    """

    start: Array
    goal: Array
    below: float
    is_empty: bool = False

    @property
    def length(self) -> float:
        """How far it goes, horizontally, metres."""
        return float(np.linalg.norm((self.goal - self.start)[:2]))

    def crossing(self, points: Mapping[str, Array], radius: float) -> tuple[float, list[str]]:
        """How high the fingertips have to cross what stands about, world z, and what of it is in the way.

        The height is minus infinity where nothing is. See :meth:`height_over`.
        """
        names = [name for name, own in points.items() if self.height_over(own, radius) is not None]
        height = self.height_over(np.concatenate(list(points.values())), radius) if names else None
        return (-np.inf if height is None else height), names

    def height_over(self, points: Array, radius: float) -> float | None:
        """How high the fingertips have to cross points ``(n, 3)``, world z; None if the way is clear.

        Args:
            points: What stands about.
            radius: Of the hand, and what it carries, with room beside it, metres.
        """
        share = np.linspace(0, 1, STEPS)[:, None]
        places = self.start + share * (self.goal - self.start)
        apart = np.linalg.norm(points[None, :, :2] - places[:, None, :2], axis=-1)
        is_left = self._leaves(points)
        is_under = apart < np.where(is_left, radius / BESIDE, radius)
        sag = SAG_SHARE * self.length * 4 * share * (1 - share)
        needed = points[None, :, 2] + np.where(is_left, 0.0, sag + self.below + CLEARANCE_M)
        if not (is_under & (needed > places[:, None, 2])).any():
            return None
        return float(needed[is_under].max())

    def _leaves(self, points: Array) -> NDArray[np.bool_]:
        """Which of points ``(n, 3)`` an empty hand has behind it as it sets out: it needs no room there."""
        is_behind = (points - self.start)[:, :2] @ (self.goal - self.start)[:2] <= 0
        return is_behind & self.is_empty

    def between(self, points: Array, radius: float) -> Array:
        """Those of points ``(n, 3)`` that are neither near its start nor near its goal, seen from above."""
        ends = np.stack([self.start, self.goal])[:, None, :2]
        apart = np.linalg.norm(points[None, :, :2] - ends, axis=-1)
        return points[(apart > radius).all(0)]


@dataclass
class Standing:
    """Where objects stand as key poses are passed.

    Attributes:
        points: Points ``(n, 3)`` in the world by name; not of what was pushed, since where that ends is not
            known by its points.
        grasped: What was grasped last; the hand is right beside it, also when it has let go of it.
        is_held: Whether it is still in the hand.
        T_world_grasp: Where the hand took hold of it ``(4, 4)``.
    """

    points: dict[str, Array]
    grasped: str = ""
    is_held: bool = False
    T_world_grasp: Array = field(default_factory=lambda: np.eye(4))

    def pass_by(self, pose: MemoryKeyPose, T_world_ee: Array, entry: MemoryEntry) -> None:
        """Take in that a key pose of an entry was met, with the hand at ``T_world_ee`` ``(4, 4)``."""
        own = [other.phase for other in entry.key_poses if other.sub_task == pose.sub_task]
        is_handle = "open" in own or "turn" in own
        if pose.phase == "grasp" and is_handle:
            self.grasped, self.is_held = pose.anchor.place, False
        elif pose.phase == "grasp":
            self.grasped, self.is_held, self.T_world_grasp = pose.anchor.place, True, T_world_ee
        elif pose.phase == "release" and self.is_held:
            self.is_held = False
            if self.grasped in self.points:  # it stands where the hand let go of it
                T = T_world_ee @ se3.inverse(self.T_world_grasp)
                self.points[self.grasped] = se3.apply(T, self.points[self.grasped])
        elif pose.phase == "push":
            self.points.pop(entry.key.sub_tasks[pose.sub_task].target, None)


def lifted(
    entry: MemoryEntry,
    targets: Sequence[Target],
    T_world_ee: Array,
    points: Mapping[str, Array],
    radius: float,
    usual: Collection[str] = (),
) -> tuple[MemoryEntry, list[str]]:
    """An entry with further key poses where its ways run into what stands about, and what that is.

    A way between objects that stand as they always did was shown, and with it that what stands as ever is
    not in the way.

    Args:
        entry: What is to be executed.
        targets: Its key poses in the scene, at least as many as it has.
        T_world_ee: Where the hand is ``(4, 4)``.
        points: Points ``(n, 3)`` in the world of the objects that were found, by name.
        radius: Of the hand, metres.
        usual: The objects that stand where they did in all demonstrations.
    """
    poses: list[MemoryKeyPose] = []
    crossed: dict[str, None] = {}
    standing, before = Standing(dict(points)), T_world_ee
    for i, (pose, target) in enumerate(zip(entry.key_poses, targets, strict=False)):
        T, grasped = target.T_world_ee, standing.grasped
        below = _below(standing.T_world_grasp, standing.points.get(grasped)) if standing.is_held else 0.0
        way = Way(before[:3, 3], T[:3, 3], below, is_empty=not standing.is_held)
        if -T[2, 2] > UPRIGHT and pose.phase in CROSSING and way.length > SHORTEST_M:
            previous = entry.key_poses[i - 1] if i else None
            near = {grasped, *pose.anchor.objects, *(previous.anchor.objects if previous else ())}
            is_shown = previous and previous.sub_task == pose.sub_task and near - {""} <= set(usual)
            left_out = {grasped if standing.is_held else "", *(usual if is_shown else ())}
            others = {
                name: way.between(own, BESIDE * radius) if name in near else own
                for name, own in standing.points.items()
                if name not in left_out
            }
            height, names = way.crossing(others, BESIDE * radius)
            if height > way.start[2]:
                rise = height - way.start[2]
                poses.append(_above(previous, rise, pose) if previous else _risen(pose, T, way.start, rise))
            if height > way.goal[2]:
                poses.append(_raised(pose, height - way.goal[2]))
            crossed |= dict.fromkeys(names)
        poses.append(pose)
        standing.pass_by(pose, T, entry)
        before = T
    return replace(entry, key_poses=tuple(poses)), list(crossed)


def crowding(
    entry: MemoryEntry, targets: Sequence[Target], points: Mapping[str, Array], radius: float
) -> dict[str, int]:
    """How many points of other objects are inside the hand where it takes hold and lets go.

    Also those that what it carries comes down through, where it is put.

    Args:
        entry: What is to be executed.
        targets: Its key poses in the scene.
        points: Points ``(n, 3)`` in the world of the objects that were found, by name.
        radius: Of the hand, metres.

    Returns:
        Numbers by name, of those that have more than noise.
    """
    found: dict[str, int] = {}
    standing = Standing(dict(points))
    for pose, T in ((target.key_pose, target.T_world_ee) for target in targets):
        if pose.phase in FINGERS_MOVE:
            grasped = pose.anchor.place if pose.phase == "grasp" else standing.grasped
            near = {grasped, *pose.anchor.objects}
            own = standing.points.get(grasped)
            for name in standing.points.keys() - near:
                other = standing.points[name]
                if own is not None and np.linalg.norm(other.mean(0) - own.mean(0)) < SAME_THING_M:
                    continue
                inside = int(_inside(se3.apply(se3.inverse(T), other), radius).sum())
                if own is not None and standing.is_held and pose.phase == "release" and -T[2, 2] > UPRIGHT:
                    down = se3.apply(T @ se3.inverse(standing.T_world_grasp), own)
                    inside += int(_over(down, other).sum())
                found[name] = found.get(name, 0) + inside
        standing.pass_by(pose, T, entry)
    return {name: found[name] for name in points if found.get(name, 0) >= NOISE_POINTS}


def taken(
    entry: MemoryEntry,
    targets: Sequence[Target],
    now: Mapping[str, Array],
    points: Mapping[str, Array],
    alike: Mapping[str, Sequence[Array]] | None = None,
) -> list[str]:
    """Places that something is put on where something else stands already, in words.

    In what something is put into, things may lie upon one another.

    Args:
        entry: What is to be executed.
        targets: Its key poses in the scene.
        now: Poses ``T_world_obj`` ``(4, 4)`` of the objects that were found.
        points: Points ``(n, 3)`` in the world of those whose shape is known, by name.
        alike: By name, poses ``T_world_obj`` ``(4, 4)`` of others of a kind.
    """
    needed = {name for target in targets for name in target.key_pose.anchor.objects}
    own = [points[name] for name in needed & points.keys()]
    others = {
        name: points[name]
        for name in sorted(points.keys() - needed)
        if not any(_is_same_thing(points[name], one) for one in own)
    }
    found: list[str] = []
    grasp: Target | None = None
    for target in targets:
        phase, place = target.key_pose.phase, target.key_pose.anchor.place
        grasp = target if phase == "grasp" else grasp
        load = "" if grasp is None else grasp.key_pose.anchor.place
        if phase != "release" or grasp is None or load == place or load not in now:
            continue
        if entry.key.sub_tasks[target.key_pose.sub_task].relation == "in":
            continue
        T_moved = target.T_world_ee @ se3.inverse(grasp.T_world_ee)
        T_end = T_moved @ now[load]
        if any(_stands_at(T_end[:3, 3], T[:3, 3], ALIKE_M) for T in (alike or {}).get(load, ())):
            found.append(f"the {place} is taken: another {load} stands there")
        elif load in points:
            end = se3.apply(T_moved, points[load]).mean(0)
            for name, other in others.items():
                if _stands_at(end, other.mean(0), TAKEN_M):
                    found.append(f"the {place} is taken: the {name} stands where the {load} would")
    return found


def _is_same_thing(points: Array, other: Array) -> bool:
    """Whether points ``(n, 3)`` and ``(m, 3)`` are of one thing with two names, by place and size."""
    apart = float(np.linalg.norm(points.mean(0) - other.mean(0)))
    return apart <= SAME_THING_M and bool((np.abs(np.ptp(points, 0) - np.ptp(other, 0)) <= SAME_SIZE_M).all())


def _stands_at(point: Array, other: Array, metres: float) -> bool:
    """Whether a point ``(3,)`` is so near to another one, seen from above, and about as high."""
    off = point - other
    return bool(np.hypot(*off[:2]) <= metres and abs(off[2]) <= MAX_FALL_M)


def _inside(points: Array, radius: float) -> NDArray[np.bool_]:
    """Which points ``(n, 3)`` in the hand's frame are inside it."""
    x, y, z = np.abs(points[:, 0]), np.abs(points[:, 1]), points[:, 2]
    parts = [(x < a * radius) & (y < b * radius) & (z > low) & (z < high) for a, b, low, high in PARTS]
    return np.any(parts, axis=0)


def _over(load: Array, points: Array) -> NDArray[np.bool_]:
    """Which points ``(n, 3)`` are in the way of a load ``(m, 3)`` that comes down to where it is put."""
    height = points[:, 2] - load[:, 2].min()
    low, high = load[:, :2].min(0) - OVER_M, load[:, :2].max(0) + OVER_M
    over = (height > CLEARANCE_M) & (height < FROM_ABOVE_M)
    over &= ((points[:, :2] > low) & (points[:, :2] < high)).all(1)
    tree: Any = KDTree(load[:, :2])
    over[over] = tree.query(points[over, :2])[0] < OVER_M
    return over


def _raised(pose: MemoryKeyPose, rise: float) -> MemoryKeyPose:
    """A key pose that is passed by, above another one."""
    T = se3.transform(pose.T_obj_ee[:3, :3], pose.T_obj_ee[:3, 3] + [0.0, 0.0, rise])
    return replace(pose, T_obj_ee=T, n_steps=1, dwell=False, axis=None, covariance=None)


def _above(previous: MemoryKeyPose, rise: float, towards: MemoryKeyPose) -> MemoryKeyPose:
    """A key pose above one that the hand leaves for another.

    It goes where that one goes, by its sub-task and its object. A hand that is done there retreats.
    """
    is_done = previous.sub_task != towards.sub_task or previous.phase == "retreat"
    return replace(
        _raised(previous, rise),
        phase="retreat" if is_done else towards.phase,
        closed=towards.closed,
        opening=towards.opening,
        confidence=towards.confidence,
    )


def _risen(first: MemoryKeyPose, T_world_ee: Array, start: Array, rise: float) -> MemoryKeyPose:
    """A key pose above the place ``(3,)`` where the hand begins, turned as at its first one ``(4, 4)``."""
    R_world_anchor = T_world_ee[:3, :3] @ first.T_obj_ee[:3, :3].T
    away = start + np.array([0.0, 0.0, rise]) - T_world_ee[:3, 3]
    T = se3.transform(first.T_obj_ee[:3, :3], first.T_obj_ee[:3, 3] + R_world_anchor.T @ away)
    return replace(first, T_obj_ee=T, n_steps=1, dwell=False, axis=None, covariance=None)


def _below(T_world_ee: Array, points: Array | None) -> float:
    """How far an object that is grasped here reaches below the fingertips, metres."""
    return 0.0 if points is None else max(0.0, float(T_world_ee[2, 3] - points[:, 2].min()))
