"""New combinations: the grasp that one demonstration shows, and the place that another one does.

"put the wine bottle on the plate" was never shown. The bottle is grasped as it was for the cabinet, and goes
where the bowl went on the plate: what the bottle stands on takes the way that what the bowl stands on took.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, cycle, islice, zip_longest

import numpy as np

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.language.descriptions import phrase
from lerobot_openspm.language.lexicon import ENGLISH, Lexicon
from lerobot_openspm.memory.entry import (
    WORLD,
    Anchor,
    MemoryEntry,
    MemoryKeyPose,
    Outcome,
    RetrievalKey,
)
from lerobot_openspm.memory.looks import UNKNOWN_LOOKS, Looks
from lerobot_openspm.memory.retrieval import MIN_SEMANTIC
from lerobot_openspm.memory.rim_grasps import Part, Score, by_rim
from lerobot_openspm.memory.ways import Way, grasped, way_of
from lerobot_openspm.types import SubTask

# Of the pairs of demonstrations so many are put together, the best grasps and places first.
MAX_PAIRS = 12
# Two things whose undersides are seen at heights that differ by less than this stood on the same surface.
SAME_SURFACE_M = 0.025
# A hand that turns a thing by more than this on its way does not only carry it, radians.
MOST_TILT_RAD = 0.35
# In what is put together, a thing is somewhere by being put or by being pushed there.
MOVING = ("put", "push")


@dataclass(frozen=True)
class Combination:
    """An entry that was put together.

    Attributes:
        entry: What is executed.
        semantic: Its ``S_sem``, the lower one of the two.
        grasp: The entry that shows how its target is grasped.
        place: The entry that shows how something is put where it goes.
    """

    entry: MemoryEntry
    semantic: float
    grasp: MemoryEntry
    place: MemoryEntry


def combinations(
    asked: SubTask,
    parts: Sequence[Part],
    score: Score,
    looks: Looks = UNKNOWN_LOOKS,
    lexicon: Lexicon = ENGLISH,
) -> list[Combination]:
    """What can be put together for a sub-task that nothing shows as such.

    Args:
        asked: The sub-task.
        parts: Entries of one sub-task, each with the entry of the memory that it is a part of.
        score: Tells how well a sub-task that is known fits another one.
        looks: What is known of the objects.
        lexicon: Says which parts stand for the whole.

    Returns:
        Pairs of different demonstrations, the best first; none where the sub-task puts nothing anywhere.

    Raises:
        InstructionError: Its target was grasped, or something was put where it goes, but not both; or
            different things fit equally well.
    """
    if asked.operation not in MOVING or not asked.landmark:
        return []
    shown = [(part, source) for part, source in parts if part.key.sub_tasks[0].operation in MOVING]
    grasps = _best(shown, lambda known: score(asked, _going_as(asked, known)), _is_grasp, _target)
    places = _best(
        shown,
        lambda known: score(asked, _done_with(asked, known)),
        _is_place,
        lambda known: _place_name(known, lexicon),
    )
    if not grasps and not places:
        return []
    sag_m = 0.0
    if not grasps:
        grasps = _best(
            by_rim(asked, shown, score, MIN_SEMANTIC, looks),
            lambda known: score(asked, _going_as(asked, known)),
            _is_grasp,
            _target,
        )
        sag_m = max((_radius(part, looks) for part, _, _ in grasps), default=0.0)
    if not grasps:
        raise InstructionError(f"no demonstration takes hold of the {asked.target} to carry it")
    if not places:
        raise InstructionError(
            f"no demonstration puts anything {asked.relation} the {_place_name(asked, lexicon)}"
        )
    n_pairs = min(MAX_PAIRS, max(len(grasps), len(places)))
    found: list[Combination] = []
    for (grasp, own, a), (place, other, b) in islice(
        zip(cycle(grasps), cycle(places), strict=False), n_pairs
    ):
        entry = combined(grasp, place, looks, sag_m)
        if entry is not None:
            found.append(Combination(entry, min(a, b), own, other))
    return found


def _radius(part: MemoryEntry, looks: Looks) -> float:
    rim = looks.rim(part.key.sub_tasks[0].target)
    return 0.0 if rim is None else rim.radius


def _target(sub_task: SubTask) -> str:
    return sub_task.target


def _place_name(sub_task: SubTask, lexicon: Lexicon) -> str:
    part, landmark = sub_task.part, sub_task.landmark
    return f"{part} of the {landmark}" if part and part not in lexicon.silent_parts else landmark


def _going_as(asked: SubTask, known: SubTask) -> SubTask:
    """A known sub-task as if its target went where it is asked to go."""
    return replace(asked, target=known.target, target_where=known.target_where)


def _done_with(asked: SubTask, known: SubTask) -> SubTask:
    """A known sub-task as if it were done with what is asked for."""
    return replace(known, operation=asked.operation, target=asked.target, target_where=asked.target_where)


def _is_grasp(part: MemoryEntry) -> bool:
    """Whether it takes hold of its target, at a pose that is relative to nothing else."""
    if not _carries(part):
        return False
    index, _ = grasped(part)
    return set(part.key_poses[index].anchor.objects) == {part.key.sub_tasks[0].target}


def _carries(part: MemoryEntry) -> bool:
    target = part.key.sub_tasks[0].target
    return part.carried.get(0) == target and target in part.object_poses


def _is_place(part: MemoryEntry) -> bool:
    sub_task = part.key.sub_tasks[0]
    if not sub_task.landmark or not part.object_poses.keys() >= set(sub_task.objects):
        return False
    is_pushed = any(pose.phase == "push" for pose in part.key_poses)
    return bool(part.outcomes) if is_pushed else _carries(part) and _carries_level(part)


def _carries_level(part: MemoryEntry) -> bool:
    """Whether the hand puts down what it carries as it took it, but for a turn about the vertical."""
    T_grasp = grasped(part)[1]
    places = [part.demonstrated(pose) for pose in part.key_poses if pose.phase == "place"]
    upright = [(T[:3, :3] @ T_grasp[:3, :3].T)[2, 2] for T in places]
    return bool(places) and min(upright) > np.cos(MOST_TILT_RAD)


def _best(
    parts: Sequence[Part],
    score: Callable[[SubTask], float],
    is_usable: Callable[[MemoryEntry], bool],
    name: Callable[[SubTask], str],
) -> list[tuple[MemoryEntry, MemoryEntry, float]]:
    """The usable parts with the highest score, which all are about one thing; tasks take turns.

    Each task's own are ordered by quality, those that are no part of anything else first.
    """
    scored = [(part, source, score(part.key.sub_tasks[0])) for part, source in parts]
    usable = [one for one in scored if one[2] >= MIN_SEMANTIC and is_usable(one[0])]
    most = max((one[2] for one in usable), default=0.0)
    best = [one for one in usable if one[2] == most]
    names = sorted({name(part.key.sub_tasks[0]) for part, _, _ in best})
    if len(names) > 1:
        meant = " or the ".join(names)
        raise InstructionError(f"which one is meant, the {meant}? Each was shown; say it in these words")
    by_task: dict[tuple[SubTask, ...], list[tuple[MemoryEntry, MemoryEntry, float]]] = {}
    for one in sorted(best, key=lambda one: (len(one[1].key.sub_tasks), -one[0].quality)):
        by_task.setdefault(one[1].key.sub_tasks, []).append(one)
    return [one for one in chain.from_iterable(zip_longest(*by_task.values())) if one is not None]


def combined(
    grasp: MemoryEntry, place: MemoryEntry, looks: Looks = UNKNOWN_LOOKS, sag_m: float = 0.0
) -> MemoryEntry | None:
    """An entry that takes what one entry grasps to where another one puts something.

    The hand keeps the direction in which it grasped. Each key pose of the second entry is met by what the
    target stands on instead of what the other thing stands on.

    Args:
        grasp: How the target is grasped, an entry of one sub-task.
        place: How something is put or pushed to its landmark, an entry of one sub-task.
        looks: What is known of the objects.
        sag_m: How far the far side of the target may hang below its underside as it is carried, metres.

    Returns:
        None where both are about the same thing, which cannot stand on itself.
    """
    taken, put = grasp.key.sub_tasks[0], place.key.sub_tasks[0]
    if taken.target == put.landmark:
        return None
    sub_task = replace(put, operation="put", target=taken.target, target_where=taken.target_where)
    object_poses = {
        taken.target: grasp.object_poses[taken.target],
        put.landmark: place.object_poses[put.landmark],
    }
    index, T_grasp = grasped(grasp)
    stood, other_stood = _same_surface(grasp, place, looks)
    way = way_of(place, other_stood).higher(sag_m)
    placing = _placing(grasp.key_poses[index], T_grasp, T_grasp[:3, 3] - stood, way, object_poses, sub_task)
    key_poses = (*_taking(grasp, index, way.rise_m), *placing)
    outcome = _outcome(sub_task, way, place, looks)
    return MemoryEntry(
        key=RetrievalKey((sub_task,), tuple(pose.phase for pose in key_poses)),
        language=phrase(sub_task),
        key_poses=key_poses,
        quality=min(grasp.quality, place.quality),
        version=1,
        source=f"{grasp.source} and {place.source}",
        object_poses=object_poses,
        outcomes=(outcome,),
    )


def _same_surface(grasp: MemoryEntry, place: MemoryEntry, looks: Looks) -> tuple[Array, Array]:
    """Where the targets of two entries stand ``(3,)`` in the world, at one height if that may be.

    Cameras hardly see the underside of a thing. On one table two things stand at the same height.
    """
    stood = [_stands(one, looks) for one in (grasp, place)]
    heights = [float(where[2]) for where in stood]
    is_known = all(one.key.sub_tasks[0].target in looks.points for one in (grasp, place))
    if not is_known or abs(heights[0] - heights[1]) < SAME_SURFACE_M:
        for where in stood:
            where[2] = min(heights)
    return stood[0], stood[1]


def _stands(entry: MemoryEntry, looks: Looks) -> Array:
    target = entry.key.sub_tasks[0].target
    return se3.apply(entry.object_poses[target], looks.underside(target)[None])[0]


def _taking(grasp: MemoryEntry, index: int, rise_m: float) -> Iterable[MemoryKeyPose]:
    """The key poses that take hold of the target and lift it, at least by so many metres."""
    target, T_grasp = grasp.key.sub_tasks[0].target, grasped(grasp)[1]
    own = [pose for pose in grasp.key_poses if set(pose.anchor.objects) == {target}]
    yield from (pose for pose in grasp.key_poses[: index + 1] if set(pose.anchor.objects) == {target})
    lifts = [pose for pose in own if pose.phase == "lift"]
    if not lifts:
        lifts = [replace(grasp.key_poses[index], phase="lift", dwell=False, n_steps=1)]
    missing_m = max(rise_m - (grasp.demonstrated(lifts[-1])[2, 3] - T_grasp[2, 3]), 0.0)
    higher = se3.from_yaw(np.array([0.0, 0.0, missing_m]), 0.0)
    yield from lifts[:-1]
    # Frames are upright.
    yield replace(lifts[-1], T_obj_ee=higher @ lifts[-1].T_obj_ee)


def _placing(
    taken: MemoryKeyPose,
    T_grasp: Array,
    above: Array,
    way: Way,
    object_poses: Mapping[str, Array],
    sub_task: SubTask,
) -> list[MemoryKeyPose]:
    """The key poses of a way, for a hand that is at `above` ``(3,)`` from the target's underside."""
    anchor = Anchor(sub_task.landmark, sub_task.target)
    T_anchor_world = se3.inverse(anchor.frame(object_poses))
    return [
        replace(
            pose,
            anchor=anchor,
            T_obj_ee=T_anchor_world @ se3.transform(T_grasp[:3, :3], point + above),
            opening=taken.opening if pose.closed else pose.opening,
            confidence=min(taken.confidence, pose.confidence),
            sub_task=0,
            covariance=None,
        )
        for pose, point in zip(way.poses, way.points, strict=True)
    ]


def _outcome(sub_task: SubTask, way: Way, place: MemoryEntry, looks: Looks) -> Outcome:
    """Where the target ends: standing where the other thing stood."""
    underside = looks.underside(sub_task.target)
    end = way.points[-1] - [0.0, 0.0, underside[2]]
    known = next(iter(place.outcomes), None)
    anchor = Anchor(sub_task.landmark, WORLD) if known is None else known.anchor
    shown = se3.apply(se3.inverse(anchor.frame(place.object_poses)), end[None])[0]
    tolerance_m = 0.0 if known is None else known.tolerance_m
    middle = float(underside[0]), float(underside[1])
    return Outcome(0, sub_task.target, anchor, shown, shown, max(tolerance_m, SAME_SURFACE_M), middle)
