"""From an observation to detections: which cameras can be believed, and where the objects are."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import cv2
import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera, project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import EarlierLook, KnownObject, Look, localise_all, look_at
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.oracle import name_simulator_poses
from lerobot_openspm.perception.tracking.camera_health import MIN_COMMON, CameraWatch, disagreements
from lerobot_openspm.types import Detections, Fault, Mask, PoseEstimate, Segmenter, View

# How exact the simulator's poses are taken to be (oracle ablation only): metres and radians.
ORACLE_STD = 1e-4
# So many objects are compared between views at most.
MOST_COMPARED = 8
# The first look is remembered and so many of the last ones, each from where the hand's camera was so far from
# where it was before, metres, or turned by so much, radians.
MOST_REMEMBERED, ELSEWHERE_M, ELSEWHERE_RAD = 3, 0.05, 0.3
# What was sought in vain is not sought again until pictures, made smaller by this, differ somewhere by so
# many levels of 255, in the mean over a square of so many pixels. What is seen a pixel aside is the same, as
# a hand that holds its place sinks a little.
SMALLER, CHANGED_PX, CHANGED_LEVELS = 2, 4, 6.0
# The hand and the arm behind it as balls along the hand's approach axis: from its fingertips this far back.
TIP_M, BACK_M, BALLS = 0.01, -0.30, 12
# The fingers are slimmer than what carries them; they end here.
FINGERS_M, FINGER_SHARE = -0.05, 0.6
# What the fingers are around reaches this far from their tips, metres.
LOAD_M = 0.12


class KnownWorld(Protocol):
    """What was learned of objects and cameras; a memory is one."""

    @property
    def objects(self) -> Mapping[str, KnownObject]:
        """Known objects by name."""
        ...

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Calibration by camera key."""
        ...

    @property
    def perception(self) -> str:
        """Whose object frames are used: "oracle" for the simulator's (ablation), else "demonstrations"."""
        ...

    @property
    def simulator_objects(self) -> Sequence[str]:
        """Objects in the order of the simulator's pose vector (oracle ablation only)."""
        ...


@dataclass(frozen=True)
class InVain:
    """Objects that were sought all over the pictures and not found clearly.

    Attributes:
        pictures: What was searched by camera, small.
        told_apart: Objects that words told from others of their kind.
        estimates: What came of it, by object.
    """

    pictures: Mapping[str, Array] = field(default_factory=dict[str, Array])
    told_apart: frozenset[str] = frozenset()
    estimates: Mapping[str, PoseEstimate] = field(default_factory=dict[str, PoseEstimate])

    def still(
        self, pictures: Mapping[str, Array], told_apart: Collection[str], names: Collection[str]
    ) -> dict[str, PoseEstimate]:
        """The estimates of some objects that still hold, as far as pictures have not changed."""
        is_same = self.told_apart == frozenset(told_apart) and self.pictures.keys() == pictures.keys()
        if not is_same or any(_differ(pictures[camera], own) for camera, own in self.pictures.items()):
            return {}
        return {name: one for name, one in self.estimates.items() if name in names}


