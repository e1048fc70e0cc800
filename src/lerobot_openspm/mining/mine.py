"""From a dataset to an experience: key poses, object models, anchors, memory entries."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from tqdm import tqdm

from lerobot_openspm.errors import DatasetError, InstructionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose, RetrievalKey, SubTask
from lerobot_openspm.memory.instruction import parse_instruction
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.anchors import (
    CONTACT_PHASES,
    Demonstration,
    align_symmetric,
    consensus,
    qualities,
    roles,
    sub_task_of,
)
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.key_poses import KeyPose, find_key_poses
from lerobot_openspm.mining.signals import Episode, observe_robot
from lerobot_openspm.perception.learning import learn_objects
from lerobot_openspm.perception.localise import localise, prepare
from lerobot_openspm.perception.model import ObjectModel
from lerobot_openspm.perception.types import Hint, Scene

logger = logging.getLogger(__name__)

PerceptionSource = Literal["demonstrations", "oracle"]


@dataclass(frozen=True)
class MinedEpisode:
    """An episode with its key poses and what its instruction asks for."""

    episode: Episode
    key_poses: tuple[KeyPose, ...]
    sub_tasks: tuple[SubTask, ...]


@dataclass(frozen=True)
class MinedKeyPoses:
    """What the parquet columns alone tell.

    Attributes:
        robot: The robot that gave the demonstrations.
        mined: Episodes with key poses.
        skipped: Reason by episode index for those without.
    """

    robot: RobotModel
    mined: tuple[MinedEpisode, ...]
    skipped: dict[int, str]


def mine_key_poses(demonstrations: Demonstrations, indices: Sequence[int] | None = None) -> MinedKeyPoses:
    """Find the key poses of episodes. Reads no image.

    Raises:
        DatasetError: No episode has any. The error gives the reasons.
    """
    episodes = demonstrations.episodes(indices)
    robot = observe_robot(episodes)
    mined, skipped = [], {}
    for episode in episodes:
        try:
            sub_tasks = parse_instruction(episode.task)
        except InstructionError as error:
            skipped[episode.index] = str(error)
            continue
        key_poses = find_key_poses(episode, robot)
        if key_poses:
            mined.append(MinedEpisode(episode, tuple(key_poses), sub_tasks))
        else:
            skipped[episode.index] = "nothing is grasped or pushed in it"
    for index, reason in skipped.items():
        logger.warning("skipping episode %d of %s: %s", index, demonstrations.name, reason)
    if not mined:
        reasons = "; ".join(sorted(set(skipped.values()))) or "it has no episodes"
        raise DatasetError(
            f"no key poses in the {len(episodes)} episodes of dataset {demonstrations.name}: {reasons}. "
            "OpenSPM needs demonstrations in which the gripper grasps, pushes or turns something"
        )
    return MinedKeyPoses(robot, tuple(mined), skipped)


def learn_from_images(
    demonstrations: Demonstrations,
    mined: Sequence[MinedEpisode],
    cameras: Mapping[str, Camera],
    rng: np.random.Generator,
) -> tuple[dict[str, ObjectModel], list[dict[str, Array]]]:
    """Learn the objects from two frames an episode, and find them in the first frame of each.

    Returns:
        Models by name, and per episode the poses ``T_world_obj`` of the objects that were found.
    """
    scenes = []
    for item in tqdm(mined, desc="Reading images", unit="episode", leave=False):
        later = _carried_off(item.key_poses)
        views = demonstrations.views(item.episode, 0, cameras)
        later_views = None if later is None else demonstrations.views(item.episode, later, cameras)
        scenes.append(Scene(views, hints(item), later_views))
    models = learn_objects(scenes, rng)
    named = sorted({name for item in mined for sub_task in item.sub_tasks for name in sub_task.objects})
    if missing := [name for name in named if name not in models]:
        logger.warning("could not learn what %s looks like; key poses will not be anchored there", missing)
    layouts = []
    for scene in tqdm(scenes, desc="Finding objects", unit="episode", leave=False):
        prepared = {key: prepare(view) for key, view in scene.views.items()}
        estimates = {name: localise(prepared, model) for name, model in models.items()}
        layouts.append({name: e.T_world_obj for name, e in estimates.items() if e.status == "found"})
    return models, layouts


def hints(item: MinedEpisode) -> tuple[Hint, ...]:
    """Where the hand touched the objects of the instruction, for perception to learn their looks from."""
    found = []
    for pose in item.key_poses:
        sub_task, point = sub_task_of(pose, item.sub_tasks), pose.T_world_ee[:3, 3]
        if pose.phase == "grasp":
            found.append(Hint(sub_task.target, point, "grasp"))
        elif pose.phase == "release" and sub_task.landmark and not sub_task.part:
            # What goes into an opened part lies where nothing was to be seen in the first frame.
            found.append(Hint(sub_task.landmark, point, "release"))
    for before, pose in zip(item.key_poses[:-1], item.key_poses[1:], strict=True):
        if pose.phase == "push":
            target = sub_task_of(pose, item.sub_tasks).target
            found.append(Hint(target, before.T_world_ee[:3, 3], "contact"))
    return tuple(found)


def _carried_off(key_poses: Sequence[KeyPose]) -> int | None:
    """A frame in which the first grasped or pushed object is elsewhere and the hand has let go."""
    moved = [pose.frame for pose in key_poses if pose.phase in ("retreat", "push")]
    return max(moved) if moved else None


def build_entries(
    mined: Sequence[MinedEpisode],
    layouts: Sequence[Mapping[str, Array]],
    yaw_periods: Mapping[str, float],
    source: str,
) -> tuple[MemoryEntry, ...]:
    """Make a memory entry of every demonstration whose anchors were found, task by task."""
    by_task: dict[str, list[int]] = defaultdict(list)
    for i, item in enumerate(mined):
        by_task[item.episode.task].append(i)
    entries = []
    for members in by_task.values():
        sub_tasks = mined[members[0]].sub_tasks
        group = align_symmetric([Demonstration(mined[i].key_poses, layouts[i]) for i in members], yaw_periods)
        anchors = consensus(group, sub_tasks)
        for i, demonstration, quality in zip(members, group, qualities(group, anchors), strict=True):
            key_poses = _remember(demonstration, anchors)
            if key_poses is None:
                logger.warning(
                    "skipping episode %d of %s: its anchors were not found", mined[i].episode.index, source
                )
                continue
            key = RetrievalKey(sub_tasks, tuple(pose.phase for pose in key_poses))
            where = f"{source}#{mined[i].episode.index}"
            layout = {
                name: T
                for name, T in demonstration.layout.items()
                if any(name in s.objects for s in sub_tasks)
            }
            entries.append(MemoryEntry(key, mined[i].episode.task, key_poses, quality, 1, where, layout))
    return tuple(entries)


def _remember(
    demonstration: Demonstration, anchors: Mapping[tuple[int, str, int], str]
) -> tuple[MemoryKeyPose, ...] | None:
    """Express key poses in their anchors' frames; None if a contact's anchor was not found."""
    kept = []
    for role, pose in zip(roles(demonstration.key_poses), demonstration.key_poses, strict=True):
        anchor = anchors.get(role)
        if anchor not in demonstration.layout:
            if pose.phase in CONTACT_PHASES:
                return None
            continue
        T_obj_ee = se3.inverse(demonstration.layout[anchor]) @ pose.T_world_ee
        kept.append(
            MemoryKeyPose(
                anchor,
                T_obj_ee,
                pose.phase,
                pose.confidence,
                pose.closed,
                pose.opening,
                pose.n_steps,
                pose.dwell,
            )
        )
    return tuple(kept)
