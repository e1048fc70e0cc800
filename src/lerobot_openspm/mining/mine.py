"""From a dataset to an experience: key poses, object models, anchors, memory entries."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.compound import sub_task_index
from lerobot_openspm.memory.entry import Anchor, Axis, MemoryEntry, MemoryKeyPose, RetrievalKey, SubTask
from lerobot_openspm.memory.instruction import read_tasks
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.anchors import (
    CONTACT_PHASES,
    Demonstration,
    Role,
    align_symmetric,
    as_shown,
    consensus,
    qualities,
    roles,
    sub_task_of,
)
from lerobot_openspm.mining.axes import constrained_axes
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.key_poses import KeyPose, find_key_poses
from lerobot_openspm.mining.outcomes import carried_to, outcomes
from lerobot_openspm.mining.signals import Episode
from lerobot_openspm.perception.learning import Shape, learn_objects
from lerobot_openspm.perception.localise import localise_all
from lerobot_openspm.perception.model import KnownObject
from lerobot_openspm.perception.object_shape import ShapeBackend
from lerobot_openspm.perception.types import Hint, PoseEstimate, Scene, Segmenter

logger = logging.getLogger(__name__)

# Least confidence at which a pushed object is believed to be where it is seen in the end.
SURE = 0.8


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
        mined: Episodes with key poses.
        skipped: Reason by episode index for those without.
    """

    mined: tuple[MinedEpisode, ...]
    skipped: dict[int, str]


def mine_key_poses(
    demonstrations: Demonstrations,
    robot: RobotModel,
    indices: Sequence[int] | None = None,
    names: Collection[str] = frozenset(),
) -> MinedKeyPoses:
    """Find the key poses of episodes. Reads no image.

    Args:
        demonstrations: The dataset.
        robot: The robot that gave them.
        indices: The episodes; all if not given.
        names: Names of the things that a memory holds already, by which instructions are read.

    Raises:
        DatasetError: No episode has any. The error gives the reasons.
    """
    episodes = demonstrations.episodes(indices)
    mined, skipped = [], {}
    tasks = read_tasks((episode.task for episode in episodes), names)
    for episode in episodes:
        key_poses = find_key_poses(episode, robot)
        if episode.task not in tasks:
            skipped[episode.index] = f"its task {episode.task!r} says nothing"
        elif key_poses:
            sub_tasks = as_shown(tasks[episode.task], key_poses)
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
    return MinedKeyPoses(tuple(mined), skipped)


def learn_scenes(
    demonstrations: Demonstrations, mined: Sequence[MinedEpisode], cameras: Mapping[str, Camera]
) -> list[Scene]:
    """What perception may learn from: two frames of every episode, and where the hand touched what."""
    scenes = []
    for item in tqdm(mined, desc="Reading images", unit="episode"):
        later = _carried_off(item.key_poses)
        views = demonstrations.views(item.episode, 0, cameras)
        later_views = None if later is None else demonstrations.views(item.episode, later, cameras)
        scenes.append(Scene(views, hints(item), later_views))
    return scenes


@dataclass(frozen=True)
class LearnedObjects:
    """Object models by name, and poses ``T_world_obj`` ``(4, 4)`` of the objects found in each scene.

    Attributes:
        models: The objects.
        layouts: Per scene, where they stood in its first frame.
        ends: Per scene, where those that were moved ended.
    """

    models: dict[str, KnownObject]
    layouts: list[dict[str, Array]]
    ends: list[dict[str, Array]]


def layouts_in_scenes(
    scenes: Sequence[Scene],
    mined: Sequence[MinedEpisode],
    known: Mapping[str, KnownObject],
    rng: np.random.Generator,
    segmenter: Segmenter | None = None,
    shape: Shape = "demonstrations",
    shapes: ShapeBackend | None = None,
) -> LearnedObjects:
    """Learn the objects that are not known yet, and find those that each episode's instruction names.

    Args:
        scenes: One per episode.
        mined: The episodes.
        known: Objects by name that are known already.
        rng: Chooses among the demonstrations of an object where there are more than needed.
        segmenter: Finds the objects' masks; None to learn what they look like.
        shape: What is learned of an object that a segmenter finds.
        shapes: Tells the sizes of objects, for shape "sam3d".
    """
    named = sorted({hint.name for scene in scenes for hint in scene.hints} - set(known))
    models = dict(known)
    if named:
        logger.info("learning what these look like: %s", ", ".join(named))
        learned = learn_objects(scenes, rng, known.values(), segmenter, shape, shapes)
        models |= learned
        if missing := [name for name in named if name not in learned]:
            logger.warning("could not learn what %s looks like; no key pose will be anchored there", missing)
    layouts, ends = [], []
    for scene, item in tqdm(zip(scenes, mined, strict=True), "Finding objects", len(scenes), unit="episode"):
        wanted = dict.fromkeys(name for sub_task in item.sub_tasks for name in sub_task.objects)
        sought = {name: models[name] for name in wanted if name in models}
        estimates = localise_all(scene.views, sought, segmenter)
        places = {name: _place(name, estimate, scene.hints) for name, estimate in estimates.items()}
        layouts.append({name: T for name, T in places.items() if T is not None})
        ends.append(_ends(scene, item, layouts[-1], models, segmenter))
    return LearnedObjects(models, layouts, ends)


