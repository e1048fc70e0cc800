"""Mining as a whole: a LeRobotDataset goes in, a MinedDataset comes out. Read this file first.

    mined = DatasetProcessor(dataset, options).mine()

    dataset.py                 columns -> episodes (signals.py), and the robot that they show
    key_poses.py               episode -> key poses, by gripper.py and corners.py
    phase_labels/              optionally, what a judge says about their phases
    parts.py                   a demonstration of several things -> one for each
    objects.py                 where the hand touched what -> object models, and object poses per episode
    anchors, axes, outcomes    the demonstrations of a task compared with each other

Memory entries (`mining/entries.py`) and flow samples (`flow/samples.py`) are both made of that one result
(`mined.py`). Where the dataset has its key poses in columns (`columns.py`, written by `annotate.py`), they
are read instead of found.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from statistics import median_low

import numpy as np
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

from lerobot_openspm.errors import CalibrationError, DatasetError
from lerobot_openspm.geometry.camera import Camera, check_sizes
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.geometry.vector_layout import VectorLayout
from lerobot_openspm.language.instruction import read_tasks
from lerobot_openspm.language.lexicon import ENGLISH, Lexicon
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.anchors import (
    Demonstration,
    align_symmetric,
    as_shown,
    consensus,
    qualities,
    things_taken,
)
from lerobot_openspm.mining.axes import constrained_axes
from lerobot_openspm.mining.dataset import Demonstrations, open_dataset
from lerobot_openspm.mining.key_poses import KeyPose, find_key_poses
from lerobot_openspm.mining.mined import MinedDataset, MinedEpisode, MinedKeyPoses, MinedTask
from lerobot_openspm.mining.objects import find_objects, learn_scenes, simulator_poses
from lerobot_openspm.mining.outcomes import outcomes
from lerobot_openspm.mining.signals import Episode, observe_robot
from lerobot_openspm.perception.objects.base import KnownObject, ShapeBackend
from lerobot_openspm.types import Segmenter, Shape, Symmetry

logger = logging.getLogger(__name__)

# Merges a judge's phase labels into the key poses of episodes; see `docs/phase_labels.md`.
LabelPhases = Callable[[Demonstrations, tuple[MinedEpisode, ...], RobotModel], tuple[MinedEpisode, ...]]


@dataclass(frozen=True)
class MiningOptions:
    """How a dataset is mined.

    Attributes:
        state_layout: Layout of ``observation.state``.
        action_layout: Layout of ``action``.
        cameras: Calibration by camera key. Not needed for key poses alone.
        calibration: Names the calibration in errors.
        episodes: Episodes to remember and learn from; all if not given.
        known_objects: Objects by name that are recognised instead of learned.
        known_names: Names of objects in the memory, by which instructions are read.
        lexicon: The words that instructions are read by.
        known_robot: Model of the same robot from earlier demonstrations; says which gripper command closes
            where these episodes do not show it.
        judge: Labels phases, beside motion and gripper.
        segmenter: Finds the objects' masks; None where the demonstrations teach what objects look like.
        shape: What is learned about an object that a segmenter finds.
        make_shapes: Makes the backend that measures objects, for shape "sam3d"; None where there is none.
        is_oracle: Whether object poses come from the simulator instead (oracle ablation only).
    """

    state_layout: VectorLayout
    action_layout: VectorLayout
    cameras: Mapping[str, Camera] | None = None
    calibration: str = "the calibration"
    episodes: Sequence[int] | None = None
    known_objects: Mapping[str, KnownObject] = field(default_factory=dict[str, KnownObject])
    known_names: Collection[str] = frozenset()
    lexicon: Lexicon = ENGLISH
    known_robot: RobotModel | None = None
    judge: LabelPhases | None = None
    segmenter: Segmenter | None = None
    shape: Shape = "demonstrations"
    make_shapes: Callable[[], ShapeBackend | None] | None = None
    is_oracle: bool = False


class DatasetProcessor:
    """Mines key poses from the episodes of a LeRobotDataset.

    Deterministic: every process of a distributed run mines the same.

    Args:
        dataset: The dataset, or LeRobot's metadata of it. If it was opened for some of its episodes only, the
            others are held out, unless the options name episodes.
        options: How to mine it.
    """

    def __init__(self, dataset: LeRobotDataset | LeRobotDatasetMetadata, options: MiningOptions):
        is_open = isinstance(dataset, LeRobotDataset)
        self._meta = dataset.meta if is_open else dataset
        self._options = options
        self._allowed = dataset.episodes if is_open and options.episodes is None else options.episodes

    @cached_property
    def demonstrations(self) -> Demonstrations:
        """The dataset as mining reads it, opened when it is first needed.

        Raises:
            DatasetError: Files or columns are missing.
        """
        # Opened again, because the owner's may lack episodes or augment its images.
        return Demonstrations(
            open_dataset(self._meta), self._options.state_layout, self._options.action_layout
        )

    def mine(self, held_out: bool = False) -> MinedDataset:
        """Find key poses, learn the objects, and choose the frame that each key pose belongs to.

        Args:
            held_out: Whether to find the key poses of held-out episodes too, for a validation loss.

        Raises:
            CalibrationError: No calibration is given, or it does not fit.
            DatasetError: The dataset yields no key poses.
        """
        cameras = self._cameras()
        found = self.key_poses(held_out)
        scenes = learn_scenes(self.demonstrations, found.episodes, cameras)
        shapes = self._options.make_shapes() if self._options.make_shapes else None
        objects = find_objects(
            scenes, found.episodes, self._options.known_objects, np.random.default_rng(0),
            self._options.segmenter, self._options.shape, shapes,
        )  # fmt: skip
        poses, ends, simulator_objects = objects.poses, objects.ends, ()
        if self._options.is_oracle:
            poses, ends, simulator_objects = simulator_poses(
                self.demonstrations, objects.parts, objects.models
            )
        yaw_periods = {name: model.yaw_period for name, model in objects.models.items()}
        surfaces = self._options.lexicon.surfaces
        known = {} if self._options.is_oracle else objects.models
        symmetries = {name: one for name, model in known.items() if (one := model.symmetry) is not None}
        tasks = compare(objects.parts, poses, ends, yaw_periods, surfaces, symmetries)
        return MinedDataset(
            **vars(found), cameras=cameras, objects=objects.models, object_poses=tuple(poses), tasks=tasks,
            unlearned=objects.unlearned, surfaces=surfaces, simulator_objects=simulator_objects,
        )  # fmt: skip

    def key_poses(self, held_out: bool = False) -> MinedKeyPoses:
        """Find key poses only. No image is read, unless a judge of phases looks at some.

        Where the dataset has its key poses in columns, they are read, and no judge is asked.

        Args:
            held_out: Whether to find the key poses of held-out episodes too.

        Raises:
            DatasetError: No episode that may be learned from has key poses. The error gives the reasons.
        """
        demonstrations, name = self.demonstrations, str(self._meta.repo_id)
        allowed = demonstrations.episodes(self._allowed)
        if not allowed:
            raise DatasetError(f"no episode of dataset {name} may be learned from; name some")
        robot = observe_robot(allowed, self._options.known_robot)
        if demonstrations.has_key_poses:
            logger.info("dataset %s has its key poses in columns: they are read", name)
            find = demonstrations.key_poses
        else:
            find = partial(find_key_poses, robot=robot)
        names = set(self._options.known_names)
        mined, skipped = mine_episodes(allowed, find, names, self._options.lexicon)
        if not mined:
            raise DatasetError(
                f"no key poses in the {len(allowed)} episodes of dataset {name}: "
                f"{'; '.join(sorted(set(skipped.values())))}. OpenSPM needs demonstrations in which the "
                "gripper grasps, pushes or turns something"
            )
        if self._options.judge is not None and not demonstrations.has_key_poses:
            mined = self._options.judge(demonstrations, mined, robot)
        others: tuple[MinedEpisode, ...] = ()
        if held_out:
            left = sorted(set(range(self._meta.total_episodes)) - {one.index for one in allowed})
            names |= {name for item in mined for sub_task in item.sub_tasks for name in sub_task.objects}
            others, reasons = mine_episodes(demonstrations.episodes(left), find, names, self._options.lexicon)
            skipped |= reasons
        for index, reason in skipped.items():
            logger.warning("skipping episode %d of %s: %s", index, name, reason)
        return MinedKeyPoses(name, robot, mined, others, skipped)

    def _cameras(self) -> Mapping[str, Camera]:
        """The calibration, compared with the dataset's images."""
        if self._options.cameras is None:
            raise CalibrationError(
                "mining needs the cameras' calibration, got none; pass --policy.cameras=FILE, e.g. "
                "configs/cameras/openspm_tabletop.json"
            )
        shapes = {key: tuple(self._meta.features[key]["shape"]) for key in self._meta.camera_keys}
        # Datasets write the channels last, but some write them first.
        sizes = {key: shape[1:] if shape[0] == 3 else shape[:2] for key, shape in shapes.items()}
        check_sizes(self._options.cameras, sizes, self._options.calibration)
        return self._options.cameras


