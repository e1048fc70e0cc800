"""``openspm memory COMMAND ...``: its commands, and the options that they share."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_openspm.cli.options import run_command

SHOW, CHANGE = "lerobot_openspm.cli.memory_show", "lerobot_openspm.cli.memory_change"
COMMANDS = {
    "list": (SHOW, "list_entries", "a line for every entry or task"),
    "show": (SHOW, "show", "entries with all their numbers"),
    "search": ("lerobot_openspm.cli.memory_search", "search", "what an instruction finds, with its scores"),
    "add": (CHANGE, "add", "add entries of another memory or of an exported file"),
    "remove": (CHANGE, "remove", "remove entries; they are kept as superseded"),
    "restore": (CHANGE, "restore", "put a superseded entry into use again"),
    "merge": (CHANGE, "merge", "merge near-duplicates, their spread kept as covariance"),
    "rate": (CHANGE, "rate", "say how acting by an entry ended"),
    "cameras": (CHANGE, "cameras", "give a memory another calibration"),
    "export": (SHOW, "export", "write entries to a file or folder"),
}


@dataclass
class MemoryOption:
    """Which memory."""

    path: str = "outputs/memory"  # folder of the checkpoint or of a mined memory


@dataclass
class LimitOption(MemoryOption):
    """Which memory, and how much of it is shown."""

    limit: int = 10  # show at most this many entries

    def __post_init__(self) -> None:
        if self.limit < 0:
            raise ValueError(f"limit is {self.limit}, expected a number of entries, at least 0: --limit=10")


def main(args: list[str]) -> None:
    """Run one command on a memory."""
    run_command("openspm memory", COMMANDS, args)