def _ends(
    scene: Scene,
    item: MinedEpisode,
    layout: Mapping[str, Array],
    models: Mapping[str, KnownObject],
    segmenter: Segmenter | None,
) -> dict[str, Array]:
    """Where an episode leaves what it moves: the carried by the hand's path, the pushed by the images."""
    carried = carried_to(Demonstration(item.key_poses, layout), item.sub_tasks)
    pushed = {sub_task_of(p, item.sub_tasks).target for p in item.key_poses if p.phase == "push"}
    sought = {name: models[name] for name in sorted(pushed) if name in models}
    if not sought or scene.later_views is None:
        return carried
    seen = localise_all(scene.later_views, sought, segmenter)
    sure = {k: e.T_world_obj for k, e in seen.items() if e.status == "found" and e.confidence >= SURE}
    return {**carried, **sure}


def _place(name: str, estimate: PoseEstimate, touched: Sequence[Hint]) -> Array | None:
    """Where an object is; of several that look alike, the one that the hand went to. None if unknown."""
    points = [hint.point_world[:2] for hint in touched if hint.name == name]
    if estimate.status == "not_found" or (estimate.status == "ambiguous" and not points):
        return None
    if not estimate.others or not points:
        return estimate.T_world_obj
    places = (estimate.T_world_obj, *estimate.others)
    return min(places, key=lambda T: float(np.linalg.norm(np.asarray(points) - T[:2, 3], axis=1).min()))


def oracle_layouts(
    demonstrations: Demonstrations, mined: Sequence[MinedEpisode], models: Mapping[str, KnownObject]
) -> tuple[list[dict[str, Array]], tuple[str, ...]]:
    """The simulator's poses of the named objects instead of perception's (oracle ablation only).

    Returns:
        Poses per episode, and the simulator's object names in the order of its pose vector.
    """
    layouts, names = [], ()
    for item in mined:
        poses = demonstrations.simulator_poses(item.episode, 0)
        names = tuple(poses)
        nouns = sorted({name for sub_task in item.sub_tasks for name in sub_task.objects})
        layouts.append(name_simulator_poses(poses, nouns, models))
    return layouts, names


def name_simulator_poses(
    poses: Mapping[str, Array], nouns: Sequence[str], models: Mapping[str, KnownObject]
) -> dict[str, Array]:
    """Simulator poses under the nouns of the instructions: "bottle" is the "wine bottle".

    The yaw of a body of revolution is dropped, as perception, which cannot see it, does.
    """
    named = {}
    for noun in nouns:
        match = next((name for name in poses if name in noun.split()), None)
        if match is None:
            continue
        T = poses[match]
        turns = noun not in models or models[noun].yaw_period > 0
        named[noun] = T if turns else se3.transform(np.eye(3), T[:3, 3])
    return named


def hints(item: MinedEpisode) -> tuple[Hint, ...]:
    """Where the hand touched the objects of the instruction, for perception to learn their looks from."""
    found = []
    for pose in item.key_poses:
        sub_task, point = sub_task_of(pose, item.sub_tasks), pose.T_world_ee[:3, 3]
        if pose.phase == "grasp":
            found.append(Hint(sub_task.target, point, "grasp", f"{item.episode.task}: {len(found)}"))
        elif pose.phase == "release" and sub_task.relation and not sub_task.part:
            # What goes into an opened part lies where nothing was to be seen in the first frame.
            found.append(Hint(sub_task.landmark, point, "release", f"{item.episode.task}: {len(found)}"))
    for before, pose in zip(item.key_poses[:-1], item.key_poses[1:], strict=True):
        if pose.phase == "push":
            target = sub_task_of(pose, item.sub_tasks).target
            place = f"{item.episode.task}: {len(found)}"
            found.append(Hint(target, before.T_world_ee[:3, 3], "contact", place))
    return tuple(found)


def _carried_off(key_poses: Sequence[KeyPose]) -> int | None:
    """A frame in which the first grasped or pushed object is elsewhere and the hand has let go."""
    moved = [pose.frame for pose in key_poses if pose.phase in ("retreat", "push")]
    return max(moved) if moved else None


def build_entries(
    mined: Sequence[MinedEpisode],
    layouts: Sequence[Mapping[str, Array]],
    ends: Sequence[Mapping[str, Array]],
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
        ended = outcomes(group, [ends[i] for i in members], sub_tasks)
        judged = zip(
            members, group, constrained_axes(group, anchors), qualities(group, anchors), ended, strict=True
        )
        for i, demonstration, axes, quality, shown in judged:
            key_poses = _remember(demonstration, anchors, axes, len(sub_tasks))
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
            known = tuple(one for one in shown if all(name in layout for name in one.objects))
            entries.append(
                MemoryEntry(key, mined[i].episode.task, key_poses, quality, 1, where, layout, outcomes=known)
            )
    return tuple(entries)


def _remember(
    demonstration: Demonstration,
    anchors: Mapping[Role, Anchor],
    axes: Mapping[Role, Axis],
    n_sub_tasks: int,
) -> tuple[MemoryKeyPose, ...] | None:
    """Express key poses in their anchors' frames; None if a contact's anchor was not found."""
    kept = []
    for role, pose in zip(roles(demonstration.key_poses), demonstration.key_poses, strict=True):
        anchor = anchors.get(role)
        if anchor is None or any(name not in demonstration.layout for name in anchor.objects):
            if pose.phase in CONTACT_PHASES:
                return None
            continue
        T_obj_ee = se3.inverse(anchor.frame(demonstration.layout)) @ pose.T_world_ee
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
                axes.get(role),
                sub_task_index(pose.contact, pose.phase, n_sub_tasks),
            )
        )
    return tuple(kept)
