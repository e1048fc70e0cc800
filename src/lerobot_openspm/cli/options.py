"""Options that commands share; those of a dataset are spelled as LeRobot spells them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_openspm.memory.io import MEMORY_JSON

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata


@dataclass
class DatasetOption:
    """The demonstrations."""

    repo_id: str = "local/openspm_tabletop"  # name on the Hub, or of a local one
    root: str | None = None  # its folder; LeRobot's cache if not given

    def metadata(self) -> LeRobotDatasetMetadata:
        """LeRobot's metadata of the dataset. Raises DatasetError if it cannot be read."""
        from lerobot_openspm.mining.dataset import dataset_metadata

        return dataset_metadata(self.repo_id, self.root)


@dataclass
class EpisodesOption(DatasetOption):
    """The demonstrations, or some of them."""

    episodes: list[int] | None = None  # e.g. [0,1,2]


def require_checkpoint(folder: Path, option: str) -> None:
    """Refuse a folder that holds no checkpoint of this policy. Raises FileNotFoundError."""
    for name in ("config.json", MEMORY_JSON):
        if not (folder / name).is_file():
            raise FileNotFoundError(
                f"no checkpoint of this policy at {folder}: it has no {name}; pass {option}=FOLDER, in a "
                "training's folder checkpoints/last/pretrained_model"
            )