@dataclass
class Perception:
    """What one environment looks through.

    Attributes:
        memory: What objects and cameras are known.
        hand_radius_m: Radius of the hand, which hides what is behind it.
        segmenter: Finds the masks of objects that were learned from a segmenter's; None if none were.
        before: Looks that are remembered, the oldest first.
        in_vain: What the last search did not find.
    """

    memory: KnownWorld
    hand_radius_m: float
    segmenter: Segmenter | None = None
    before: tuple[EarlierLook, ...] = ()
    in_vain: InVain = field(default_factory=InVain)
    _watch: CameraWatch = field(default_factory=CameraWatch)
    _has_looked: bool = False
    _has_compared: bool = False
    _comparable: dict[str, None] = field(default_factory=dict[str, None])
    _labelled: set[str] = field(default_factory=set[str])

    def detect(
        self,
        observation: Observation,
        names: Sequence[str],
        expected: Mapping[str, Array],
        time_s: float,
        told_apart: Collection[str] = (),
        displaced: Collection[str] = (),
        is_loaded: bool = False,
    ) -> Detections:
        """Look for objects.

        Args:
            observation: What there is to see.
            names: The objects.
            expected: Poses ``T_world_obj`` ``(4, 4)`` of what was seen before. There the objects are sought
                first, and others may hide them.
            time_s: Seconds since the episode began.
            told_apart: Those of the objects that words tell from others of their kind.
            displaced: Objects of which earlier looks tell nothing any more.
            is_loaded: Whether the fingers are around something: it is not to be taken for what stands behind.

        Raises:
            ObservationError: A camera is missing or broken at the very first look.
        """
        if self.memory.perception == "oracle":
            return Detections(self._simulator_poses(observation, names), {})
        if not self._has_looked:  # a camera that never worked is a mistake in the set-up
            observation.views(self.memory.cameras)
            self._has_looked = True
        views, absent = observation.usable_views(self.memory.cameras)
        for camera in [name for name in self._labelled if name in views and views[name].labels is None]:
            absent[camera] = "gave no masks, which it did before"
            del views[camera]
        if self.segmenter is not None:
            self._labelled |= {name for name, view in views.items() if view.labels is not None}
        faults = self._watch.check(views, absent, observation.hand.T_world_ee, time_s)
        sound = {camera: view for camera, view in views.items() if camera not in faults}
        if not sound:
            return Detections({}, faults)
        hand = observation.hand.T_world_ee, self.hand_radius_m, LOAD_M if is_loaded else 0.0
        hidden = {camera: hand_mask(view, *hand) for camera, view in sound.items()}
        known = {name: self.memory.objects[name] for name in names if name in self.memory.objects}
        self.before = tuple(one.without(displaced) for one in self.before)
        standing = self._standing(expected)
        look = look_at(
            sound, list(known), self.segmenter, hidden, expected, told_apart, standing, self.before
        )
        estimates = self._localise(known, look)
        found = {name: one for name, one in estimates.items() if name not in displaced}
        self.remember(look, found, is_still=not displaced)
        if not self._has_compared:  # once, as soon as all cameras are sound, by what is sought until then
            self._comparable |= dict.fromkeys(known)
            if not faults:
                self._has_compared = True
                # What is found by masks is compared where the segmenter was asked for it.
                wanted = [name for name in self._comparable if not look.instances or name in look.instances]
                comparable = {name: self.memory.objects[name] for name in wanted}
                faults = disagreeing_cameras(look, comparable, estimates)
        return Detections(estimates, faults)

    def _standing(self, expected: Mapping[str, Array]) -> dict[str, Array]:
        """Points ``(n, 3)``, world, of the objects at some poses ``(4, 4)``, where their shape is known."""
        points = {name: self.memory.objects[name].points for name in expected if name in self.memory.objects}
        return {name: se3.apply(expected[name], own) for name, own in points.items() if len(own)}

    def _localise(self, known: Mapping[str, KnownObject], look: Look) -> dict[str, PoseEstimate]:
        """Find objects, but do not search again for what the same pictures did not show before."""
        unseen = known.keys() - look.expected.keys()
        pictures = {camera: _small(view) for camera, view in look.views.items()} if unseen else {}
        still = self.in_vain.still(pictures, look.told_apart, unseen)
        found = localise_all({name: one for name, one in known.items() if name not in still}, look)
        estimates = {name: still.get(name) or found[name] for name in known}
        missed = {name: found[name] for name in unseen & found.keys() if found[name].status != "found"}
        if still:
            self.in_vain = replace(self.in_vain, estimates={**self.in_vain.estimates, **missed})
        else:
            self.in_vain = InVain(pictures, frozenset(look.told_apart), missed)
        return estimates

    def remember(self, look: Look, estimates: Mapping[str, PoseEstimate], is_still: bool = True) -> None:
        """Keep a look that found something, from elsewhere than the last one that was kept.

        Or, as long as nothing was displaced, one that found more from the same place, instead of that one.
        Of all but the first one only what the hand's cameras show: the others show the same again.
        """
        poses = {name: one.T_world_obj for name, one in estimates.items() if one.status == "found"}
        before = self.before
        if before and not _is_elsewhere(look, before[-1].look):
            if not is_still or not poses.keys() > before[-1].poses.keys():
                return
            before = before[:-1]
        if poses:
            views = _of_the_hand(look) if before else look.views
            kept = EarlierLook(replace(look, views=views, before=()), poses)
            self.before = (*before[:1], *(*before[1:], kept)[-MOST_REMEMBERED:])

    def _simulator_poses(self, observation: Observation, names: Sequence[str]) -> dict[str, PoseEstimate]:
        poses = observation.simulator_poses(self.memory.simulator_objects)
        named = name_simulator_poses(poses, names, self.memory.objects)
        covariance = ORACLE_STD**2 * np.eye(4)
        return {name: PoseEstimate("found", T, covariance, 1.0) for name, T in named.items()}


