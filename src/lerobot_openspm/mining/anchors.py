"""Anchors by consensus: in the frame of which object does a key pose vary least over the demonstrations?"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.compose import sub_task_index
from lerobot_openspm.memory.entry import AXIS_KINDS, CONTACT_PHASES, WORLD, Anchor
from lerobot_openspm.mining.key_poses import KeyPose
from lerobot_openspm.types import SubTask

# An anchor other than the one that the instruction suggests must explain the demonstrations better by this
# much divided by their number: with one demonstration the instruction decides, with many the evidence does.
PRIOR_M = 0.05
# Likewise for axes other than the anchor's own.
AXES_PRIOR_M = 0.03
# The deviation of a good demonstration at its contacts is of this order.
QUALITY_SCALE_M = 0.02

# What is grasped firmly keeps the fingers apart. Closing by more than the first share of how far apart they
# were is slipping, and at the second one the grasp is nearly lost. Of what is thinner than the last share of
# the open gripper that tells nothing.
FIRM_SHARE, SLIPPED_SHARE, FELT_SHARE = 0.85, 0.5, 0.03

# Where the object that the instruction suggests for a contact was not found, another one is believed if so
# many demonstrations keep within this distance of one another in its frame, and not in the world's.
MIN_SUPPORTING, SUPPORTED_M = 3, 0.010

# Which contact a key pose belongs to, its phase, and its number among those with both the same.
Role = tuple[int, str, int]


@dataclass(frozen=True)
class Demonstration:
    """One episode, ready for the consensus.

    Attributes:
        key_poses: Its key poses, in order.
        object_poses: ``T_world_obj`` ``(4, 4)`` of every object found in its first frame.
    """

    key_poses: tuple[KeyPose, ...]
    object_poses: Mapping[str, Array]

    def in_frame(self, anchor: Anchor, pose: KeyPose) -> Array | None:
        """A key pose in an anchor's frame, ``T_anchor_ee`` ``(4, 4)``; None if an object was not found."""
        if any(name not in self.object_poses for name in anchor.objects):
            return None
        return se3.inverse(anchor.frame(self.object_poses)) @ pose.T_world_ee


def roles(key_poses: Sequence[KeyPose]) -> list[Role]:
    """The role of each key pose.

    Numbers count backwards (0 is the key pose nearest to the contact), so that an extra corner far away in
    one demonstration does not shift the others.
    """
    seen: Counter[tuple[int, str]] = Counter()
    backwards: list[Role] = []
    for pose in reversed(key_poses):
        backwards.append((pose.contact, pose.phase, seen[pose.contact, pose.phase]))
        seen[pose.contact, pose.phase] += 1
    return backwards[::-1]


def _is_turn(role: Role) -> bool:
    """Whether a push goes on there: the hand passes by, elsewhere in each demonstration."""
    return role[1] == "push" and role[2] > 0


def contact_roles(key_poses: Sequence[KeyPose]) -> frozenset[Role]:
    """The roles in which the hand touches something: contact phases, and where a push begins."""
    following = [pose.phase for pose in key_poses[1:]]
    return frozenset(
        role
        for role, after in zip(roles(key_poses), [*following, ""], strict=True)
        if role[1] in CONTACT_PHASES or after == "push"
    )


def sub_task_of(pose: KeyPose, sub_tasks: Sequence[SubTask]) -> SubTask:
    """The sub-task a key pose serves, see :func:`sub_task_index`."""
    return sub_tasks[sub_task_index(pose.contact, pose.phase, len(sub_tasks))]


def things_taken(key_poses: Sequence[KeyPose]) -> int:
    """How many things the hand took and let go, at least 1."""
    return 1 + max((sub_task_index(p.contact, p.phase, len(key_poses)) for p in key_poses), default=0)


def as_shown(sub_tasks: Sequence[SubTask], count: int) -> tuple[SubTask, ...]:
    """Sub-tasks with as many targets as the hand took, where the instruction is only kept by its words.

    "Set the table" does not say what is moved; the demonstrations show how many objects are. Each gets a name
    of its own, so that perception learns it from where the hand touched it.
    """
    told = sub_tasks[0]
    if not told.words:
        return tuple(sub_tasks)
    names = [told.target, *(f"{told.target} {i}" for i in range(2, count + 1))]
    return tuple(replace(told, target=name) for name in names)


