"""The objects of demonstrations: learned where the hand touched them, then located in every first frame."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise
from typing import Literal

import numpy as np
from tqdm import tqdm

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import CONTACT_PHASES
from lerobot_openspm.mining.anchors import Demonstration, sub_task_of
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.key_poses import KeyPose
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.mining.outcomes import carried_to, pushed_to
from lerobot_openspm.mining.parts import divided
from lerobot_openspm.perception.objects.base import KnownObject, ShapeBackend
from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.oracle import name_simulator_poses
from lerobot_openspm.perception.pipeline import detect
from lerobot_openspm.types import (
    ContactCue,
    DemonstrationScene,
    Moment,
    PoseEstimate,
    Segmenter,
    Shape,
    SubTask,
    View,
)

logger = logging.getLogger(__name__)

# How many demonstrations of a task are filmed at most, and of all tasks as far as there is one of each; from
# one picture to the next so many frames.
FILMED_PER_TASK, FILMED, FILM_STEP = 10, 30, 4
# The hand may touch an object so many frames before the motion to a contact begins.
FRAMES_BEFORE_CONTACT = 4
# What the hand takes hold of or pushes has its surface within this distance of the hand.
TOUCH_M = 0.08
# What is seen farther than this from where the hand grasped may be another of the kind, or stand on something
# else; one that is nearer by as much is meant, metres.
ASTRAY_M = 0.015
# Where one of these is said, the hand lets go above the landmark.
UPON = ("on", "in", "at")
# A pushed object's final pose counts from this confidence on.
MIN_END_CONFIDENCE = 0.8


def learn_scenes(
    demonstrations: Demonstrations, mined: Sequence[MinedEpisode], cameras: Mapping[str, Camera]
) -> list[DemonstrationScene]:
    """What perception learns from: two frames of every episode, films of some, and what was touched where."""
    scenes, filmed = [], Counter[str]()
    n_tasks = len({item.episode.task for item in mined})
    per_task = int(np.clip(FILMED // max(n_tasks, 1), 1, FILMED_PER_TASK))
    for item in tqdm(mined, desc="Reading images", unit="episode"):
        later = _carried_off(item.key_poses)
        views = demonstrations.views(item.episode, 0, cameras)
        later_views = None if later is None else demonstrations.views(item.episode, later, cameras)
        filmed[item.episode.task] += 1
        is_filmed = filmed[item.episode.task] <= per_task
        film = partial(read_film, demonstrations, item, views) if is_filmed else None
        scenes.append(DemonstrationScene(views, contact_cues(item), later_views, film))
    return scenes


def read_film(
    demonstrations: Demonstrations, item: MinedEpisode, first: Mapping[str, View]
) -> tuple[Moment, ...]:
    """A demonstration as its cameras saw it: those of the hand all the way, the fixed ones at its start.

    Args:
        demonstrations: Where its pictures are.
        item: The demonstration.
        first: What every camera shows in its first frame.
    """
    episode, moved = item.episode, moved_from(item)
    carried = {key: view.camera for key, view in first.items() if view.camera.mount == "ee"}
    pictures = {key: demonstrations.images(episode, key) for key in carried}
    moments = [Moment(dict(first), frozenset())]
    for frame in range(FILM_STEP, len(episode), FILM_STEP):
        T_world_ee = episode.T_world_ee[frame]
        # A copy, because a part of the film would keep the whole of it.
        views = {
            key: View(pictures[key][frame].copy(), camera, camera.T_world_cam(T_world_ee))
            for key, camera in carried.items()
        }
        gone = frozenset(name for name, first_moved in moved.items() if frame >= first_moved)
        moments.append(Moment(views, gone))
    return tuple(moments)


def moved_from(item: MinedEpisode) -> dict[str, int]:
    """From which frame on an episode's objects may have been moved by the hand, by name."""
    moved: dict[str, int] = {}
    for pose in item.key_poses:
        sub_task = sub_task_of(pose, item.sub_tasks)
        if pose.phase not in CONTACT_PHASES:
            continue
        for name in (sub_task.target,) if pose.phase == "grasp" else sub_task.objects:
            moved.setdefault(name, max(pose.frame - pose.n_steps - FRAMES_BEFORE_CONTACT, 1))
    return moved


