"""Writes mined key poses into a copy of the dataset: columns to train on, sub-tasks for viewers."""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from lerobot.annotations.steerable_pipeline.reader import EpisodeRecord, iter_episodes
from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
from lerobot.annotations.steerable_pipeline.writer import LanguageColumnsWriter
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import modify_features
from lerobot.datasets.io_utils import load_info, write_info
from lerobot.datasets.language import (
    LANGUAGE_COLUMNS,
    LANGUAGE_EVENTS,
    LANGUAGE_PERSISTENT,
    language_feature_info,
)
from lerobot.utils.constants import OBS_STATE

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.files import rename
from lerobot_openspm.language.descriptions import phase_phrase
from lerobot_openspm.mining.anchors import sub_task_of
from lerobot_openspm.mining.columns import TARGET, TYPES, encode_key_poses, features
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.mined import MinedEpisode, MinedKeyPoses

logger = logging.getLogger(__name__)


def check_folder(demonstrations: Demonstrations, folder: Path) -> None:
    """Check before the long work whether an annotated dataset can be written.

    Raises:
        DatasetError: The folder exists, or lies in the dataset's, or the dataset has such columns already.
    """
    name, root = demonstrations.name, Path(demonstrations.dataset.root).resolve()
    if folder.exists():
        raise DatasetError(f"{folder} exists already; choose another --annotated, or remove it")
    if folder.resolve().is_relative_to(root):
        raise DatasetError(
            f"{folder} lies in the folder of dataset {name}; choose an --annotated beside {root}, not in it"
        )
    if present := [key for key in (*TYPES, TARGET) if key in demonstrations.dataset.features]:
        raise DatasetError(
            f"dataset {name} in {root} has the columns {', '.join(present)} already; mine the dataset that "
            "it was made from"
        )


def write_annotated(demonstrations: Demonstrations, mined: MinedKeyPoses, folder: Path) -> None:
    """Write a copy of a dataset with the mined key poses as columns of its frames.

    Its videos are links to the dataset's. It is written beside its place and then renamed, so that an
    interruption leaves no half of a folder.

    Args:
        demonstrations: The dataset.
        mined: What was mined of it.
        folder: Where the copy goes.

    Raises:
        DatasetError: See :func:`check_folder`.
    """
    check_folder(demonstrations, folder)
    beside = folder.with_name(f".{folder.name}.partial")
    if beside.exists():  # of an interrupted run
        shutil.rmtree(beside)
    beside.parent.mkdir(parents=True, exist_ok=True)
    dataset, every = demonstrations.dataset, (*mined.episodes, *mined.held_out)
    try:
        _write_columns(demonstrations, every, beside)
        _write_sub_tasks(dataset, every, beside)
        _link_the_rest(Path(dataset.root), beside)
        _describe(dataset, beside)
        # Read by LeRobot before it is put in its place.
        LeRobotDataset(dataset.repo_id, root=beside, video_backend="pyav")
        rename(beside, folder)
    except BaseException:
        shutil.rmtree(beside, ignore_errors=True)
        raise


def _write_columns(demonstrations: Demonstrations, mined: Sequence[MinedEpisode], root: Path) -> None:
    """Write the frames with the new columns, by LeRobot's tools; videos and language are left out."""
    dataset, states = demonstrations.dataset, demonstrations.states()
    columns = encode_key_poses(states, ())
    for item in mined:
        frames = slice(item.episode.from_index, item.episode.from_index + len(item.episode))
        for name, values in encode_key_poses(states[frames], item.key_poses).items():
            columns[name][frames] = values
    described = features(dataset.features[OBS_STATE])
    added: dict[str, Any] = {name: (values, described[name]) for name, values in columns.items()}
    left_out = [*dataset.meta.video_keys, *(key for key in LANGUAGE_COLUMNS if key in dataset.features)]
    # LeRobot opens the copy and warns of missing video decoders; none is needed here.
    decoders = logging.getLogger("lerobot.utils.import_utils")
    level = decoders.level
    decoders.setLevel(logging.ERROR)
    try:
        modify_features(dataset, added, left_out or None, root, dataset.repo_id)
    finally:
        decoders.setLevel(level)