def mine_episodes(
    episodes: Sequence[Episode],
    find: Callable[[Episode], Sequence[KeyPose]],
    names: Collection[str] = frozenset(),
    lexicon: Lexicon = ENGLISH,
) -> tuple[tuple[MinedEpisode, ...], dict[int, str]]:
    """Find the key poses of episodes, and read their instructions.

    Args:
        episodes: The demonstrations.
        find: Gives an episode's key poses.
        names: Names of objects in the memory, by which instructions are read.
        lexicon: The words that they are read by.

    Returns:
        The episodes with key poses, and by index the reason why the others have none.
    """
    found, skipped = list[tuple[Episode, Sequence[KeyPose]]](), dict[int, str]()
    tasks = read_tasks((episode.task for episode in episodes), names, lexicon)
    for episode in episodes:
        if episode.task not in tasks:
            skipped[episode.index] = f"its task {episode.task!r} says nothing"
        elif key_poses := find(episode):
            found.append((episode, key_poses))
        else:
            skipped[episode.index] = "nothing is grasped or pushed in it"
    taken: dict[str, list[int]] = defaultdict(list)
    for episode, key_poses in found:
        taken[episode.task].append(things_taken(key_poses))
    # The median over a task's demonstrations, because in one of them something may have slipped.
    shown = {task: as_shown(tasks[task], median_low(counts)) for task, counts in taken.items()}
    return tuple(MinedEpisode(one, tuple(poses), shown[one.task]) for one, poses in found), skipped