@dataclass(frozen=True)
class FoundObjects:
    """Object models by name, and poses ``T_world_obj`` ``(4, 4)`` of the objects that each part is about.

    Attributes:
        models: The models.
        parts: The parts of all episodes, in their order, see :func:`divided`.
        poses: Per part, the poses in the first frame of its episode.
        ends: Per part, the final poses of the objects that it moved.
        unlearned: By name, why objects that the hand touched could not be learned.
    """

    models: dict[str, KnownObject]
    parts: list[MinedEpisode]
    poses: list[dict[str, Array]]
    ends: list[dict[str, Array]]
    unlearned: dict[str, str]


def find_objects(
    scenes: Sequence[DemonstrationScene],
    mined: Sequence[MinedEpisode],
    known: Mapping[str, KnownObject],
    rng: np.random.Generator,
    segmenter: Segmenter | None = None,
    shape: Shape = "demonstrations",
    shapes: ShapeBackend | None = None,
) -> FoundObjects:
    """Learn the objects that are not known yet, and find those that each part of an episode is about.

    Args:
        scenes: One per episode.
        mined: The episodes.
        known: Objects by name that are known already.
        rng: Chooses among the demonstrations of an object where there are more than needed.
        segmenter: Finds the objects' masks; None to learn what they look like.
        shape: What is learned about an object that a segmenter finds.
        shapes: Measures objects, for shape "sam3d".
    """
    named = sorted({cue.name for scene in scenes for cue in scene.cues} - set(known))
    models, unlearned = dict(known), dict[str, str]()
    if named:
        logger.info("learning what these look like: %s", ", ".join(named))
        several = _of_several([item.sub_tasks for item in mined])
        learned, unlearned = learn_objects(scenes, rng, known.values(), segmenter, shape, shapes, several)
        models |= learned
    # What several parts call the same is for each what the hand touched in it.
    whole = zip(scenes, mined, strict=True)
    divisions = [
        (replace(scene, cues=contact_cues(part)), part) for scene, item in whole for part in divided(item)
    ]
    found: list[dict[str, Array]] = []
    for scene, item in tqdm(divisions, "Finding objects", unit="demonstration"):
        wanted = dict.fromkeys(name for sub_task in item.sub_tasks for name in sub_task.objects)
        sought = {name: models[name] for name in wanted if name in models}
        estimates = detect_touched(scene, sought, segmenter)
        places = {name: place_touched(models[name], one, scene.cues) for name, one in estimates.items()}
        found.append({name: T for name, T in places.items() if T is not None})
    own_scenes, parts = [scene for scene, _ in divisions], [part for _, part in divisions]
    ends = _ends(own_scenes, parts, found, models, segmenter)
    return FoundObjects(models, parts, found, ends, unlearned)


def _of_several(sub_tasks: Sequence[Sequence[SubTask]]) -> set[str]:
    """Names of which a picture may show several: words tell one from the others, or "both" are asked for."""
    names = {one.target for own in sub_tasks for one, times in Counter(own).items() if times > 1}
    for one in chain(*sub_tasks):
        names |= {one.target} if one.target_where is not None else set()
        names |= {one.landmark} if one.landmark_where is not None else set()
    return names