def _write_sub_tasks(dataset: LeRobotDataset, mined: Sequence[MinedEpisode], root: Path) -> None:
    """Write the phases as lerobot-annotate writes sub-tasks. Rows that it wrote before stay."""
    by_index, records = {item.episode.index: item for item in mined}, list(iter_episodes(root))
    with tempfile.TemporaryDirectory() as folder:
        for record in records:
            rows = _rows_before(dataset, record)
            item = by_index.get(record.episode_index)
            if item is not None and not any(row["style"] == "subtask" for row in rows):
                rows += _sub_task_rows(item, record.frame_timestamps)
            EpisodeStaging(Path(folder), record.episode_index).write("plan", rows)
        LanguageColumnsWriter().write_all(records, Path(folder), root)


def _rows_before(dataset: LeRobotDataset, record: EpisodeRecord) -> list[dict[str, Any]]:
    """The language rows that an episode has already, each with its time."""
    if not dataset.meta.has_language_columns:
        return []
    episodes: Any = dataset.meta.episodes
    first = int(episodes["dataset_from_index"][record.episode_index])
    columns: Any = dataset.hf_dataset.select_columns(list(LANGUAGE_COLUMNS))
    frames = columns[first : first + record.row_count]
    rows = [dict(row) for row in frames[LANGUAGE_PERSISTENT][0] or []]
    for time_s, events in zip(record.frame_timestamps, frames[LANGUAGE_EVENTS], strict=True):
        rows += [{**event, "timestamp": time_s} for event in events or []]
    return rows


def _sub_task_rows(item: MinedEpisode, times_s: Sequence[float]) -> list[dict[str, Any]]:
    """A sub-task per phase, from the frame after the key pose before it; equal neighbours are merged."""
    begins = [0, *(pose.frame + 1 for pose in item.key_poses[:-1])]
    words = [phase_phrase(pose.phase, sub_task_of(pose, item.sub_tasks)) for pose in item.key_poses]
    said = zip(begins, words, strict=True)
    return [
        {
            "role": "assistant", "content": words, "style": "subtask", "camera": None, "tool_calls": None,
            "timestamp": times_s[next(same)[0]],
        }
        for words, same in groupby(said, key=lambda one: one[1])
    ]  # fmt: skip


def _link_the_rest(source: Path, root: Path) -> None:
    """Take over the files that were not written: links to videos, copies of files that may be edited."""
    copied = 0
    for path in sorted(source.rglob("*")):
        inside = path.relative_to(source)
        target = root / inside
        is_ours = inside.parts[0] in ("data", "images") or any(part.startswith(".") for part in inside.parts)
        if is_ours or not path.is_file() or target.exists():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        if inside.parts[0] == "videos":
            copied += not _link(path.resolve(), target)
        else:
            shutil.copyfile(path, target)
    if copied:
        logger.warning("%d videos of %s could not be linked and were copied", copied, source)


def _link(source: Path, target: Path) -> bool:
    """Link a file, hard or symbolic; False where the file system has neither, and it was copied."""
    for link in (os.link, os.symlink):
        try:
            link(source, target)
            return True
        except OSError:  # another disk, or a file system without such links
            continue
    shutil.copyfile(source, target)
    return False


def _describe(dataset: LeRobotDataset, root: Path) -> None:
    """Write the metadata: the dataset's own features and statistics, and the new columns."""
    source = Path(dataset.root)
    info = load_info(source)
    ours = features(dataset.features[OBS_STATE])
    info.features = {**info.features, **ours, **language_feature_info()}
    write_info(info, root)
    if (statistics := source / "meta/stats.json").is_file():
        shutil.copyfile(statistics, root / "meta/stats.json")
