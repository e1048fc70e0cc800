"""`openspm memory list | show | export`: a memory in words and numbers that a person can read."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import draccus
import numpy as np

from lerobot_openspm.cli.memory import LimitOption, MemoryOption
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose, Outcome
from lerobot_openspm.memory.exchange import write_entries_file
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.perception.objects.base import KnownObject
from lerobot_openspm.perception.objects.patches.match import REACH_M as PATCHES_REACH_M
from lerobot_openspm.perception.objects.patches.model import PatchModel
from lerobot_openspm.perception.objects.surface.backdrop import REACH_M
from lerobot_openspm.perception.objects.surface.model import SurfaceModel


@dataclass
class ListConfig(LimitOption):
    """List what a memory holds."""

    instruction: str = ""  # list only entries whose instruction contains this
    tasks: bool = False  # list tasks, with the number and mean quality of their entries, instead of entries
    all: bool = False  # list superseded entries too: those that were replaced, merged or removed
    limit: int = 50  # list at most this many


@dataclass
class ShowConfig(LimitOption):
    """Show entries of a memory with all their numbers."""

    source: str = ""  # show only entries of this dataset and episode, as ``list`` names them
    instruction: str = ""  # show only entries whose instruction contains this


@dataclass
class ExportConfig(MemoryOption):
    """Export entries of a memory; ``openspm memory add --other=OUTPUT`` takes them again.

    An output that ends in ``.json`` is one file to read and edit, for memories that know the same objects.
    Any other is a folder with a memory of these entries, objects and calibration included.
    """

    output: str = "outputs/entries.json"  # the file or folder to write
    source: str = ""  # export entries of this dataset and episode, as ``list`` names them
    instruction: str = ""  # export entries of this very instruction


def list_entries(args: list[str]) -> None:
    """Print a line for every entry or task, then one JSON object."""
    config = draccus.parse(ListConfig, args=args)
    memory = read_memory(Path(config.path))
    tasks: dict[str, list[float]] = defaultdict(list)
    lines: list[str] = []  # as many as are printed: a memory may hold a million entries
    for entry in memory.entries:
        if config.instruction in entry.language:
            tasks[entry.language].append(entry.quality)
            if not config.tasks and len(lines) < config.limit:
                lines.append(_line(entry))
    n_lines = len(tasks) if config.tasks else sum(map(len, tasks.values()))
    if config.tasks:
        lines = [
            f"{len(qualities):6d} entries  mean quality {np.mean(qualities):.2f}  {language!r}"
            for language, qualities in tasks.items()
        ]
    if config.all:
        old = [entry for entry in memory.superseded if config.instruction in entry.language]
        lines += [f"{_line(entry)}  superseded" for entry in old]
        n_lines += len(old)
    for line in lines[: config.limit]:
        print(line)
    if n_lines > config.limit:
        print(f"... {n_lines - config.limit} more; --limit={n_lines} lists all")
    counts = {"entries": len(memory.entries), "superseded": len(memory.superseded)}
    per_task = {language: len(qualities) for language, qualities in tasks.items()}
    print(json.dumps({**counts, "listed": min(n_lines, config.limit), "per_task": per_task}))


def show(args: list[str]) -> None:
    """Print entries with all their numbers, how objects are known and what is not, then one JSON object."""
    config = draccus.parse(ShowConfig, args=args)
    memory = read_memory(Path(config.path))
    shown: list[MemoryEntry] = []  # as many as are printed: a memory may hold a million entries
    n_wanted = 0
    for entry in memory.entries:
        if config.instruction in entry.language and config.source in ("", entry.source):
            n_wanted += 1
            if len(shown) < config.limit:
                shown.append(entry)
    if config.source and not shown:
        raise OpenSPMError(
            f"the memory at {config.path} holds nothing from {config.source!r}; `openspm memory list "
            f"--path={config.path}` lists what it holds"
        )
    for entry in shown:
        print("\n".join(_table(entry)), end="\n\n")
    if n_wanted > config.limit:
        print(f"... {n_wanted - config.limit} more; --limit={n_wanted} shows all", end="\n\n")
    for model in memory.objects.values():
        print(_known_by(model))
    for one in memory.not_learned:
        print(one)
    per_task = Counter(entry.language for entry in memory.entries)
    told = {"not_learned": [vars(one) for one in memory.not_learned]} if memory.not_learned else {}
    counts = {"entries": len(memory.entries), "shown": len(shown), "per_task": per_task}
    known_by = {name: model.kind for name, model in memory.objects.items()}
    print(json.dumps({**counts, "objects": known_by, **told}))


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
    chosen = replace(memory, entries=entries, superseded=(), workplaces=1)
    if output.suffix == ".json":
        write_entries_file(chosen, output)
    else:
        write_memory(chosen, output)
    print(json.dumps({"entries": len(entries), "output": str(output)}))


def _known_by(model: KnownObject) -> str:
    """By what an object is known, and so where it is found, as a line."""
    match model:
        case SurfaceModel():
            where = f"anywhere within {100 * REACH_M:.0f} cm of where the hand went"
        case PatchModel():
            where = f"only within {100 * PATCHES_REACH_M:.1f} cm of where it stood in the demonstrations"
        case _:
            where = "anywhere at the height where it stood in the demonstrations"
    return f"{model.name!r} is known by its {model.kind}: found {where}"


def _line(entry: MemoryEntry) -> str:
    trials = f"{entry.successes} of {entry.trials}" if entry.trials else "-"
    return (
        f"quality {entry.quality:.2f}  succeeded {trials:>9s}  version {entry.version}  "
        f"{len(entry.key_poses):2d} key poses  {entry.source}  {entry.language!r}"
    )


def _table(entry: MemoryEntry) -> list[str]:
    """An entry as lines: a head, a row for every key pose, and where what was moved should end."""
    trials = f", succeeded {entry.successes} of {entry.trials} times" if entry.trials else ""
    head = (
        f"{entry.language!r} from {entry.source}, version {entry.version}, quality {entry.quality:.2f}"
        f"{trials}"
    )
    names = f"{'phase':10s} {'place':18s} {'axes':18s}"
    columns = f"  {names} {'hand in its frame, mm':>24s} {'rotation vector, deg':>22s} gripper conf."
    rows = (_row(pose) for pose in entry.key_poses)
    return [head, columns, *rows, *(_outcome_row(outcome) for outcome in entry.outcomes)]


def _outcome_row(outcome: Outcome) -> str:
    mm = " ".join(f"{1000 * x:.1f}" for x in outcome.position)
    return (
        f"  done when the {outcome.target} is within {1000 * outcome.tolerance_m:.1f} mm of {mm} mm from the "
        f"{outcome.anchor.place} (axes of the {outcome.anchor.axes})"
    )


def _row(pose: MemoryKeyPose) -> str:
    mm = " ".join(f"{1000 * x:7.1f}" for x in pose.T_obj_ee[:3, 3])
    deg = " ".join(f"{np.rad2deg(x):6.1f}" for x in se3.log_so3(pose.T_obj_ee[:3, :3]))
    gripper = "closed" if pose.closed else "open"
    names = f"{pose.phase:10s} {pose.anchor.place:18s} {pose.anchor.axes:18s}"
    notes = f"{_constraint(pose)}{_spread(pose)}"
    return f"  {names} {mm:>24s} {deg:>22s} {gripper:7s} {pose.confidence:.2f}{notes}"


def _constraint(pose: MemoryKeyPose) -> str:
    if pose.axis is None:
        return ""
    along = " ".join(f"{x:.2f}" for x in pose.axis.direction)
    if pose.axis.kind == "slide":
        return f"  slides {1000 * pose.axis.amount:.0f} mm along {along}"
    return f"  turns {np.rad2deg(pose.axis.amount):.0f} deg about {along}"


def _spread(pose: MemoryKeyPose) -> str:
    if pose.covariance is None:
        return ""
    std = np.sqrt(np.diag(pose.covariance))
    mm, deg = (" ".join(f"{x:.1f}" for x in part) for part in (1000 * std[:3], np.rad2deg(std[3:])))
    return f"  spread {mm} mm, {deg} deg"