def disagreeing_cameras(
    look: Look, known: Mapping[str, KnownObject], estimates: Mapping[str, PoseEstimate]
) -> dict[str, Fault]:
    """The cameras that, each by itself, show objects elsewhere than other cameras do.

    Args:
        look: What all cameras show.
        known: Objects by name.
        estimates: Where all cameras together show them. Each camera looks first where they were found.
    """
    if len(look.views) < 2 or len(known) < MIN_COMMON:
        return {}
    together = [name for name, one in estimates.items() if one.status == "found"]
    together.sort(key=lambda name: -estimates[name].confidence)
    expected = {name: estimates[name].T_world_obj for name in together}
    # Cameras that disagree much find little together, and that in wrong places; each finds more by itself.
    names = [*together, *(name for name in known if name not in expected)][:MOST_COMPARED]
    places: dict[str, dict[str, list[Array]]] = {}
    for camera, view in look.views.items():
        instances = {name: {camera: found.get(camera, ())} for name, found in look.instances.items()}
        hidden = {camera: look.hidden[camera]} if camera in look.hidden else {}
        alone = Look({camera: view}, instances, hidden, expected)
        seen = {name: known[name].localise(alone) for name in names}
        places[camera] = {
            name: [_middle(known[name], T) for T in (one.T_world_obj, *one.others)]
            for name, one in seen.items()
            if one.status != "not_found"
        }
    # What such a camera shows was never usable.
    return {camera: Fault(reason, float("inf")) for camera, reason in disagreements(places).items()}


def _middle(known: KnownObject, T_world_obj: Array) -> Array:
    """Where the middle of an object is ``(2,)``: its frame may lie beside it, and swings as it turns."""
    middle = known.points.mean(0) if len(known.points) else np.zeros(3)
    return se3.apply(T_world_obj, np.asarray(middle, float)[None])[0, :2]


def _small(view: View) -> Array:
    """A view's picture, smaller, as numbers."""
    height, width = (max(1, size // SMALLER) for size in view.image.shape[:2])
    return np.asarray(cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA), float)


def _differ(picture: Array, other: Array) -> bool:
    """Whether two small pictures show something else somewhere, not only a pixel aside."""
    return picture.shape != other.shape or _shows_more(picture, other) or _shows_more(other, picture)


def _shows_more(picture: Array, other: Array) -> bool:
    """Whether a small picture is somewhere darker or brighter than another one is within a pixel of there."""
    darkest, brightest = (extreme(other, np.ones((3, 3), np.uint8)) for extreme in (cv2.erode, cv2.dilate))
    beyond = np.maximum(np.maximum(darkest - picture, picture - brightest), 0)
    return bool((cv2.blur(beyond, (CHANGED_PX, CHANGED_PX)) > CHANGED_LEVELS).any())


def _is_elsewhere(look: Look, before: Look) -> bool:
    """Whether a camera of the hand is elsewhere, or looks in another direction, than it did before."""
    for camera, view in _of_the_hand(look).items():
        if camera not in before.views:
            return True
        metres, radians = se3.distances(view.T_world_cam, before.views[camera].T_world_cam)
        if metres > ELSEWHERE_M or radians > ELSEWHERE_RAD:
            return True
    return False


def _of_the_hand(look: Look) -> dict[str, View]:
    """The views of cameras that the hand carries."""
    return {camera: view for camera, view in look.views.items() if view.camera.mount == "ee"}


def detect(
    views: Mapping[str, View],
    objects: Mapping[str, KnownObject],
    segmenter: Segmenter | None = None,
    told_apart: Collection[str] = (),
) -> dict[str, PoseEstimate]:
    """Find objects in the views of one moment, nothing being known of where they may be.

    Args:
        views: Views by camera name.
        objects: The objects by phrase.
        segmenter: Finds the masks of objects that were learned from a segmenter's; None if none were.
        told_apart: Those of the objects of which several may be there, and all are sought.

    Raises:
        ObservationError: There is no view, or one is malformed.
        PerceptionError: An object needs a segmenter and there is none, or the segmenter cannot be used.
    """
    look = look_at(views, list(objects), segmenter, {}, {}, told_apart)
    return localise_all(objects, look)


def hand_mask(view: View, T_world_ee: Array, radius: float, load_m: float = 0.0) -> Mask:
    """Pixels ``(H, W)`` that the hand may cover, drawn generously.

    In a camera that the hand carries none, or all where it holds something, which is close before it.

    Args:
        view: The view.
        T_world_ee: The hand's pose ``(4, 4)``; its z axis points out of it, away from the arm.
        radius: Of the hand, metres.
        load_m: How far what it holds reaches from the fingertips, metres.
    """
    if view.camera.mount == "ee":
        return np.full(view.image.shape[:2], load_m > 0)
    mask = np.zeros(view.image.shape[:2], np.uint8)
    z = np.linspace(TIP_M, BACK_M, BALLS)
    centres = se3.apply(T_world_ee, np.stack([0 * z, 0 * z, z], axis=1))
    uv, depth = project(view.camera, view.T_world_cam, centres)
    for at, centre, distance in zip(z, uv, depth, strict=True):
        if distance > radius and np.abs(centre).max() < 1e4:
            own = max(radius * (FINGER_SHARE if at > FINGERS_M else 1.0), load_m if at == TIP_M else 0.0)
            radius_px = max(1, round(view.camera.focal_px * own / float(distance)))
            cv2.circle(mask, (round(centre[0]), round(centre[1])), radius_px, 1, -1)
    return mask.astype(bool)
