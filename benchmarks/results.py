"""The shape of all figures: options by draccus, `main(config)`, a result beside what it was taken on."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import logging
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import draccus
from draccus.utils import ParsingError

from lerobot_openspm.cli.main import reason
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.files import write_json

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks/results"
# What was measured with other options than those of the published figure.
TRIALS = Path("outputs/bench/results")
# What a result file tells of its own origin. `seed` and `n` come from whoever measured; the seed is None
# where nothing is drawn.
PROVENANCE = ("commit", "dirty", "command", "date", "machine", "seed", "n")
# What can change a figure while it is not committed. Results are left out: they are written in turn.
MEASURED_CODE = (
    "src", "configs", "benchmarks", "scripts/libero_assets.txt", "Makefile", "pyproject.toml",
    ":(exclude)benchmarks/results",
)  # fmt: skip
# Packages whose versions a result tells. Their bounds in pyproject.toml make no figure stale: a bound says
# what may be installed, not what was.
PACKAGES = ("lerobot", "mujoco", "numpy", "torch")


def run(config_class: type, main: Callable[[Any], Any]) -> None:
    """A benchmark's command line: parse the options, measure, print one JSON object last.

    A mistake in the input is one line on stderr and exit code 1.
    """
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    try:
        print(json.dumps(main(draccus.parse(config_class)), allow_nan=False))
    except (OpenSPMError, ParsingError, FileNotFoundError, FileExistsError, RuntimeError) as error:
        sys.exit(f"{Path(sys.argv[0]).stem}: {reason(error)}")


def write(name: str, measured: Mapping[str, Any], threads: int | None = None) -> dict[str, Any]:
    """Write ``benchmarks/results/NAME.json`` with its provenance, and return both.

    With other options than those that the figure is published with, it is written into `TRIALS` instead.

    Args:
        name: The figure's name.
        measured: The figures, with ``seed`` (None where nothing is drawn) and ``n``, over how many they were
            taken.
        threads: How many each process computed with that was started to measure; None if this one measured.

    Raises:
        OpenSPMError: ``seed`` or ``n`` is missing, or a figure has the name of a piece of provenance.
    """
    command = command_line(sys.orig_argv, sys.argv)
    path = (RESULTS if is_published(name, command) else TRIALS) / f"{name}.json"
    missing = [key for key in ("seed", "n") if key not in measured]
    taken = sorted({"commit", "dirty", "command", "date", "machine"} & set(measured))
    if missing or taken:
        raise OpenSPMError(
            f"cannot write {path}: a result needs seed and n, missing {missing}; its provenance is "
            f"added here, already given {taken}"
        )
    commit, dirty = code_version()
    content = {
        "commit": commit,
        "dirty": dirty,
        "command": command,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": machine(threads),
        "seed": measured["seed"],
        "n": measured["n"],
        **measured,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, content)
    return content


def is_published(name: str, command: str) -> bool:
    """Whether a command line takes the published figure; the order of its options does not matter."""
    from benchmarks.figures import FIGURES

    return name in FIGURES and set(shlex.split(command)) == set(shlex.split(FIGURES[name].command))


def code_version() -> tuple[str | None, bool | None]:
    """Commit of this checkout, and whether it was changed; None where it is no checkout."""
    commit = _git("rev-parse", "--short=12", "HEAD")
    if not commit:
        return None, None
    return commit, bool(_git("status", "--porcelain", "--", *MEASURED_CODE))


def command_line(started: Sequence[str], arguments: Sequence[str]) -> str:
    """The command as it was typed, without where its program lies.

    Args:
        started: ``sys.orig_argv``.
        arguments: ``sys.argv``, whose first is the program.
    """
    if "-m" in started[: len(started) - len(arguments) + 1]:
        words = ["python", *started[started.index("-m") :]]
    else:
        words = [Path(arguments[0]).name, *arguments[1:]]
    return shlex.join(words)


def machine(threads: int | None = None) -> dict[str, Any]:
    """What figures depend on beside the code; ``threads`` are this process's if not given."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "threads": threads or _threads(),
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in PACKAGES},
    }


def _threads() -> int | None:
    torch = sys.modules.get("torch")
    return torch.get_num_threads() if torch else int(os.environ.get("OMP_NUM_THREADS") or 0) or os.cpu_count()


def _cpu_model() -> str:
    """The processor's name; Linux tells it in /proc alone, the architecture is what is left elsewhere."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