def detect_touched(
    scene: DemonstrationScene, objects: Mapping[str, KnownObject], segmenter: Segmenter | None = None
) -> dict[str, PoseEstimate]:
    """Find objects in a first frame; where the hand grasped elsewhere, the one of the kind that is nearer.

    Args:
        scene: A demonstration, and where it touched what.
        objects: The objects by name. Of those known by their surface all of a kind can be sought.
        segmenter: As for :func:`find_objects`.
    """
    first = {cue.name: cue for cue in reversed(scene.cues)}
    grasped = {name: cue for name, cue in first.items() if cue.kind == "grasp"}

    def off_m(name: str, one: PoseEstimate) -> float:
        gaps_m = _gaps_m(objects[name], _places(one), grasped[name])
        return np.inf if one.status == "not_found" else min(gaps_m)

    estimates = detect(scene.views, objects, segmenter)
    told = {name: one for name, one in estimates.items() if name in grasped and len(objects[name].points)}
    astray = {name: off_m(name, one) for name, one in told.items() if off_m(name, one) > ASTRAY_M}
    again = detect(scene.views, objects, segmenter, list(astray)) if astray else {}
    near = {name: max(ASTRAY_M, metres - ASTRAY_M) for name, metres in astray.items()}
    return {**estimates, **{name: again[name] for name in astray if off_m(name, again[name]) <= near[name]}}


def _ends(
    scenes: Sequence[DemonstrationScene],
    mined: Sequence[MinedEpisode],
    poses: Sequence[Mapping[str, Array]],
    models: Mapping[str, KnownObject],
    segmenter: Segmenter | None,
) -> list[dict[str, Array]]:
    """Final poses of what each episode moves: of what is carried by the hand's path.

    Of what is pushed by the images, if they show it at the end of most of a task's demonstrations, else by
    the hand's path. They are not mixed: things spring ahead of the hand, and only images show how far.
    """
    seen = [_seen_ends(*one, models, segmenter) for one in zip(scenes, mined, strict=True)]
    tasks = [item.episode.task for item in mined]
    shown = Counter((task, name) for task, ends in zip(tasks, seen, strict=True) for name in ends)
    episodes = Counter(tasks)
    by_images = {key for key, n in shown.items() if 2 * n >= episodes[key[0]]}
    found: list[dict[str, Array]] = []
    for item, starts, ends in zip(mined, poses, seen, strict=True):
        task, demonstration = item.episode.task, Demonstration(item.key_poses, starts)
        points = {name: np.asarray(models[name].points, float) for name in starts}
        pushed = pushed_to(demonstration, item.sub_tasks, points)
        found.append(
            {
                **carried_to(demonstration, item.sub_tasks),
                **{name: T for name, T in pushed.items() if (task, name) not in by_images},
                **{name: T for name, T in ends.items() if (task, name) in by_images},
            }
        )
    return found


def _seen_ends(
    scene: DemonstrationScene,
    item: MinedEpisode,
    models: Mapping[str, KnownObject],
    segmenter: Segmenter | None,
) -> dict[str, Array]:
    """Final poses of what an episode pushes, as far as the images show them clearly."""
    pushed = {sub_task_of(p, item.sub_tasks).target for p in item.key_poses if p.phase == "push"}
    sought = {name: models[name] for name in sorted(pushed) if name in models}
    if not sought or scene.later_views is None:
        return {}
    seen = detect(scene.later_views, sought, segmenter)
    sure = {k: e for k, e in seen.items() if e.status == "found" and e.confidence >= MIN_END_CONFIDENCE}
    return {name: estimate.T_world_obj for name, estimate in sure.items()}


def place_touched(model: KnownObject, estimate: PoseEstimate, touched: Sequence[ContactCue]) -> Array | None:
    """Pose of an object in a first frame; of several that look alike, that of the one the hand went to.

    Args:
        model: The object.
        estimate: Where one or several such objects are seen.
        touched: Where the demonstration touched what; only its first touch is of what the first frame shows.

    Returns:
        ``T_world_obj`` ``(4, 4)``. None if it is not known, or if the hand took hold of something elsewhere.
    """
    cue = next((one for one in touched if one.name == model.name), None)
    if estimate.status == "not_found" or (estimate.status == "ambiguous" and cue is None):
        return None
    if cue is None:
        return estimate.T_world_obj
    places = _places(estimate)
    gaps = _gaps_m(model, places, cue)
    nearest = int(np.argmin(gaps))
    is_elsewhere = cue.kind != "release" and len(model.points) > 0 and gaps[nearest] > TOUCH_M
    return None if is_elsewhere else places[nearest]


