"""``openspm COMMAND ...``: finds the command and hands it the rest of the line."""

from __future__ import annotations

import importlib
import logging
import subprocess
import sys

from draccus.utils import ParsingError

from lerobot_openspm.errors import OpenSPMError

# Command -> module with `main(args)`, and what it is for. Modules are imported when they are asked for.
COMMANDS = {
    "collect": ("lerobot_openspm.cli.collect", "record scripted demonstrations on the tabletop or LIBERO"),
    "calibrate": ("lerobot_openspm.cli.calibrate", "estimate a camera's pose from a dataset's own episodes"),
    "mine": ("lerobot_openspm.cli.mine", "mine a dataset's key poses into a memory"),
    "teach": ("lerobot_openspm.cli.teach", "teach a checkpoint a task from a few demonstrations"),
    "inspect": ("lerobot_openspm.cli.inspect", "show the memory of a checkpoint"),
    "memory": ("lerobot_openspm.cli.memory", "list, show and change the entries of a memory"),
    "bench": ("lerobot_openspm.cli.bench", "measure a checkpoint on this machine"),
    "demo": ("lerobot_openspm.cli.demo", "collect, train, evaluate and write one page about it"),
}
# Commands that have commands of their own.
NESTED = ("memory", "bench")


def main() -> None:
    """Run one command; a mistake in the input is one line on stderr and exit code 2."""
    command, *args = sys.argv[1:] or ["--help"]
    if command in ("-h", "--help"):
        print("usage: openspm COMMAND [--option=value ...]\n\ncommands:")
        print("\n".join(f"  {name:9s} {what}" for name, (_, what) in COMMANDS.items()))
        print("\n`openspm COMMAND --help` lists the options of one.")
        return
    if command not in COMMANDS:
        print(f"openspm: unknown command {command!r}; expected one of {', '.join(COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    subcommand = args[:1] if command in NESTED and not "".join(args[:1]).startswith("-") else []
    sys.argv[0] = " ".join(["openspm", command, *subcommand])  # what argparse says in its usage
    try:
        importlib.import_module(COMMANDS[command][0]).main(args)
    except (OpenSPMError, ParsingError, FileExistsError, FileNotFoundError, RuntimeError) as error:
        print(f"openspm {command}: {reason(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"openspm {command}: interrupted; the same command again goes on from here", file=sys.stderr)
        sys.exit(130)
    except subprocess.CalledProcessError as error:
        print(f"openspm {command}: {error.cmd[0]} failed with exit code {error.returncode}", file=sys.stderr)
        sys.exit(error.returncode)


def reason(error: BaseException) -> BaseException:
    """What a configuration said of its own values, where the parser only says that it could not be made."""
    while isinstance(error, ParsingError) and error.__cause__ is not None:
        error = error.__cause__
    return error
