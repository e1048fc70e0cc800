"""What all kinds of known objects have in common: how they are learned, found again and written down.

A kind is one folder with a class that is a :class:`KnownObject` and a :class:`Kind` that
:data:`lerobot_openspm.perception.objects.kinds.KINDS` lists. Nobody else names a kind.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from lerobot_openspm.errors import ObservationError, PerceptionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.foreground import Bins, lab_bins
from lerobot_openspm.types import (
    DemonstrationScene,
    Mask,
    PoseEstimate,
    Segmentation,
    Segmenter,
    Shape,
    Symmetry,
    View,
)

logger = logging.getLogger(__name__)

# Fingers close above the plane that objects stand on; where nothing else tells it, it is taken to lie this
# far below the lowest point that they ever went to, metres.
BELOW_CUES_M = 0.02

# By camera: what a segmenter found of one phrase.
Instances = Mapping[str, Sequence[Segmentation]]
# An object that was found with this confidence is not sought on top of others.
CLEAR = 0.8
# Fields for a JSON file, and arrays for a safetensors file.
Record = tuple[dict[str, Any], dict[str, NDArray[Any]]]


def check_view(view: View) -> None:
    """Check a view before objects are sought in it.

    Raises:
        ObservationError: The image is not RGB uint8 of the camera's size, or the camera's pose is not rigid.
    """
    expected = (view.camera.height, view.camera.width, 3)
    if view.image.shape != expected or view.image.dtype != np.uint8:
        raise ObservationError(
            f"image of shape {view.image.shape} and type {view.image.dtype}, expected {expected} of uint8; "
            "scale the camera to the image with Camera.scaled"
        )
    if not se3.is_rigid(view.T_world_cam):
        raise ObservationError("T_world_cam of a view is not a rigid (4, 4) transform; check the hand's pose")


@dataclass(frozen=True)
class Look:
    """What the cameras show at one moment. It is shared by all objects that are sought in it.

    Attributes:
        views: Views by camera name, at least one.
        instances: By phrase and camera: what a segmenter found.
        hidden: Pixels ``(H, W)`` by camera name that something may be in front of; no evidence.
        expected: Poses ``T_world_obj`` ``(4, 4)`` by object at which it is looked for first.
        told_apart: Objects that words tell from others of their kind, all of which are sought therefore.
        supports: Points ``(n, 3)`` of other things' surfaces, world, that an object may stand on or in.
        standing: Points ``(n, 3)``, world, of what is known to stand somewhere, by name; it may hide others.
        before: Earlier looks from elsewhere, the oldest first.

    Raises:
        ObservationError: There is no view, or one is malformed.
    """

    views: Mapping[str, View]
    instances: Mapping[str, Instances] = field(default_factory=dict[str, Instances])
    hidden: Mapping[str, Mask] = field(default_factory=dict[str, Mask])
    expected: Mapping[str, Array] = field(default_factory=dict[str, Array])
    told_apart: Collection[str] = ()
    supports: Array = field(default_factory=lambda: np.zeros((0, 3)))
    standing: Mapping[str, Array] = field(default_factory=dict[str, Array])
    before: Sequence[EarlierLook] = ()
    _bins: dict[str, Bins] = field(default_factory=dict[str, Bins])
    _prepared: dict[Hashable, Any] = field(default_factory=dict[Hashable, Any])

    def __post_init__(self) -> None:
        if not self.views:
            raise ObservationError("no camera views to look for an object in; pass at least one")
        for view in self.views.values():
            check_view(view)

    def bins(self, camera: str) -> Bins:
        """Colour bin ``(H, W)`` of every pixel of a view; computed once for all objects."""
        if camera not in self._bins:
            self._bins[camera] = lab_bins(self.views[camera].image)
        return self._bins[camera]

    def prepared[T](self, key: Hashable, make: Callable[[], T]) -> T:
        """What objects that share ``key`` need of the views; made once for all of them."""
        if key not in self._prepared:
            self._prepared[key] = make()
        return self._prepared[key]

    def instances_of(self, name: str) -> Instances:
        """What the segmenter found of an object. Raises PerceptionError where none was asked."""
        if name not in self.instances:
            raise PerceptionError(
                f"{name!r} was learned from a segmenter's masks, and is to be found without them; give the "
                "segmenter that it was learned with"
            )
        return self.instances[name]

    def seen_share(self, points_world: Array) -> float:
        """Share of points ``(n, 3)`` that are in the picture and not hidden, in the view that shows most."""
        shares = [0.0]
        for name, view in self.views.items():
            uv, depth = project(view.camera, view.T_world_cam, points_world)
            uv = np.nan_to_num(uv, nan=-1.0)
            size = np.array([view.camera.width, view.camera.height])
            inside = (depth > 0) & (uv >= 0).all(1) & (uv <= size - 1).all(1)
            if name in self.hidden:
                inside[inside] = ~self.hidden[name][tuple(np.rint(uv[inside]).astype(int).T[::-1])]
            shares.append(float(inside.mean()))
        return max(shares)


@dataclass(frozen=True)
class EarlierLook:
    """A look of before, and where objects were found in it.

    Attributes:
        look: The look.
        poses: Poses ``T_world_obj`` ``(4, 4)`` by object, of those that were found.
    """

    look: Look
    poses: Mapping[str, Array]

    def without(self, names: Collection[str]) -> EarlierLook:
        """The same, telling nothing of some objects."""
        return replace(self, poses={name: T for name, T in self.poses.items() if name not in names})

    def __deepcopy__(self, memo: dict[int, object]) -> EarlierLook:
        """Itself: nothing here ever changes, and pictures are large."""
        return self


def look_at(
    views: Mapping[str, View],
    phrases: Sequence[str],
    segmenter: Segmenter | None,
    hidden: Mapping[str, Mask],
    expected: Mapping[str, Array],
    told_apart: Collection[str] = (),
    standing: Mapping[str, Array] | None = None,
    before: Sequence[EarlierLook] = (),
) -> Look:
    """A :class:`Look` for objects. A segmenter is asked once for all of their phrases."""
    found = segmenter.segment(views, phrases) if segmenter is not None and phrases else {}
    return Look(views, found, hidden, expected, told_apart, standing=standing or {}, before=before)


def localise_all(objects: Mapping[str, KnownObject], look: Look) -> dict[str, PoseEstimate]:
    """Find objects by name; those that were not found clearly are sought on top of the others too, or behind.

    What is under another may not be found for it, but where it seems to be is where to look.
    """
    found = {name: known.localise(look) for name, known in objects.items()}
    points = {name: se3.apply(one.T_world_obj, objects[name].points) for name, one in found.items()}
    stand = {name for name, one in found.items() if one.status == "found"}
    for name, one in found.items():
        is_clear = one.status == "found" and one.confidence >= CLEAR and name not in look.told_apart
        others = {other: own for other, own in points.items() if other != name and len(own)}
        if objects[name].sought_again and others and not is_clear and name not in look.expected:
            supports = np.concatenate(list(others.values()))
            standing = {**look.standing, **{other: own for other, own in others.items() if other in stand}}
            found[name] = objects[name].localise(replace(look, supports=supports, standing=standing))
    return found


class KnownObject(Protocol):
    """An object that was learned. Every kind of object implements this.

    Attributes:
        kind: By what it is known, as records name it.
        sought_again: Whether the kind finds more once the others are found: on top of them, in them, behind.
    """

    kind: ClassVar[str]
    sought_again: ClassVar[bool]

    @property
    def name(self) -> str:
        """The noun phrase."""
        ...

    @property
    def height(self) -> float:
        """World z, metres, of the plane that it stood on, or of its reference point."""
        ...

    @property
    def yaw_period(self) -> float:
        """Turning by this angle (radians) leaves it unchanged; 0 for a body of revolution."""
        ...

    @property
    def points(self) -> NDArray[np.floating[Any]]:
        """Points ``(n, 3)`` of its surface in its frame, metres; none where its shape is not known."""
        ...

    @property
    def patches(self) -> KnownObject | None:
        """What finds it where it stood in the demonstrations; None of an object that is moved about."""
        ...

    @property
    def symmetry(self) -> Symmetry | None:
        """How its shape turns into itself, whatever its colours do; None if it does not, or is not known."""
        ...

    def localise(self, look: Look) -> PoseEstimate:
        """Find the object.

        Raises:
            PerceptionError: It was learned from a segmenter's masks, and the look has none.
        """
        ...

    def to_record(self) -> Record:
        """What to write down of it; ``fields["kind"]`` and ``fields["name"]`` say what it is."""
        ...


@dataclass(frozen=True)
class ObjectShape:
    """An object's place and size, as a shape backend says.

    Attributes:
        T_world_obj: Upright pose ``(4, 4)``: origin at the footprint's centre, x along its long side.
        extents: Length, width and height ``(3,)`` along that frame's axes, metres.
        quality: From 0 to 1: how well the shape explains what was seen.
    """

    T_world_obj: Array
    extents: Array
    quality: float


@dataclass(frozen=True)
class Appearance:
    """An object in the view that shows it best.

    Attributes:
        view: The view.
        segmentation: Of the object in that view.
        points_world: Points ``(n, 3)`` of its surface in the world, metres; None where none are known.
    """

    view: View
    segmentation: Segmentation
    points_world: Array | None = None


class ShapeBackend(Protocol):
    """Finds the shapes of segmented objects: the paper's "local object shape and principal axes"."""

    def describe(self, objects: Sequence[Appearance]) -> list[ObjectShape]:
        """The objects' shapes, in their order.

        Raises:
            PerceptionError: The backend cannot be used, or what was seen is too little for it.
        """
        ...


