"""``openspm COMMAND ...``: runs the command, and says in one line what went wrong."""

from __future__ import annotations

import logging
import subprocess
import sys

from draccus.utils import DecodingError, ParsingError

from lerobot_openspm.cli.options import run_command
from lerobot_openspm.errors import OpenSPMError

CLI = "lerobot_openspm.cli"
COMMANDS = {
    "collect": (f"{CLI}.collect", "main", "record scripted demonstrations on the tabletop or LIBERO"),
    "calibrate": (f"{CLI}.calibrate", "main", "estimate a camera's pose from a dataset's own episodes"),
    "mine": (f"{CLI}.mine", "main", "mine a dataset's key poses into a memory"),
    "teach": (f"{CLI}.teach", "main", "teach a checkpoint a task from a few demonstrations"),
    "join": (f"{CLI}.join", "main", "put the checkpoints of several workplaces into one"),
    "inspect": (f"{CLI}.memory_show", "show", "show the memory of a checkpoint"),
    "memory": (f"{CLI}.memory", "main", "list, show and change the entries of a memory"),
    "bench": (f"{CLI}.bench", "main", "measure a checkpoint on this machine"),
    "demo": (f"{CLI}.demo", "main", "collect, train, evaluate and write one page about it"),
}


def main() -> None:
    """Run one command; a mistake in the input is one line on stderr and exit code 2."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    try:
        run_command("openspm", COMMANDS, sys.argv[1:])
    except (OpenSPMError, ParsingError, FileExistsError, FileNotFoundError, RuntimeError) as error:
        code, told = 2, reason(error)
    except KeyboardInterrupt:
        code, told = 130, "interrupted; the same command again goes on from here"
    except subprocess.CalledProcessError as error:
        code, told = error.returncode, f"{error.cmd[0]} failed with exit code {error.returncode}"
    else:
        return
    print(f"{sys.argv[0]}: {told}", file=sys.stderr)
    sys.exit(code)


def reason(error: BaseException) -> BaseException:
    """What a configuration said of its own values, or which option could not be read, and why."""
    unread = None
    while isinstance(error, ParsingError) and error.__cause__ is not None:
        unread = error if isinstance(error, DecodingError) else None
        error = error.__cause__
    if isinstance(error, DecodingError) and error.key_path:
        unread = error
    if unread is None:
        return error
    # Of an option that takes several types, the parser tells about each on a line; ours take one, or none.
    *_, said = unread.message.strip().splitlines()
    return OpenSPMError(f"--{'.'.join(unread.key_path)}: {said.strip()}")
