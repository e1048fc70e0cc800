"""What commands share: how one is found, and options; those of a dataset are spelled as LeRobot does."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.memory.io import MEMORY_JSON

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

# Command -> module, function that takes the arguments, and what it is for. Modules are imported when they
# are asked for.
Commands = Mapping[str, tuple[str, str, str]]


def run_command(program: str, commands: Commands, args: list[str]) -> None:
    """Hand the command that the arguments begin with the rest of them; list all where it is --help or none.

    Raises:
        OpenSPMError: There is no such command.
    """
    sys.argv[0] = program  # what argparse says in its usage, and what errors begin with
    command, *options = args or ["--help"]
    if command in ("-h", "--help"):
        print(f"usage: {program} COMMAND [--option=value ...]\n\ncommands:")
        print("\n".join(f"  {name:9s} {what}" for name, (_, _, what) in commands.items()))
        print(f"\n`{program} COMMAND --help` lists the options of one.")
        return
    if command not in commands:
        raise OpenSPMError(f"unknown command {command!r}; expected one of {', '.join(commands)}")
    module, function, _ = commands[command]
    sys.argv[0] = f"{program} {command}"
    getattr(importlib.import_module(module), function)(options)


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
