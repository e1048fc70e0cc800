"""Writes mined key poses into a copy of the dataset: columns to train on, sub-tasks for viewers."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.annotations.steerable_pipeline.reader import iter_episodes
from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
from lerobot.annotations.steerable_pipeline.writer import LanguageColumnsWriter
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.io_utils import load_info, write_info, write_table_one_row_group_per_episode
from lerobot.datasets.language import language_feature_info
from lerobot.utils.constants import OBS_STATE

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.files import rename
from lerobot_openspm.language.descriptions import phase_phrase
from lerobot_openspm.mining.anchors import sub_task_of
from lerobot_openspm.mining.columns import TARGET, TYPES, encode_key_poses, features
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.mined import MinedEpisode, MinedKeyPoses


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
    dataset, every = demonstrations.dataset, (*mined.episodes, *mined.held_out)
    try:
        shutil.copytree(dataset.root, beside, copy_function=_copy, ignore=_left_out(Path(dataset.root)))
        for path in (beside, *beside.rglob("*")):  # folders that were read-only stay so in a copy
            if path.is_dir():
                path.chmod(path.stat().st_mode | stat.S_IRWXU)
        _write_columns(demonstrations, every, beside)
        if not dataset.meta.has_language_columns:
            _write_sub_tasks(every, beside)
        info = load_info(beside)
        info.features |= {**features(dataset.features[OBS_STATE]), **language_feature_info()}
        write_info(info, beside)
        # Read by LeRobot before it is put in its place.
        LeRobotDataset(dataset.repo_id, root=beside, video_backend="pyav")
        rename(beside, folder)
    except BaseException:
        shutil.rmtree(beside, ignore_errors=True)
        raise


def _left_out(root: Path) -> Callable[[str, list[str]], set[str]]:
    """What of a dataset is not copied: the downloader's hidden files, and pictures that became videos."""
    return lambda folder, names: {
        name for name in names if name.startswith(".") or (name == "images" and Path(folder) == root)
    }


def _copy(source: str, target: str) -> None:
    """Copy a file of the dataset; a video is linked, except to another disk."""
    if source.endswith(".mp4"):
        try:
            os.link(os.path.realpath(source), target)
            return
        except OSError:  # another disk, or a file system without links
            pass
    shutil.copyfile(source, target)


def _write_columns(demonstrations: Demonstrations, mined: Sequence[MinedEpisode], root: Path) -> None:
    """Write the new columns into the copy's tables of frames."""
    states = demonstrations.states()
    columns = encode_key_poses(states, ())
    for item in mined:
        frames = slice(item.episode.from_index, item.episode.from_index + len(item.episode))
        for name, values in encode_key_poses(states[frames], item.key_poses).items():
            columns[name][frames] = values
    for path in sorted((root / "data").rglob("*.parquet")):
        table = pq.read_table(path)
        # What was noted for the old columns alone would hide the new ones.
        table = table.replace_schema_metadata(None)
        frames = np.asarray(table["index"])
        for name, values in columns.items():
            table = table.append_column(name, pa.array(list(values[frames])))
        write_table_one_row_group_per_episode(table, path)


def _write_sub_tasks(mined: Sequence[MinedEpisode], root: Path) -> None:
    """Write the phases as lerobot-annotate writes sub-tasks."""
    by_index, records = {item.episode.index: item for item in mined}, list(iter_episodes(root))
    with tempfile.TemporaryDirectory() as folder:
        for record in records:
            if item := by_index.get(record.episode_index):
                rows = _sub_task_rows(item, record.frame_timestamps)
                EpisodeStaging(Path(folder), record.episode_index).write("plan", rows)
        LanguageColumnsWriter().write_all(records, Path(folder), root)


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