def suggested_anchor(pose: KeyPose, sub_tasks: Sequence[SubTask]) -> str:
    """The object that the instruction suggests for a phase: what is grasped, or where it goes."""
    sub_task = sub_task_of(pose, sub_tasks)
    arriving = pose.phase in ("pre-place", "place", "release", "retreat", "push")
    # A landmark without a relation is only named: "clean the plate with the sponge".
    return sub_task.landmark if arriving and sub_task.relation else sub_task.target


def consensus(
    demonstrations: Sequence[Demonstration], sub_tasks: Sequence[SubTask], surfaces: Collection[str] = ()
) -> dict[Role, Anchor]:
    """Choose an anchor for every role of one task; none for a contact whose object is not known.

    Only objects that the sub-task names are candidates, because nothing looks for others when acting, and
    each sub-task is a part that can be done alone. A contact belongs to the object that the instruction
    suggests. If that was found in few demonstrations, the contact is anchored to another one only where the
    demonstrations show that it goes along with that. If it was found in half of them or more, the others say
    nothing against it.

    Args:
        demonstrations: The demonstrations of the task.
        sub_tasks: What its instruction says.
        surfaces: Names of what things stand on everywhere, such as the table: what is put there is put
            relative to whatever the demonstrations agree about.
    """
    gathered: dict[Role, list[tuple[KeyPose, Demonstration]]] = defaultdict(list)
    for demonstration in demonstrations:
        for role, pose in zip(roles(demonstration.key_poses), demonstration.key_poses, strict=True):
            gathered[role].append((pose, demonstration))
    touching = frozenset[Role]().union(*(contact_roles(one.key_poses) for one in demonstrations))
    anchors: dict[Role, Anchor] = {}
    for role, members in gathered.items():
        suggested, names = suggested_anchor(members[0][0], sub_tasks), _names(members[0][0], sub_tasks)
        candidates = [Anchor(place, axes) for place in names for axes in (place, WORLD, *names)]
        n_found = sum(suggested in demonstration.object_poses for _, demonstration in members)
        in_half = 2 * n_found >= len(members)
        is_free = role not in touching or suggested in surfaces or in_half
        expected = n_found if in_half and suggested not in surfaces else len(members)
        costs = {
            anchor: _cost(anchor, members, suggested, expected)
            for anchor in dict.fromkeys(candidates)
            if is_free or anchor.place == suggested or _goes_along(anchor, members)
        }
        best = min(costs, key=lambda anchor: costs[anchor])
        if np.isfinite(costs[best]):
            anchors[role] = best
    return anchors


def _names(pose: KeyPose, sub_tasks: Sequence[SubTask]) -> tuple[str, ...]:
    """The objects that a key pose can be relative to: its sub-task's; all, where only words are known."""
    own = [sub_task_of(pose, sub_tasks)]
    named = sub_tasks if sub_tasks[0].words else own
    return tuple(dict.fromkeys(name for sub_task in named for name in sub_task.objects))


def _cost(
    anchor: Anchor, members: Sequence[tuple[KeyPose, Demonstration]], suggested: str, expected: int
) -> float:
    """How much key poses of one role vary in an anchor's frame, in metres, plus the priors against it.

    That of the suggested object is expected to be known in so many of them, any other one in all.
    """
    placed = [demonstration.in_frame(anchor, pose) for pose, demonstration in members]
    found = [T for T in placed if T is not None]
    if not found:
        return np.inf
    prior = PRIOR_M * (anchor.place != suggested) + AXES_PRIOR_M * (anchor.axes != anchor.place)
    spread = float(np.median(deviations(np.stack(found))))
    lacking = (expected if anchor.place == suggested else len(members)) - len(found)
    return spread + prior / len(found) + PRIOR_M * lacking / len(members)


def _goes_along(anchor: Anchor, members: Sequence[tuple[KeyPose, Demonstration]]) -> bool:
    """Whether key poses of one role move with an anchor: alike in its frame, unlike in the world's."""
    pairs = [(demonstration.in_frame(anchor, pose), pose.T_world_ee) for pose, demonstration in members]
    found = [(T, T_world_ee) for T, T_world_ee in pairs if T is not None]
    if len(found) < MIN_SUPPORTING:
        return False
    in_frame, in_world = (deviations(np.stack(ones)) for ones in zip(*found, strict=True))
    return bool(np.percentile(in_frame, 75) <= SUPPORTED_M and np.median(in_world) > 2 * SUPPORTED_M)


