"""Teaching by memory alone: a task's demonstrations become memory entries, and no weight changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_openspm.checkpoint import check_labels
from lerobot_openspm.configuration_openspm import OpenSPMConfig, feature_names
from lerobot_openspm.errors import DatasetError, LayoutError
from lerobot_openspm.geometry.camera import Camera, load_cameras
from lerobot_openspm.language.instruction import read_tasks
from lerobot_openspm.language.lexicon import read_lexicon
from lerobot_openspm.language.own_words import normal_words
from lerobot_openspm.memory.entry import MemoryEntry, episode_of
from lerobot_openspm.memory.indexed_entries import known_names
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.training import dataset_processor, memory_of
from lerobot_openspm.types import Segmenter, SubTask

# Beside a dataset's own metadata, where `openspm collect` writes the cameras that recorded it.
DATASET_CAMERAS = "openspm_cameras.json"


@dataclass(frozen=True)
class Lesson:
    """What a memory was taught.

    Attributes:
        learned: The new entries, and the models of their objects: what is appended to a memory.
        known_before: How many entries each taught instruction had in the memory before.
        skipped: Episodes that gave no entry.
        objects_learned: Objects that were not known before.
        objects_recognised: Objects of the taught tasks that were.
    """

    learned: Memory
    known_before: dict[str, int]
    skipped: tuple[int, ...]
    objects_learned: tuple[str, ...]
    objects_recognised: tuple[str, ...]

    @property
    def entries(self) -> tuple[MemoryEntry, ...]:
        """The new entries."""
        return tuple(self.learned.entries)

    @property
    def instructions(self) -> tuple[str, ...]:
        """The taught instructions, each once."""
        return tuple(dict.fromkeys(entry.language for entry in self.entries))


def teach(
    memory: Memory,
    config: OpenSPMConfig,
    dataset_meta: Any,
    episodes: Sequence[int] | None = None,
    segmenter: Segmenter | None = None,
) -> tuple[Memory, Lesson]:
    """Append a dataset's demonstrations to a memory.

    Objects that are known are recognised by what is known of them; others are learned from these episodes.
    Where the configuration names no calibration, the dataset's own is used, else the memory's.

    Args:
        memory: What is known. It stays as it is.
        config: The configuration of the policy that knows it.
        dataset_meta: LeRobot's metadata of the dataset.
        episodes: The episodes to teach; all if not given.
        segmenter: Finds the objects' masks, where the configuration's perception has masks.

    Returns:
        The memory with the new entries and objects, and what is new in it.

    Raises:
        DatasetError: There is no such episode, or its instruction says nothing, or an instruction's episodes
            show no key poses, or none of them shows all objects of it where it begins.
        LayoutError: The dataset's state or action is not laid out as the policy's.
        CalibrationError, MemoryFormatError: The cameras or the robot are others.
    """
    wanted = _episodes(dataset_meta, episodes)
    _check_layouts(dataset_meta, config)
    tasks = _tasks(dataset_meta, wanted)
    settings = replace(config, memory_episodes=wanted)
    processor = dataset_processor(dataset_meta, settings, memory, _cameras(dataset_meta, memory), segmenter)
    mined = memory_of(processor.mine(), settings)
    # With few demonstrations nothing shows that an anchor is wrong, so all its objects have to be found.
    added = tuple(entry for entry in mined.entries if not _unseen(entry))
    for task in dict.fromkeys(tasks.values()):
        read = read_tasks([task], known_names(memory.entries), read_lexicon(config.lexicon))[task]
        if not _is_shown([i for i, told in tasks.items() if told == task], added, read):
            raise DatasetError(_nothing_learned(dataset_meta.repo_id, task, tasks, mined, read))
    named = dict.fromkeys(name for entry in added for name in entry.object_poses)
    objects = {name: mined.objects[name] for name in named if name in mined.objects}
    learned = replace(mined, entries=added, objects=objects)
    result = memory.appended(learned)
    check_labels(result, config.segmenter.labels, f"the checkpoint of {config.type}")
    used = {episode_of(entry.source) for entry in added}
    skipped = tuple(i for i in wanted if i not in used)
    return result, _lesson(memory, learned, skipped)


def _is_shown(episodes: Sequence[int], entries: Sequence[MemoryEntry], read: Sequence[SubTask]) -> bool:
    """Whether an episode has entries of all sub-tasks of its instruction; of any, where it is only words."""
    shown = Counter[int]()
    for entry in entries:
        shown[episode_of(entry.source)] += len(entry.key.sub_tasks)
    needed = 1 if read[0].words else len(read)
    return any(shown[i] >= needed for i in episodes)


def _lesson(memory: Memory, learned: Memory, skipped: tuple[int, ...]) -> Lesson:
    """What is new beside a memory."""
    named = dict.fromkeys(name for entry in learned.entries for name in entry.object_poses)
    before = Counter(entry.language for entry in memory.entries)
    return Lesson(
        learned=learned,
        known_before={task: before[task] for task in dict.fromkeys(one.language for one in learned.entries)},
        skipped=skipped,
        objects_learned=tuple(name for name in named if name not in memory.objects),
        objects_recognised=tuple(name for name in named if name in memory.objects),
    )


def _cameras(dataset_meta: Any, memory: Memory) -> dict[str, Camera]:
    """The calibration that lies in the dataset, else the memory's."""
    own = Path(dataset_meta.root) / "meta" / DATASET_CAMERAS
    return load_cameras(own) if own.is_file() else memory.cameras