def compare(
    episodes: Sequence[MinedEpisode],
    object_poses: Sequence[Mapping[str, Array]],
    ends: Sequence[Mapping[str, Array]],
    yaw_periods: Mapping[str, float],
    surfaces: Collection[str] = (),
    symmetries: Mapping[str, Symmetry] | None = None,
) -> tuple[MinedTask, ...]:
    """Compare the demonstrations of each task: anchors, axes, outcomes, and how closely they agree.

    Args:
        episodes: The demonstrations.
        object_poses: For each, ``T_world_obj`` ``(4, 4)`` of the objects found in its first frame.
        ends: For each, the final poses of the objects that it moved.
        yaw_periods: Rotational symmetry of each object about its vertical axis, radians.
        surfaces: Names of what things stand on everywhere, such as the table.
        symmetries: How objects turn into themselves, of those that do.
    """
    by_task: dict[str, list[int]] = defaultdict(list)
    for i, item in enumerate(episodes):
        by_task[item.episode.task].append(i)
    tasks: list[MinedTask] = []
    for members in by_task.values():
        own, sub_tasks = tuple(episodes[i] for i in members), episodes[members[0]].sub_tasks
        found = [Demonstration(episodes[i].key_poses, object_poses[i]) for i in members]
        aligned = align_symmetric(found, yaw_periods)
        anchors = consensus(aligned, sub_tasks, surfaces)
        tasks.append(
            MinedTask(
                episodes=own,
                aligned=tuple(aligned),
                anchors=anchors,
                axes=tuple(constrained_axes(aligned, anchors)),
                qualities=tuple(qualities(aligned, anchors)),
                outcomes=tuple(outcomes(aligned, [ends[i] for i in members], sub_tasks, symmetries)),
            )
        )
    return tuple(tasks)
