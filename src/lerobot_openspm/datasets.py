"""Opening LeRobot's datasets, with one line about a dataset that is not there."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from huggingface_hub.errors import HfHubHTTPError, HFValidationError
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

from lerobot_openspm.errors import DatasetError


def dataset_metadata(repo_id: str, root: str | None) -> LeRobotDatasetMetadata:
    """LeRobot's metadata of a dataset.

    Args:
        repo_id: Its name on the Hub, or of a local one.
        root: Its folder; LeRobot's cache, or else the Hub, if not given.

    Raises:
        DatasetError: There is none, or it cannot be read.
    """
    # LeRobot would ask the Hub for a local dataset that is not there.
    if root is not None and not (Path(root) / "meta/info.json").is_file():
        raise DatasetError(
            f"no dataset in {root}: it has no meta/info.json; pass the folder of a LeRobotDataset"
        )
    with _one_line(repo_id, root):
        return LeRobotDatasetMetadata(repo_id, root=root)


def open_dataset(dataset_meta: Any) -> LeRobotDataset:
    """The dataset behind LeRobot's metadata.

    Raises:
        DatasetError: Files of it are missing, or cannot be read.
    """
    with _one_line(dataset_meta.repo_id, dataset_meta.root):
        return LeRobotDataset(
            dataset_meta.repo_id, root=dataset_meta.root, revision=dataset_meta.revision, video_backend="pyav"
        )


@contextmanager
def _one_line(repo_id: str, root: object) -> Generator[None]:
    """Say in one line that a dataset cannot be read: LeRobot asks the Hub for whatever it misses here."""
    try:
        yield
    except (HfHubHTTPError, HFValidationError, httpx.HTTPError, OSError, ValueError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise DatasetError(
            f"dataset {repo_id!r} is not whole in {root or 'the cache of LeRobot'}, nor can it be had from "
            f"the Hub ({reason}); check its name and its folder"
        ) from error