def _episodes(dataset_meta: Any, episodes: Sequence[int] | None) -> list[int]:
    """The episodes to teach, each once."""
    total = int(dataset_meta.total_episodes)
    wanted = list(dict.fromkeys(range(total) if episodes is None else episodes))
    if bad := [index for index in wanted if not 0 <= index < total]:
        raise DatasetError(f"dataset {dataset_meta.repo_id} has episodes 0 to {total - 1}, got {bad}")
    if not wanted:
        raise DatasetError(f"no episode of dataset {dataset_meta.repo_id} is asked for; name some to teach")
    return wanted


def _check_layouts(dataset_meta: Any, config: OpenSPMConfig) -> None:
    """The dataset's numbers have to mean what the policy's do."""
    for what, key, ours in (
        ("state", "observation.state", config.state_layout),
        ("action", "action", config.action_layout),
    ):
        feature = dataset_meta.features.get(key)
        if feature is None:
            raise DatasetError(
                f"dataset {dataset_meta.repo_id} lacks {key!r}; it has {sorted(dataset_meta.features)}"
            )
        theirs = feature_names(feature.get("names")) or ours
        if theirs != ours or feature["shape"][0] != len(ours or ()):
            raise LayoutError(
                f"the {what} of dataset {dataset_meta.repo_id} is {theirs} ({feature['shape'][0]} numbers), "
                f"the checkpoint's is {ours}: it was recorded with another robot, or its features have other "
                "names; teach demonstrations of the checkpoint's robot, or rename the features in the "
                "dataset's meta/info.json"
            )


def _tasks(dataset_meta: Any, wanted: Sequence[int]) -> dict[int, str]:
    """Instruction by episode; each has words to find it by."""
    tasks = {}
    for index in wanted:
        told = dataset_meta.episodes[index]["tasks"]
        tasks[index] = str(told if isinstance(told, str) else told[0])
        if not normal_words(tasks[index]):
            raise DatasetError(
                f"episode {index} of dataset {dataset_meta.repo_id} has the task {tasks[index]!r}, expected "
                "an instruction to find it by; give the episode a task, or leave it out of --dataset.episodes"
            )
    return tasks


def _unseen(entry: MemoryEntry) -> list[str]:
    """Objects of an entry's instruction that were not found in the first frame.

    Where the instruction is kept by its words, only what the hand took counts: the words may name more than
    what can be seen.
    """
    named = dict.fromkeys(
        name
        for sub_task in entry.key.sub_tasks
        for name in ((sub_task.target,) if sub_task.words else sub_task.objects)
    )
    return [name for name in named if name not in entry.object_poses]


def _nothing_learned(
    name: str, task: str, tasks: dict[int, str], mined: Memory, read: Sequence[SubTask]
) -> str:
    """Why an instruction has no entry."""
    episodes = [index for index, told in tasks.items() if told == task]
    own = [entry for entry in mined.entries if episode_of(entry.source) in episodes]
    unseen = sorted({name for entry in own for name in _unseen(entry)})
    if not unseen:
        named = (one for sub_task in read for one in sub_task.objects)
        unseen = sorted(set(named) - set(mined.objects))
    why = f"could not find {' and '.join(unseen)}" if unseen else "found no key poses with all their anchors"
    return (
        f"{task!r} was not learned from episodes {episodes} of dataset {name}: {why} in their first frames; "
        "check --policy.cameras, record with the hand away from the objects at the start, or teach more "
        "episodes"
    )
