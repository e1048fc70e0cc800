"""The result of mining a dataset. Memory entries and flow samples are both made of it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import Anchor, Axis, Outcome
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.anchors import Demonstration, Role
from lerobot_openspm.mining.key_poses import KeyPose
from lerobot_openspm.mining.signals import Episode
from lerobot_openspm.perception.objects.base import KnownObject
from lerobot_openspm.types import SubTask


@dataclass(frozen=True)
class MinedEpisode:
    """One demonstration.

    Attributes:
        episode: Its signals: hand poses, gripper, actions.
        key_poses: Where its phases end, in order, with the phases' names; a judge's labels are merged in.
        sub_tasks: The sub-tasks of its instruction.
    """

    episode: Episode
    key_poses: tuple[KeyPose, ...]
    sub_tasks: tuple[SubTask, ...]


@dataclass(frozen=True)
class MinedKeyPoses:
    """What a dataset's low-dimensional columns show. No image was read.

    Attributes:
        name: The dataset's repository id.
        robot: Model of the robot, fitted to `episodes`.
        episodes: Episodes with key poses, to remember and learn from.
        held_out: Other episodes with key poses, for a validation loss. No judge labelled their phases.
        skipped: Reason by episode index for those without key poses.
    """

    name: str
    robot: RobotModel
    episodes: tuple[MinedEpisode, ...]
    held_out: tuple[MinedEpisode, ...]
    skipped: Mapping[int, str]


@dataclass(frozen=True)
class MinedTask:
    """The demonstrations of one instruction, compared with each other.

    Attributes:
        episodes: The demonstrations.
        aligned: Key poses and object poses of each, frames of symmetric objects turned so that they agree.
        anchors: For each role of a key pose, the frame in which the demonstrations agree best.
        axes: For each demonstration, the axes along which drawers slid and about which knobs turned.
        qualities: For each demonstration the paper's ``r``, 0 to 1; see :func:`anchors.qualities`.
        outcomes: For each demonstration, where it left its targets relative to their landmarks.
    """

    episodes: tuple[MinedEpisode, ...]
    aligned: tuple[Demonstration, ...]
    anchors: Mapping[Role, Anchor]
    axes: tuple[Mapping[Role, Axis], ...]
    qualities: tuple[float, ...]
    outcomes: tuple[tuple[Outcome, ...], ...]

    @property
    def sub_tasks(self) -> tuple[SubTask, ...]:
        """The sub-tasks of the instruction."""
        return self.episodes[0].sub_tasks


@dataclass(frozen=True)
class MinedDataset(MinedKeyPoses):
    """What columns and images together show.

    Attributes:
        cameras: The calibration of the images.
        objects: Models of the objects by name.
        object_poses: Per demonstration, of which an episode may be several, ``T_world_obj`` ``(4, 4)`` of the
            objects found in its first frame.
        tasks: The demonstrations by instruction, with their anchors.
        unlearned: By name, why objects that the hand touched could not be learned.
        surfaces: Names of what things stand on everywhere; nobody learns it.
        simulator_objects: Objects in the order of the simulator's pose vector (oracle ablation only).
    """

    cameras: Mapping[str, Camera]
    objects: Mapping[str, KnownObject]
    object_poses: tuple[Mapping[str, Array], ...]
    tasks: tuple[MinedTask, ...]
    unlearned: Mapping[str, str] = field(default_factory=dict[str, str])
    surfaces: Collection[str] = ()
    simulator_objects: tuple[str, ...] = ()
