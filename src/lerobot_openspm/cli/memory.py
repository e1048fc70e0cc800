"""``openspm memory COMMAND ...``: finds the command and hands it the rest of the line."""

from __future__ import annotations

import importlib

from lerobot_openspm.errors import OpenSPMError

CHANGE = "lerobot_openspm.cli.memory_change"
# Command -> module and function that takes the arguments, and what it is for.
COMMANDS = {
    "list": ("lerobot_openspm.cli.memory_show", "list_entries", "a line for every entry or task"),
    "show": ("lerobot_openspm.cli.memory_show", "show", "entries with all their numbers"),
    "search": ("lerobot_openspm.cli.memory_search", "search", "what an instruction finds, with its scores"),
    "add": (CHANGE, "add", "add entries of another memory or of an exported file"),
    "remove": (CHANGE, "remove", "remove entries; they are kept as superseded"),
    "restore": (CHANGE, "restore", "put a superseded entry into use again"),
    "merge": (CHANGE, "merge", "merge near-duplicates, their spread kept as covariance"),
    "rate": (CHANGE, "rate", "say how acting by an entry ended"),
    "cameras": (CHANGE, "cameras", "give a memory another calibration"),
    "export": ("lerobot_openspm.cli.memory_export", "export", "write entries to a file or folder"),
}


def main(args: list[str]) -> None:
    """Run one command on a memory."""
    command, *options = args or ["--help"]
    if command in ("-h", "--help"):
        print("usage: openspm memory COMMAND --path=CHECKPOINT [--option=value ...]\n\ncommands:")
        print("\n".join(f"  {name:7s} {what}" for name, (_, _, what) in COMMANDS.items()))
        print("\n`openspm memory COMMAND --help` lists the options of one.")
        return
    if command not in COMMANDS:
        raise OpenSPMError(f"unknown command {command!r}; expected one of {', '.join(COMMANDS)}")
    module, function, _ = COMMANDS[command]
    getattr(importlib.import_module(module), function)(options)
