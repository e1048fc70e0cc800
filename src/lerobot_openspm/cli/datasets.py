"""Opening a dataset that the user names, with one line about it where there is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lerobot_openspm.errors import DatasetError


def dataset_metadata(repo_id: str, root: str | None) -> Any:
    """LeRobot's metadata of a dataset.

    Args:
        repo_id: Its name on the Hub, or of a local one.
        root: Its folder; LeRobot's cache, or else the Hub, if not given.

    Raises:
        DatasetError: There is none, or it cannot be read.
    """
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError
    from lerobot.datasets import LeRobotDatasetMetadata

    # LeRobot would ask the Hub for a local dataset that is not there.
    if root is not None and not (Path(root) / "meta/info.json").is_file():
        raise DatasetError(
            f"no dataset in {root}: it has no meta/info.json; pass the folder of a LeRobotDataset as "
            "--dataset.root"
        )
    try:
        return LeRobotDatasetMetadata(repo_id, root=root)
    except (HfHubHTTPError, HFValidationError, OSError, ValueError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise DatasetError(
            f"no dataset {repo_id!r} in {root or 'the cache of LeRobot or on the Hub'} ({reason}); pass "
            "--dataset.repo_id=NAME, and --dataset.root=FOLDER of one that lies here"
        ) from error
