"""`openspm memory export`: entries as a file that people can edit, or as a memory's folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import draccus

from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.memory.exchange import write_entries_file
from lerobot_openspm.memory.io import read_memory, write_memory


@dataclass
class ExportConfig:
    """Export entries of a memory; ``openspm memory add --other=OUTPUT`` takes them again.

    Args:
        path: Folder of the checkpoint or memory.
        output: A name that ends in ``.json``: one file to read and edit, for memories that know the same
            objects. Any other: a folder with a memory of these entries, objects and calibration included.
        source: Export entries that come from this dataset and episode, as ``list`` names them.
        instruction: Export entries of this very instruction.
    """

    path: str = "outputs/memory"
    output: str = "outputs/entries.json"
    source: str = ""
    instruction: str = ""


def export(args: list[str]) -> None:
    """Write the chosen entries, and print one JSON object."""
    config = draccus.parse(ExportConfig, args=args)
    memory = read_memory(Path(config.path))
    entries = tuple(
        entry
        for entry in memory.entries
        if config.source in ("", entry.source) and config.instruction in ("", entry.language)
    )
    if not entries:
        raise OpenSPMError(
            f"the memory at {config.path} holds no such entry; `openspm memory list --path={config.path}` "
            "lists what it holds"
        )
    output = Path(config.output)
    if output.exists():
        raise FileExistsError(f"{output} exists already; choose another --output, or remove it")
    output.parent.mkdir(parents=True, exist_ok=True)
    chosen = replace(memory, entries=entries, superseded=())
    if output.suffix == ".json":
        write_entries_file(chosen, output)
    else:
        write_memory(chosen, output)
    print(json.dumps({"entries": len(entries), "output": str(output)}))