def deviations(T_obj_ee: Array) -> Array:
    """Distance ``(n,)`` in metres of each pose from the medoid of all."""
    between = se3.distance(T_obj_ee[:, None], T_obj_ee[None])
    return between[int(np.argmin(between.sum(axis=1)))]


def align_symmetric(
    demonstrations: Sequence[Demonstration], yaw_periods: Mapping[str, float]
) -> list[Demonstration]:
    """Turn the frames of symmetric objects so that the demonstrations agree.

    Perception cannot tell such an object from itself turned by its period, so the choice may differ between
    demonstrations. All follow the first demonstration in which the object was found.
    """
    references: dict[str, Array] = {}
    aligned = []
    for demonstration in demonstrations:
        object_poses = dict(demonstration.object_poses)
        with_roles = zip(demonstration.key_poses, roles(demonstration.key_poses), strict=True)
        contacts = [
            p.T_world_ee for p, role in with_roles if p.phase in CONTACT_PHASES and not _is_turn(role)
        ]
        for name, T_world_obj in object_poses.items():
            equivalents = se3.yaw_equivalents(T_world_obj, yaw_periods.get(name, 2 * np.pi))
            if len(equivalents) == 1 or not contacts:
                continue
            relative = [se3.inverse(T) @ np.stack(contacts) for T in equivalents]
            reference = references.setdefault(name, relative[0])
            n = min(len(reference), len(contacts))
            # The closest match among the contacts decides.
            costs = [float(np.min(se3.distance(T_obj_ee[:n], reference[:n]))) for T_obj_ee in relative]
            object_poses[name] = equivalents[int(np.argmin(costs))]
        aligned.append(Demonstration(demonstration.key_poses, object_poses))
    return aligned


def qualities(demonstrations: Sequence[Demonstration], anchors: Mapping[Role, Anchor]) -> list[float]:
    """The paper's ``r`` of each demonstration: 1 where it agrees with the others at its contacts.

    Less where what it carried slipped in the fingers, see :func:`firmness`: it may slip out another time.
    """
    gathered: dict[Role, list[tuple[int, Array]]] = defaultdict(list)
    for i, demonstration in enumerate(demonstrations):
        for role, pose in zip(roles(demonstration.key_poses), demonstration.key_poses, strict=True):
            anchor = anchors.get(role)
            if anchor is None or pose.phase not in CONTACT_PHASES or _is_turn(role):
                continue
            if (T_obj_ee := demonstration.in_frame(anchor, pose)) is not None:
                gathered[role].append((i, T_obj_ee))
    worst = np.zeros(len(demonstrations))
    for members in gathered.values():
        distances = deviations(np.stack([T for _, T in members]))
        # Where most of them deviate, such as at the end of a push, a deviation is no fault.
        if np.median(distances) > QUALITY_SCALE_M:
            continue
        for (i, _), distance in zip(members, distances, strict=True):
            worst[i] = max(worst[i], distance)
    agreement = np.exp(-((worst / QUALITY_SCALE_M) ** 2))
    firm = [firmness(demonstration.key_poses) for demonstration in demonstrations]
    return [float(r) for r in agreement * firm]


def firmness(key_poses: Sequence[KeyPose]) -> float:
    """How firmly a demonstration held what it carried: 1 where it did not slip, 0 where it nearly fell."""
    least, around, widest = 1.0, 0.0, max((pose.opening for pose in key_poses), default=0.0)
    for i, pose in enumerate(key_poses):
        if pose.phase == "grasp":
            is_handle = any(after.phase in AXIS_KINDS for after in key_poses[i + 1 : i + 2])
            around = 0.0 if is_handle else pose.opening
        elif not pose.closed:
            around = 0.0
        elif around > FELT_SHARE * widest:
            least = min(least, pose.opening / around)
    return float(np.clip((least - SLIPPED_SHARE) / (FIRM_SHARE - SLIPPED_SHARE), 0.0, 1.0))
