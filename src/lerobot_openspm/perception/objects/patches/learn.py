"""Learning objects that hardly move between demonstrations: which patches follow which object.

Which camera shows an object well, where on it a patch finds hold and how large it should be is not known: a
large one follows the table, one on a bottle's neck slides along it. So patches of all kinds are cut around
the places that the hand touched, and each is followed through the first frames of many demonstrations, also
of other tasks. What really follows the object is followed alike by patches of several kinds, a *group*;
tracks that belong to other objects disagree. Where the hand touched a place of the object more than once,
where it went has to agree; and two objects do not move alike, so a group belongs to one object alone. One
demonstration of each of several tasks is enough.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import cv2
import numpy as np

from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import Examples, Kind, KnownObject, Look
from lerobot_openspm.perception.objects.patches.match import Patch, Probe, as_seen, cut, match
from lerobot_openspm.perception.objects.patches.model import PatchModel, from_record
from lerobot_openspm.perception.objects.patches.stillness import LIKELY, hardly_moving, often_at, places_of
from lerobot_openspm.types import ContactCue, DemonstrationScene, View

# A place touched less often says nothing of how far its object moves.
MIN_TOUCHES = 2
RADII_M = (0.025, 0.035, 0.05, 0.07, 0.10)
# What holds a patch may lie below the hand, which grasps a bottle's neck or lets go of something above.
DROPS_M = (0.0, 0.05, 0.10)
# So many first frames are looked at, as far as there are, at least half of them of the object's own tasks.
MAX_SCENES = 40
# Less alike than this in most demonstrations: the object turns, or is not what the patch shows.
LEARNED_CORRELATION = 0.8
# Less alike than this: the object is not in the scene, or hidden.
SEEN_CORRELATION = 0.6
# A patch is followed if it is found in this share of the first frames, and in nearly as many as the best is.
FOLLOWED_SHARE, COVERAGE = 0.5, 0.9
# Patches that follow one object agree within this, and it takes so many to be believed.
AGREEMENT_M, MIN_AGREEING = 0.0025, 3
# A group has to explain this much of where the hand went, unless it went to about the same place every time.
EXPLAINED_SHARE, STILL_M = 0.8, 0.006
# It may explain it so much worse than the group that does best.
RESIDUAL_RATIO = 1.3
# Without touches to ask, a group must move by more than passes for agreement, or it may be the table, and
# be seen in this many scenes.
MIN_SCENES = 6
# Two motions that differ by less than this share of either are those of one object.
SAME_MOTION_SHARE = 0.3
# An object that turns looks more like its turned patch, by this much, in more than this share of the scenes.
TURN_DEG, TURN_GAIN, TURN_SHARE = 10.0, 0.01, 0.25
REFERENCES = 5
MAX_PROBES = 4
# Why an object that hardly moves could not be learned.
UNFOLLOWED = "nothing where the hand touched it looks alike in its other demonstrations"
ELSEWHERE = "what moves where the hand touched it turns, or is another object"
MIN_STD_M = 5e-4


@dataclass(frozen=True)
class _Trail:
    """One patch, followed through the first frames.

    Attributes:
        place: Number of the touched place that it was cut at.
        radius: Its size.
        scene: Number of the scene that it was cut from.
        probe: The patch with its camera.
        points: Where its point is in each scene ``(n, 2)``; not a number where it was not found.
        correlation: Its median.
    """

    place: int
    radius: float
    scene: int
    probe: Probe
    points: Array
    correlation: float

    @property
    def seen(self) -> int:
        """In how many scenes the patch was found."""
        return int(np.isfinite(self.points[:, 0]).sum())

    @cached_property
    def motion(self) -> Array:
        """Displacements ``(n, 2)`` from the median place."""
        return self.points - np.nanmedian(self.points, axis=0)


@dataclass(frozen=True)
class _Candidate:
    """An object to learn: the scenes looked at, and its groups in them, the largest first."""

    name: str
    scenes: Sequence[DemonstrationScene]
    groups: list[list[_Trail]]


def learn_patches(examples: Examples) -> dict[str, PatchModel]:
    """Learn the objects that hardly move; where a segmenter finds the objects, none."""
    return _learn(dict.fromkeys(still_objects(examples), examples.scenes), examples, {})


def learn_at_one_place(examples: Examples, learned: Mapping[str, PatchModel]) -> dict[str, PatchModel]:
    """Learn what tasks begin with at a few places, each where it is shown most often.

    Args:
        examples: The demonstrations, and the objects to learn.
        learned: What is followed in all demonstrations.
    """
    left = [name for name in examples.names if name not in learned]
    return _learn({name: _often(name, examples) for name in left}, examples, learned)


def _learn(
    shown: Mapping[str, Sequence[DemonstrationScene]], examples: Examples, known: Mapping[str, PatchModel]
) -> dict[str, PatchModel]:
    """Learn objects, each from the scenes that show it; not what follows an object that is known."""
    if examples.segmenter is not None:
        return {}
    candidates = [_candidate(name, scenes) for name, scenes in shown.items() if scenes]
    # What many patches agree on is claimed first: what they follow is not another object.
    candidates.sort(key=lambda one: -max((len(group) for group in one.groups), default=0))
    learned: dict[str, PatchModel] = {}
    for one in candidates:
        claimants = [*examples.known, *known.values(), *learned.values()]
        free = (group for group in one.groups if not _claimed(group[0], one.scenes, claimants))
        models = (_model(one.name, group, one.scenes) for group in free)
        if model := next((model for model in models if model is not None), None):
            learned[one.name] = model
        else:
            examples.leave_out(one.name, ELSEWHERE if one.groups else UNFOLLOWED)
    return learned


def still_objects(examples: Examples) -> list[str]:
    """Those of the objects that hardly move between all demonstrations."""
    still = hardly_moving(examples.names, examples.scenes, examples.known)
    return [name for name in examples.names if still[name] >= LIKELY]


def _often(name: str, examples: Examples) -> list[DemonstrationScene]:
    """The demonstrations of an object where it is shown most often, and those that do not touch it."""
    often = often_at(name, examples.scenes)
    others = [scene for scene in examples.scenes if all(cue.name != name for cue in scene.cues)]
    return [*often, *others] if often else []


# What hardly moves is learned with its surface, which calls learn_patches; here nothing is left to learn.
PATCHES = Kind(PatchModel.kind, lambda _: {}, from_record)


def _candidate(name: str, scenes: Sequence[DemonstrationScene]) -> _Candidate:
    """Follow patches of all kinds at an object's touched places, and group those that agree."""
    own = [scene for scene in scenes if any(cue.name == name for cue in scene.cues)]
    others = [scene for scene in scenes if not any(cue.name == name for cue in scene.cues)]
    own = _spaced(own, max(MAX_SCENES // 2, MAX_SCENES - len(others)))
    looked_at = own + _spaced(others, MAX_SCENES - len(own))
    cues = [next(cue for cue in scene.cues if cue.name == name) for scene in own]
    trails: list[_Trail] = []
    for number, place in enumerate(places_of(cues)):
        first = next(i for i, cue in enumerate(cues) if cue is place[0])
        for camera in own[first].views:
            for drop in DROPS_M:
                points = cues[first].point_world - [0.0, 0.0, drop]
                found = (_follow(number, first, camera, points, radius, looked_at) for radius in RADII_M)
                trails += [one for one in found if one is not None and _is_seen_at_all_places(one, cues)]
    return _Candidate(name, looked_at, _believable(_agreeing(trails), cues))


def _spaced[T](things: Sequence[T], n: int) -> list[T]:
    """At most ``n`` things, evenly from all."""
    chosen = np.linspace(0, len(things) - 1, min(n, len(things))).round().astype(int)
    return [things[i] for i in chosen]


def _follow(
    place: int,
    first: int,
    camera: str,
    point_world: Array,
    radius: float,
    scenes: Sequence[DemonstrationScene],
) -> _Trail | None:
    """Cut a patch from one scene and find it in all; None where it is in too few."""
    view = scenes[first].views[camera]
    patch = cut(view, point_world, radius)
    if patch is None:
        return None
    probe = Probe(camera, view.camera, view.T_world_cam, (patch,), 0.0)
    points, correlations = np.full((len(scenes), 2), np.nan), np.zeros(len(scenes))
    for i, scene in enumerate(scenes):
        seen = as_seen(scene.views.get(camera), probe)
        sight = None if seen is None else match(patch, probe, seen)
        if sight is not None and sight.correlation > SEEN_CORRELATION:
            points[i], correlations[i] = sight.point_world[:2], sight.correlation
    if np.isfinite(points[:, 0]).mean() < FOLLOWED_SHARE or np.median(correlations) < LEARNED_CORRELATION:
        return None
    return _Trail(place, radius, first, probe, points, float(np.median(correlations)))


def _is_seen_at_all_places(trail: _Trail, cues: Sequence[ContactCue]) -> bool:
    """Whether a patch is found where each place was touched: tasks may begin with an object elsewhere."""
    seen = np.isfinite(trail.points[: len(cues), 0])
    places = [place for place in places_of(cues) if len(place) >= MIN_TOUCHES]
    own = [[any(cue is one for one in place) for cue in cues] for place in places]
    return all(seen[mask].mean() >= FOLLOWED_SHARE for mask in own)


def _agreeing(trails: Sequence[_Trail]) -> list[list[_Trail]]:
    """Groups of trails that agree, the largest first, each with its most typical first."""
    if not trails:
        return []
    most = max(trail.seen for trail in trails)
    trails = [trail for trail in trails if trail.seen >= COVERAGE * most]
    between = np.stack([[_difference(a.motion, b.motion) for b in trails] for a in trails])
    agree, groups = between < AGREEMENT_M, []
    while agree.any():
        members = np.flatnonzero(agree[int(agree.sum(axis=1).argmax())])
        agreed = _agreed([trails[i] for i in members])
        groups.append(sorted((trails[i] for i in members), key=lambda one: _difference(one.motion, agreed)))
        agree[members], agree[:, members] = False, False
    return groups


def _agreed(trails: Sequence[_Trail]) -> Array:
    """The median motion ``(n, 2)`` of trails; not a number in scenes where none was found."""
    motions = np.ma.masked_invalid(np.stack([trail.motion for trail in trails]))
    return np.asarray(np.ma.median(motions, axis=0).filled(np.nan))


def _difference(motion: Array, other: Array) -> float:
    """Distance between two motions ``(n, 2)`` but for an offset, kept in three of four scenes, metres.

    Infinite where few scenes show both.
    """
    apart = (motion - other)[np.isfinite(motion[:, 0]) & np.isfinite(other[:, 0])]
    if len(apart) < FOLLOWED_SHARE * len(motion):
        return np.inf
    return float(np.percentile(np.linalg.norm(apart - np.median(apart, axis=0), axis=1), 75))


def _believable(groups: Sequence[list[_Trail]], cues: Sequence[ContactCue]) -> list[list[_Trail]]:
    """The groups that are large enough and agree with where the hand went, or else, untold, move at all."""
    large = [group for group in groups if len(group) >= MIN_AGREEING]
    places = [place for place in places_of(cues) if len(place) >= MIN_TOUCHES]
    if not places:
        return [group for group in large if _moves(group[0])]
    residuals = [_residual(group[0].points, cues, places) for group in large]
    still = _residual(np.zeros((len(cues), 2)), cues, places)
    bound = min(max(EXPLAINED_SHARE * still, STILL_M), RESIDUAL_RATIO * min(residuals, default=0.0))
    return [group for group, residual in zip(large, residuals, strict=True) if residual <= bound]


def _moves(trail: _Trail) -> bool:
    size = float(np.nanmedian(np.linalg.norm(trail.motion, axis=1)))
    return trail.seen >= MIN_SCENES and size > AGREEMENT_M


def _residual(points: Array, cues: Sequence[ContactCue], places: Sequence[Sequence[ContactCue]]) -> float:
    """Root mean square distance of points ``(n, 2)`` from cues, less each place's own offset, metres.

    Offsets are estimated from the same touches, so a place of n touches tells of n - 1 distances.
    """
    offsets = np.stack([cue.point_world[:2] for cue in cues]) - points[: len(cues)]
    squares, degrees = 0.0, 0
    for place in places:
        own = offsets[[i for i, cue in enumerate(cues) if any(cue is one for one in place)]]
        own = own[np.isfinite(own[:, 0])]
        if len(own) > 1:
            squares += float(((own - own.mean(axis=0)) ** 2).sum())
            degrees += len(own) - 1
    return float(np.sqrt(squares / degrees)) if degrees else np.inf


def _claimed(trail: _Trail, scenes: Sequence[DemonstrationScene], known: Iterable[KnownObject]) -> bool:
    """Whether a trail follows an object that is known by patches already."""
    size = float(np.nanmedian(np.linalg.norm(trail.motion, axis=1)))
    for model in known:
        if model.patches is None:
            continue
        found = [model.patches.localise(Look(scene.views)) for scene in scenes]
        points = np.stack(
            [one.T_world_obj[:2, 3] if one.status == "found" else np.full(2, np.nan) for one in found]
        )
        if _difference(trail.motion, points) < SAME_MOTION_SHARE * size:
            return True
    return False


def _model(name: str, group: Sequence[_Trail], scenes: Sequence[DemonstrationScene]) -> PatchModel | None:
    """The object that a group follows; None if it turns."""
    # Of one place, so that all know the same point of the object.
    same = (trail for trail in group if trail.place == group[0].place)
    kept = list(islice((trail for trail in same if not _turns(trail, scenes)), MAX_PROBES))
    if not kept:
        return None
    agreed = _agreed(kept)
    probes = []
    for trail in kept:
        error = np.linalg.norm(trail.motion - agreed, axis=1)
        std = max(1.4826 * float(np.nanmedian(error)), MIN_STD_M)
        probes.append(replace(trail.probe, patches=_references(trail, scenes), std_m=std))
    height = float(probes[0].patches[0].point_world[2])
    return PatchModel(name, tuple(probes), height, float(np.median([trail.correlation for trail in kept])))


def _turns(trail: _Trail, scenes: Sequence[DemonstrationScene]) -> bool:
    """Whether the patch, turned either way, is found more clearly than as it is in many scenes."""
    patch, probe = trail.probe.patches[0], trail.probe
    height, width = patch.image.shape[:2]
    turned = [patch]
    for angle in (-TURN_DEG, TURN_DEG):
        turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle, 1.0)
        image = cv2.warpAffine(patch.image, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
        turned.append(replace(patch, image=np.asarray(image, np.uint8)))
    better = []
    for scene in scenes:
        view = as_seen(scene.views.get(probe.camera), probe)
        if view is None:
            continue
        sights = [match(one, probe, view) for one in turned]
        straight, *others = [0.0 if one is None else one.correlation for one in sights]
        better.append(max(others) > straight + TURN_GAIN)
    return float(np.mean(better)) > TURN_SHARE


def _references(trail: _Trail, scenes: Sequence[DemonstrationScene]) -> tuple[Patch, ...]:
    """The trail's patch, and the like from other scenes, as if all were seen from the first one's camera."""
    own, probe = trail.probe.patches[0], trail.probe
    followed = np.flatnonzero(np.isfinite(trail.points[:, 0]))
    patches = [own]
    for i in _spaced(followed[followed != trail.scene].tolist(), REFERENCES - 1):
        view = as_seen(scenes[i].views.get(probe.camera), probe)
        point = np.append(trail.points[i], own.point_world[2])
        patch = None if view is None else cut(view, point, trail.radius)
        if view is not None and patch is not None:
            patches.append(replace(patch, corner=patch.corner + _shift(point, view, probe)))
    return tuple(patches)


def _shift(point_world: Array, view: View, probe: Probe) -> Array:
    """How far, in pixels, a point seen in a view would lie elsewhere in the probe's."""
    there, _ = project(probe.calibration, probe.T_world_cam, point_world)
    here, _ = project(view.camera, view.T_world_cam, point_world)
    return there - here
