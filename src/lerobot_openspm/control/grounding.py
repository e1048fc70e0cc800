"""Which of several like objects an instruction means, kept over an episode."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lerobot_openspm.control.spatial_relations import (
    choose,
    choose_as_shown,
    contradicts,
    is_far_from_shown,
)
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.language.descriptions import noun_phrase
from lerobot_openspm.memory.compose import Candidate
from lerobot_openspm.types import PoseEstimate, Reference

logger = logging.getLogger(__name__)

# Detections within 5 cm of a rejected instance are that instance.
SAME_PLACE_M = 0.05


def references(candidate: Candidate, object_meant: Callable[[str], str]) -> dict[str, Reference]:
    """By the name that an entry gives an object: where the instruction says that it is.

    Its landmarks go by the names under which they are known, which `object_meant` tells.
    """
    said: dict[str, Reference] = {}
    for asked, known in zip(candidate.asked, candidate.entry.key.sub_tasks, strict=True):
        told = ((known.target, asked.target_where), (known.landmark, asked.landmark_where))
        for name, where in told:
            if where is not None:
                said[name] = Reference(where.relation, tuple(map(object_meant, where.landmarks)))
    return said


def asked_of_both(candidates: Sequence[Candidate], *others: Sequence[Candidate]) -> frozenset[str]:
    """Names of the objects that a part of the instruction and another one ask the same of."""
    return frozenset(
        known.target
        for one in candidates
        for other in (one for part in others for one in part)
        for asked, known in zip(one.asked, one.entry.key.sub_tasks, strict=True)
        if asked in other.asked and not asked.words
    )


def demonstrations(
    candidates: Sequence[Candidate], object_meant: Callable[[str], str], known: Collection[str]
) -> dict[str, tuple[Mapping[str, Array], ...]]:
    """By the name of an object that is told by a landmark nobody knows: what shows which one is meant.

    Nobody knows where the table has its center, either.

    Args:
        candidates: What the instruction, or a part of it, can be carried out by.
        object_meant: Tells the name under which a thing is known.
        known: Names of all known objects but surfaces.

    Returns:
        Per demonstration that said the same of the object, poses ``T_world_obj`` ``(4, 4)`` by name at its
        start. No object whose landmarks are known: the words decide which one that is.
    """
    shown: dict[str, list[Mapping[str, Array]]] = {}
    for one in candidates:
        own = Candidate(one.entry, 1.0, (one.entry,), one.entry.key.sub_tasks)
        told, then = references(one, object_meant), references(own, object_meant)
        landmarks = {object_meant(asked.landmark) for asked in one.asked}
        for name, where in told.items():
            if then.get(name) == where and not set(where.landmarks) <= set(known):
                # What was put together has its landmark from the demonstration of the place.
                source = one.sources[-1 if name in landmarks else 0]
                shown.setdefault(name, []).append(source.object_poses)
    return {name: tuple(poses) for name, poses in shown.items()}


@dataclass
class Grounding:
    """Tells objects of one name apart, in one environment.

    Attributes:
        said: By name, where the instruction says that the object is.
        shown: By name, where demonstrations show what stood; for objects that their landmark cannot tell.
        surfaces: Landmarks that are as wide as the scene: nothing is far from them, and their center is
            where it was shown, else a guess.
        feet: By name, the middle ``(3,)`` of what an object stands on in its frame, metres; its frame's
            origin where it is not named.
        elsewhere: By name, in words, how the only one that the last look brought is not where it should be.
        not_meant: By name, poses ``T_world_obj`` ``(4, 4)`` of the others of its kind.
        several: Names of which the instruction is about several: any of them will do, each once.
        done: By such a name, poses ``T_world_obj`` ``(4, 4)`` of those that were seen to already.
        done_before: Likewise of those that were seen to for parts that asked for something else. They come
            last.
        named: Names of the objects of the parts so far.
        words: What the parts of the instruction say of where objects are.
        instances: By name, poses ``T_world_obj`` ``(4, 4)`` of all that were there when words without a
            landmark told them from each other, where they are now as far as that is known.
    """

    said: Mapping[str, Reference] = field(default_factory=dict[str, Reference])
    shown: Mapping[str, Sequence[Mapping[str, Array]]] = field(
        default_factory=dict[str, Sequence[Mapping[str, Array]]]
    )
    surfaces: frozenset[str] = frozenset()
    feet: Mapping[str, Array] = field(default_factory=dict[str, Array])
    elsewhere: dict[str, str] = field(default_factory=dict[str, str])
    not_meant: dict[str, tuple[Array, ...]] = field(default_factory=dict[str, tuple[Array, ...]])
    several: frozenset[str] = frozenset()
    done: dict[str, list[Array]] = field(default_factory=dict[str, list[Array]])
    done_before: dict[str, list[Array]] = field(default_factory=dict[str, list[Array]])
    named: frozenset[str] = frozenset()
    words: frozenset[tuple[str, Reference]] = frozenset()
    instances: dict[str, list[Array]] = field(default_factory=dict[str, list[Array]])
    _which: dict[tuple[str, Reference], int] = field(default_factory=dict[tuple[str, Reference], int])
    # By name, the instance that is meant since the words have changed, until it is seen.
    _due: dict[str, int] = field(default_factory=dict[str, int])
    _told: set[str] = field(default_factory=set[str])

    @property
    def landmarks(self) -> tuple[str, ...]:
        """The objects that others are told by, each once."""
        marks = [name for one in self.said.values() for name in one.landmarks]
        return tuple(dict.fromkeys([*marks, *(k for own in self.shown.values() for one in own for k in one)]))

    @property
    def told_apart(self) -> frozenset[str]:
        """Names of the objects that the instruction tells from others of their kind."""
        ahead = {name for name, where in self.words if not where.landmarks}
        return self.several | self.said.keys() | ahead

    def hear(
        self,
        said: Mapping[str, Reference],
        shown: Mapping[str, Sequence[Mapping[str, Array]]] | None = None,
        object_poses: Mapping[str, Array] | None = None,
    ) -> frozenset[str]:
        """Take in what a part of the instruction says; the names that mean another object from now on.

        Args:
            said: By name, where the instruction says that the object is.
            shown: As :func:`demonstrations` gives it.
            object_poses: Where those that were meant so far are by now, ``T_world_obj`` ``(4, 4)`` by name.
        """
        changed = frozenset(name for name in said.keys() & self.named if self.said.get(name) != said[name])
        left: Mapping[str, Array] = object_poses or {}
        for name in changed & left.keys() & self.said.keys():
            if (number := self._which.get((name, self.said[name]))) is not None:
                self.instances[name][number] = left[name]
        self.said = {**self.said, **said}
        kept = {name: one for name, one in self.shown.items() if name not in said}
        self.shown = {**kept, **(shown or {})}
        self.not_meant = {name: T for name, T in self.not_meant.items() if name not in changed}
        which = {name: self._which.get((name, said[name])) for name in changed}
        self._due = {name: number for name, number in which.items() if number is not None}
        self.several -= said.keys()
        self.named |= said.keys()
        self._told -= changed
        return changed

    def first_of(self, name: str, T_world_obj: Array | None) -> None:
        """Several are meant from now on, for something else than the one that was left at a pose."""
        if name in self.done and T_world_obj is not None:
            self.done[name].append(T_world_obj)
        self.done_before.setdefault(name, []).extend(self.done.pop(name, []))
        self.several |= {name}
        self.said = {other: said for other, said in self.said.items() if other != name}
        self._which = {key: number for key, number in self._which.items() if key[0] != name}
        for known in (self.not_meant, self.instances):
            known.pop(name, None)

    def next_of(self, name: str, T_world_obj: Array) -> None:
        """One of several has been seen to and is where it was left ``(4, 4)``; another one is meant now."""
        self.done.setdefault(name, []).append(T_world_obj)
        self.not_meant.pop(name, None)

    def sort_out(
        self,
        estimates: Mapping[str, PoseEstimate],
        object_poses: Mapping[str, Array],
        displaced: Collection[str] = (),
    ) -> dict[str, PoseEstimate]:
        """What was seen of the objects that are meant, given the poses of objects seen before.

        An object is told from its like once, when several are first seen; from then on those that are not
        meant are known by their places. One that cannot be told is ambiguous. The only one of its kind is
        the one that is meant, unless it plainly is not where that is said or was shown to be. What was
        displaced since the start tells nothing of where things were shown.
        """
        self.elsewhere = {}
        places = {name: one.T_world_obj for name, one in estimates.items() if one.status == "found"}
        known = {**places, **object_poses}
        still = {name: T for name, T in known.items() if name not in displaced}
        return {name: self._meant(name, one, known, still) for name, one in estimates.items()}

    def _meant(
        self, name: str, estimate: PoseEstimate, known: Mapping[str, Array], still: Mapping[str, Array]
    ) -> PoseEstimate:
        if name in self.not_meant:
            return self._unless_another(name, estimate, known)
        if name in self.several:
            return self._any(name, estimate)
        if name in self._due and estimate.status != "not_found":
            return self._due_one(name, estimate, known, still)
        if estimate.status == "not_found" or not estimate.others:
            return self._unless_elsewhere(name, estimate, known, still)
        candidates = (estimate.T_world_obj, *estimate.others)
        self._tell_apart(name, candidates)
        index = self._told_from(name, candidates, known, still)
        if index is None:
            where = self.said.get(name, "nothing")
            logger.info("cannot tell which of %d objects like the %r is meant: %s is said of it",
                        len(candidates), name, where)  # fmt: skip
            return replace(estimate, status="ambiguous")
        self.not_meant[name] = candidates[:index] + candidates[index + 1 :]
        return replace(estimate, status="found", T_world_obj=candidates[index], others=())

    def _any(self, name: str, estimate: PoseEstimate) -> PoseEstimate:
        """The first of several that was not seen to already, whose place tells it from now on."""
        if estimate.status == "not_found":
            return estimate
        done = self.done.get(name, [])
        places = (estimate.T_world_obj, *estimate.others)
        left = [T for T in places if not _is_one_of(T, done)]
        if not left:
            self.elsewhere[name] = "has been seen to already"
            return replace(estimate, status="not_found")
        left.sort(key=lambda T: _is_one_of(T, self.done_before.get(name, ())))
        self.not_meant[name] = (*done, *left[1:])
        return replace(estimate, status="found", T_world_obj=left[0], others=())

    def _due_one(
        self, name: str, estimate: PoseEstimate, known: Mapping[str, Array], still: Mapping[str, Array]
    ) -> PoseEstimate:
        """The one that the words meant when all were first seen. Where it has gone, none of the others."""
        places, candidates = self.instances[name], (estimate.T_world_obj, *estimate.others)
        own, others = places[self._due[name]], [T for i, T in enumerate(places) if i != self._due[name]]
        there = [T for T in candidates if _is_same_place(T, own)]
        left = there[:1] or [T for T in candidates if not _is_one_of(T, others)]
        if not left:
            self.elsewhere[name] = "is another one"
            return replace(estimate, status="not_found")
        index = 0 if len(left) == 1 else self._told_from(name, left, known, still)
        if index is None:
            return replace(estimate, status="ambiguous")
        del self._due[name]
        self.not_meant[name] = (*others, *(T for T in candidates if T is not left[index]))
        return replace(estimate, status="found", T_world_obj=left[index], others=())

    def _tell_apart(self, name: str, candidates: Sequence[Array]) -> None:
        """Settle which one each part means by words that need no landmark: later they stand otherwise."""
        if name in self.instances:
            return
        standing = [self._foot(name, T) for T in candidates]
        for said in (where for other, where in self.words if other == name and not where.landmarks):
            if (number := choose(said, standing, {})) is not None:
                self.instances[name] = list(candidates)
                self._which[name, said] = number

    def _told_from(
        self, name: str, candidates: Sequence[Array], known: Mapping[str, Array], still: Mapping[str, Array]
    ) -> int | None:
        """Which of several is meant: by the words, and where these do not tell by what was shown."""
        index, landmarks = None, {mark: T for mark, T in known.items() if mark != name}
        if (said := self.said.get(name)) is not None:
            standing = [self._foot(name, T) for T in candidates]
            marks = {**self._feet_of(landmarks), **self._shown_center(name, said)}
            index = choose(said, standing, marks)
        if index is None and name in self.shown:
            index = choose_as_shown(name, candidates, still, self.shown[name])
        return index

    def _shown_center(self, name: str, said: Reference) -> dict[str, Array]:
        """Where the center of the table is by demonstrations that say of an object that it stood there."""
        own = [self._foot(name, one[name]) for one in self.shown.get(name, ()) if name in one]
        if not own or said.relation != "center" or not set(said.landmarks) <= self.surfaces:
            return {}
        middle = np.median(np.stack(own)[:, :3, 3], axis=0)
        return dict.fromkeys(said.landmarks, se3.transform(np.eye(3), middle))

    def _unless_elsewhere(
        self, name: str, estimate: PoseEstimate, known: Mapping[str, Array], still: Mapping[str, Array]
    ) -> PoseEstimate:
        """The estimate of the only one, unless it is of another than is said, when it is first seen."""
        if estimate.status != "found" or name not in self.said or name in self._told:
            return estimate
        said, T_world_obj = self.said[name], estimate.T_world_obj
        landmarks = {k: T for k, T in known.items() if k != name and k not in self.surfaces}
        # The center of the table stays where it is, whatever else was shown beside the object.
        shown = () if self._shown_center(name, said) else self.shown.get(name, ())
        if contradicts(said, self._foot(name, T_world_obj), self._feet_of(landmarks)):
            self.elsewhere[name] = f"is not {said.relation} the {' and the '.join(said.landmarks)}"
        elif is_far_from_shown(name, T_world_obj, still, shown):
            self.elsewhere[name] = f"is far from where {noun_phrase(name, where=said)} was shown"
        else:
            self._told.add(name)
            return estimate
        return replace(estimate, status="not_found")

    def _unless_another(self, name: str, estimate: PoseEstimate, known: Mapping[str, Array]) -> PoseEstimate:
        """The estimate, unless it is of one that is not meant; then of what is left nearest to its place."""
        left = [T for T in (estimate.T_world_obj, *estimate.others) if not self._is_another(name, T)]
        if estimate.status == "not_found" or not left:
            return replace(estimate, status="not_found")
        if name in known:
            left.sort(key=lambda T: float(np.linalg.norm(T[:3, 3] - known[name][:3, 3])))
        status = "ambiguous" if len(left) > 1 and estimate.status == "ambiguous" else "found"
        return replace(estimate, status=status, T_world_obj=left[0], others=tuple(left[1:]))

    def _foot(self, name: str, T_world_obj: Array) -> Array:
        """The pose ``(4, 4)`` at the middle of what an object stands on."""
        return T_world_obj @ se3.transform(np.eye(3), self.feet[name]) if name in self.feet else T_world_obj

    def _feet_of(self, object_poses: Mapping[str, Array]) -> dict[str, Array]:
        return {name: self._foot(name, T) for name, T in object_poses.items()}

    def _is_another(self, name: str, T_world_obj: Array) -> bool:
        return _is_one_of(T_world_obj, self.not_meant[name])


def _is_one_of(T: Array, others: Sequence[Array]) -> bool:
    return any(_is_same_place(T, other) for other in others)


def _is_same_place(T: Array, other: Array) -> bool:
    return float(np.linalg.norm(T[:2, 3] - other[:2, 3])) < SAME_PLACE_M