def _places(estimate: PoseEstimate) -> tuple[Array, ...]:
    return estimate.T_world_obj, *estimate.others


def _gaps_m(model: KnownObject, places: Sequence[Array], cue: ContactCue) -> list[float]:
    """How far an object's surface is at each place from where the hand was; from above unless it grasped."""
    points = np.asarray(model.points, float) if len(model.points) else np.zeros((1, 3))
    axes = 3 if cue.kind == "grasp" and len(model.points) else 2
    away = [(se3.apply(T, points) - cue.point_world)[:, :axes] for T in places]
    return [float(np.linalg.norm(one, axis=1).min()) for one in away]


def simulator_poses(
    demonstrations: Demonstrations, mined: Sequence[MinedEpisode], models: Mapping[str, KnownObject]
) -> tuple[list[dict[str, Array]], list[dict[str, Array]], tuple[str, ...]]:
    """The simulator's poses of the named objects instead of perception's (oracle ablation only).

    Returns:
        Poses per episode in its first frame, those of the targets in its last one, and the simulator's object
        names in the order of its pose vector.
    """
    found, ends, names = [], [], ()
    for item in mined:
        frames = 0, len(item.episode) - 1
        first, last = (demonstrations.simulator_poses(item.episode, frame) for frame in frames)
        names = tuple(first)
        nouns = sorted({name for sub_task in item.sub_tasks for name in sub_task.objects})
        targets = sorted({sub_task.target for sub_task in item.sub_tasks})
        found.append(name_simulator_poses(first, nouns, models))
        ends.append(name_simulator_poses(last, targets, models))
    return found, ends, names


def contact_cues(item: MinedEpisode) -> tuple[ContactCue, ...]:
    """Where the hand touched the objects of the instruction, for perception to learn their looks from."""
    found: list[ContactCue] = []

    def add(name: str, pose: KeyPose, kind: Literal["grasp", "release", "contact"]) -> None:
        found.append(ContactCue(name, pose.T_world_ee[:3, 3], kind, f"{item.episode.task}: {len(found)}"))

    opened = {(one.target, one.part) for one in item.sub_tasks if one.operation == "open"}
    for pose in item.key_poses:
        sub_task = sub_task_of(pose, item.sub_tasks)
        if pose.phase == "grasp":
            add(sub_task.target, pose, "grasp")
        # What is opened first was shut in the first frame, so that the release is inside it.
        is_seen = sub_task.relation in UPON and (sub_task.landmark, sub_task.part) not in opened
        # A demonstration that is cut when its goal is reached would have let go there.
        is_cut = pose.phase == "place" and pose is item.key_poses[-1]
        if (pose.phase == "release" or is_cut) and is_seen:
            add(sub_task.landmark, pose, "release")
    for before, pose in pairwise(item.key_poses):
        pushing, pushed = (sub_task_of(one, item.sub_tasks) for one in (pose, before))
        if pose.phase == "push" != before.phase and pushing.operation != "close":
            add(pushing.target, before, "contact")
        elif before.phase == "push" != pose.phase and pushed.operation == "close":
            # The hand sets out before a door or a drawer, and ends where that belongs.
            add(pushed.target, before, "contact")
    last = item.key_poses[-1] if item.key_poses else None
    if last is not None and last.phase == "push" and sub_task_of(last, item.sub_tasks).operation == "close":
        add(sub_task_of(last, item.sub_tasks).target, last, "contact")
    return tuple(found)


def _carried_off(key_poses: Sequence[KeyPose]) -> int | None:
    """A frame in which the moved object is elsewhere and the hand has let go; None if nothing was moved."""
    moved = [pose.frame for pose in key_poses if pose.phase in ("retreat", "push")]
    return max(moved) if moved else None