@dataclass(frozen=True)
class Examples:
    """What objects are learned from.

    Attributes:
        names: The objects that are still to be learned.
        scenes: First frames and contact cues of the demonstrations of all tasks.
        known: Objects that are known already; a new one is none of them.
        rng: Chooses among the demonstrations of an object where there are more than needed.
        segmenter: Finds the objects' masks; None where the demonstrations teach their looks.
        source: What a segmenter's masks are to teach.
        shapes: Tells the sizes of objects, for source "sam3d".
        told_apart: Names that instructions tell from others of their kind: pictures may show several.
        left_out: By name, why objects could not be learned; the kinds write it with :meth:`leave_out`.
    """

    names: Sequence[str]
    scenes: Sequence[DemonstrationScene]
    known: Collection[KnownObject]
    rng: Generator
    segmenter: Segmenter | None = None
    source: Shape = "demonstrations"
    shapes: ShapeBackend | None = None
    told_apart: Collection[str] = ()
    left_out: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    def leave_out(self, name: str, why: str) -> None:
        """Say why a kind cannot learn an object; another kind may still learn it."""
        logger.info("perception: %r: %s", name, why)
        self.left_out.setdefault(name, []).append(why)

    @property
    def floor(self) -> float:
        """World height, metres, below which nothing that the hand touched can stand."""
        return min(float(cue.point_world[2]) for one in self.scenes for cue in one.cues) - BELOW_CUES_M


@dataclass(frozen=True)
class Kind:
    """One kind of known objects.

    Attributes:
        name: As it is called in records.
        learn: Learns from examples the objects that this kind can represent. Of those that it tried in vain
            it says why, with :meth:`Examples.leave_out`.
        from_record: The object of a record's fields and arrays, all of them checked; the last argument names
            their origin in a MemoryFormatError.
    """

    name: str
    learn: Callable[[Examples], Mapping[str, KnownObject]]
    from_record: Callable[[Mapping[str, Any], Mapping[str, NDArray[Any]], str], KnownObject]
