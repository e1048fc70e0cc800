"""`openspm inspect`: the memory of a checkpoint, in words and numbers that a person can read."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import draccus

from lerobot_openspm.cli.memory_show import table
from lerobot_openspm.memory.io import read_memory


@dataclass
class InspectConfig:
    """Show the memory of a checkpoint.

    Args:
        path: Folder of the checkpoint or of a mined memory.
        instruction: Show only entries whose instruction contains this.
        limit: Show at most this many entries.
    """

    path: str = "outputs/memory"
    instruction: str = ""
    limit: int = 10


def main(args: list[str]) -> None:
    """Print the entries, then one JSON object."""
    config = draccus.parse(InspectConfig, args=args)
    memory = read_memory(Path(config.path))
    shown = [entry for entry in memory.entries if config.instruction in entry.language]
    for entry in shown[: config.limit]:
        print("\n".join(table(entry)), end="\n\n")
    per_task = Counter(entry.language for entry in memory.entries)
    print(
        json.dumps(
            {"entries": len(memory.entries), "shown": len(shown[: config.limit]), "per_task": per_task}
        )
    )
