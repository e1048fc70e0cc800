"""What crosses rooms: what an instruction says, what a camera shows, where objects are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # the configuration is imported by every command, and must not wait for SciPy
    from lerobot_openspm.geometry.camera import Camera
    from lerobot_openspm.geometry.se3 import Array

Mask = NDArray[np.bool_]
# What is learned of an object: its shape from the demonstrations, the box around it, or a box of the size
# that SAM 3D gives.
Shape = Literal["demonstrations", "box", "sam3d"]
# How key poses are followed: planned from where the hand should be, from where it is, or that and corrected.
Execution = Literal["open_loop", "closed_loop", "closed_loop_trc"]
# What the flow model is told: poses in the world, or the relative pose in the frame of the target key pose.
Conditioning = Literal["paper", "equivariant"]

# Standard deviation of a uniform angle: of a yaw that cannot be seen.
UNKNOWN_YAW_STD = float(np.pi / np.sqrt(3))


@dataclass(frozen=True)
class View:
    """One camera's picture of one moment.

    Attributes:
        image: RGB image ``(H, W, 3)``, uint8.
        camera: Intrinsics, already scaled to ``H x W``.
        T_world_cam: Camera pose ``(4, 4)`` at that moment.
        depth: Metres along the optical axis ``(H, W)``, float32, 0 where not measured; None without a depth
            stream.
        labels: Number of the object that each pixel shows ``(H, W)``, int32; None unless the observation
            brings masks.
    """

    image: NDArray[np.uint8]
    camera: Camera
    T_world_cam: Array
    depth: NDArray[np.float32] | None = None
    labels: NDArray[np.int32] | None = None


@dataclass(frozen=True)
class Segmentation:
    """One instance of a phrase in one view: the paper's mask and confidence.

    Attributes:
        mask: Its pixels ``(H, W)``; at least one.
        confidence: From 0 to 1.
    """

    mask: Mask
    confidence: float


class Segmenter(Protocol):
    """Finds objects by phrase in the views of one moment.

    What is found of a phrase does not depend on the other phrases that are asked for with it.
    """

    def segment(
        self, views: Mapping[str, View], phrases: Sequence[str]
    ) -> dict[str, dict[str, tuple[Segmentation, ...]]]:
        """By phrase and camera: the instances seen, the most confident first.

        Every phrase and every camera has an entry; it is empty where nothing is seen.

        Raises:
            PerceptionError: A phrase that this segmenter cannot know, or a view that lacks what it needs.
            ObservationError: A view whose image does not fit its camera.
        """
        ...


@dataclass(frozen=True)
class ContactCue:
    """Where the hand touched something, as mining saw it.

    Attributes:
        name: The noun phrase of the instruction, such as ``"bowl"``.
        point_world: Point ``(3,)`` between the fingertips, in metres.
        kind: ``"grasp"`` or ``"contact"``: part of the object was at this point in the first frame;
            ``"release"``: the object lies below or around this point.
        place: Cues with the same place touched the same spot of the object, as far as one can know.
    """

    name: str
    point_world: Array
    kind: Literal["grasp", "release", "contact"]
    place: str = ""


@dataclass(frozen=True)
class Moment:
    """What some cameras showed at one moment of a demonstration.

    Attributes:
        views: By camera name.
        moved: Objects that the hand may have moved by then.
    """

    views: Mapping[str, View]
    moved: frozenset[str]


@dataclass(frozen=True)
class DemonstrationScene:
    """What learning sees of one demonstration.

    Attributes:
        views: First frame by camera name, the hand away from the objects.
        cues: Where the hand touched something, for any number of objects.
        later_views: A frame after the grasped object was carried off, by camera name; None if there is none.
        film: Reads the moments of it, which show objects from all around; None where that is not wanted.
    """

    views: dict[str, View]
    cues: tuple[ContactCue, ...]
    later_views: dict[str, View] | None = None
    film: Callable[[], Sequence[Moment]] | None = None


@dataclass(frozen=True)
class Support:
    """What a pose estimate rests on: the grounds of the paper's observation covariance ``R_t``.

    Attributes:
        kind: Kind of object whose fitted noise weights apply; a kind without weights gives no support.
        area_px: Pixels of the object that were used, over all views.
        consistency: From 0 to 1: how well the views agree.
        quality: From 0 to 1: how well the learned shape or patches explain the object's own demonstrations.
    """

    kind: str
    area_px: float
    consistency: float
    quality: float


@dataclass(frozen=True)
class Symmetry:
    """How an object turns into itself: about a vertical axis of its frame.

    Attributes:
        middle: Where the axis is, x and y ``(2,)``, metres.
        turn: The least angle that leaves its shape as it is, radians; 0 where any angle does.
    """

    middle: Array
    turn: float


@dataclass(frozen=True)
class PoseEstimate:
    """Where an object is.

    Attributes:
        status: ``"ambiguous"`` when two places explain the images equally well; the pose is the better one.
        T_world_obj: Upright pose ``(4, 4)``: its frame as it was learned, z is up.
        covariance: ``(4, 4)`` over x, y, z in metres and yaw in radians.
        confidence: From 0 to 1; 1 is how well the object is typically found in its demonstrations.
        visible: Share of the object that the best view shows and the hand does not hide, at its place if it
            was found, else where it was expected.
        support: What the estimate rests on; None where the covariance needs no correction.
        others: Poses ``(4, 4)`` of further places that show such an object too, the most confident first;
            empty for kinds that cannot see several.
        tipped: Whether it is seen to lie on its side or upside down, and so was not found as it should stand.
    """

    status: Literal["found", "not_found", "ambiguous"]
    T_world_obj: Array
    covariance: Array
    confidence: float
    visible: float = 1.0
    support: Support | None = None
    others: tuple[Array, ...] = ()
    tipped: bool = False


@dataclass(frozen=True)
class Reference:
    """How an instruction tells an object from others of its name, to be resolved in the scene.

    "the bowl between the plate and the ramekin" is ``Reference("between", ("plate", "ramekin"))``, "the left
    plate" is ``Reference("left")``.

    Attributes:
        relation: Where the object is: "between", "next to", "on", "in", "left", "right", "front", "back" ...
        landmarks: The objects it is there relative to; none where it is meant among those of its own name.
    """

    relation: str
    landmarks: tuple[str, ...] = ()


# The operation of an instruction in which the grammar reads none: what is done is what its words say.
OWN_WORDS = "do"


@dataclass(frozen=True)
class SubTask:
    """One thing to do, as an instruction says it.

    Attributes:
        operation: What is done: put, open, close, push, turn on, turn off; :data:`OWN_WORDS` where it is kept
            by its words.
        target: The object it is done to.
        part: The part of the target that is meant ("top drawer"), or "".
        relation: Where the target goes relative to the landmark ("on", "in", "front of"), or "".
        landmark: The object it goes to, or "".
        target_where: Which of several objects of the target's name is meant; None where it is not said.
        landmark_where: Likewise for the landmark.
        words: The instruction in its own words, without articles and courtesies, where the grammar cannot
            read it; else "".
    """

    operation: str
    target: str
    part: str = ""
    relation: str = ""
    landmark: str = ""
    target_where: Reference | None = None
    landmark_where: Reference | None = None
    words: str = ""

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects that are named: target, then landmark."""
        return tuple(name for name in (self.target, self.landmark) if name)


@dataclass(frozen=True)
class Fault:
    """What is wrong with a camera, and seconds since its last usable image.

    They are infinite for a camera that disagrees with others: nothing that it shows was ever usable.
    """

    reason: str
    seconds: float


@dataclass(frozen=True)
class Detections:
    """What perception found in one observation.

    Attributes:
        estimates: By name, for the objects that were looked for.
        faults: Cameras whose images cannot be used.
    """

    estimates: Mapping[str, PoseEstimate]
    faults: Mapping[str, Fault]


@dataclass(frozen=True)
class Hand:
    """What proprioception says: pose ``T_world_ee`` ``(4, 4)``, and opening in the state's units."""

    T_world_ee: Array
    opening: float
