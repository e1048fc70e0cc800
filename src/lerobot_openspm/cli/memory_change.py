"""`openspm memory add | remove | restore | merge | rate | cameras`: each changes a memory as a whole."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import draccus

from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.geometry.camera import load_cameras
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.exchange import combined, read_parcel
from lerobot_openspm.memory.io import changing, read_memory, write_memory
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.merging import merge_near_duplicates
from lerobot_openspm.memory.quality import with_outcome


@dataclass
class AddConfig:
    """Add entries to a memory.

    Args:
        path: Folder of the checkpoint or memory that is added to.
        other: Folder of another one, or a file that ``openspm memory export`` wrote.
    """

    path: str = "outputs/memory"
    other: str = ""


@dataclass
class RemoveConfig:
    """Remove entries from a memory. They are kept as superseded: ``list --all=true`` shows them.

    Args:
        path: Folder of the checkpoint or memory.
        source: Remove entries that come from this dataset and episode, as ``list`` names them.
        instruction: Remove entries of this very instruction.
    """

    path: str = "outputs/memory"
    source: str = ""
    instruction: str = ""


@dataclass
class RestoreConfig:
    """Put a superseded entry into use again; what is in use of the same source and instruction is superseded.

    Args:
        path: Folder of the checkpoint or memory.
        source: Dataset and episode of the entry, as ``list --all=true`` names them.
        version: Which version; the newest superseded one if not given.
    """

    path: str = "outputs/memory"
    source: str = ""
    version: int | None = None


@dataclass
class MergeConfig:
    """Merge near-duplicates: entries of one task whose key poses all lie close together.

    Args:
        path: Folder of the checkpoint or memory.
        instruction: Merge only entries of this very instruction.
        distance_m: Every two of what is merged have each key pose within this distance.
        angle_rad: And within this angle.
    """

    path: str = "outputs/memory"
    instruction: str = ""
    distance_m: float = 0.01
    angle_rad: float = 0.1

    def __post_init__(self) -> None:
        for name in ("distance_m", "angle_rad"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0")


@dataclass
class RateConfig:
    """Say how acting by an entry ended; its quality follows.

    Args:
        path: Folder of the checkpoint or memory.
        source: Dataset and episode of the entry, as ``list`` names them.
        instruction: Its very instruction, where several entries have the same source.
        entry: Its number among the memory's entries, from 0, where several have the same of both.
        success: Whether it succeeded.
    """

    path: str = "outputs/memory"
    source: str = ""
    instruction: str = ""
    entry: int | None = None
    success: bool | None = None


@dataclass
class CamerasConfig:
    """Give a memory another calibration.

    Args:
        path: Folder of the checkpoint or memory.
        file: Calibration file, as ``openspm calibrate`` writes it.
    """

    path: str = "outputs/memory"
    file: str = ""


def add(args: list[str]) -> None:
    """Add entries of another memory or of an exported file."""
    config = draccus.parse(AddConfig, args=args)
    _required(config.other, "--other=FOLDER or --other=FILE")
    parcel = read_parcel(Path(config.other))
    folder = Path(config.path)
    with changing(folder):
        before = read_memory(folder)
        after, n_added = combined(before, parcel, config.other)
        if n_added:
            write_memory(after, folder)
    _report(after, added=n_added, unchanged=len(parcel.memory.entries) - n_added)


def remove(args: list[str]) -> None:
    """Remove entries; the memory keeps them as superseded."""
    config = draccus.parse(RemoveConfig, args=args)
    _required(config.source + config.instruction, "--source=DATASET#EPISODE or --instruction=TEXT")
    folder = Path(config.path)
    with changing(folder):
        before = read_memory(folder)
        gone = _chosen(before, config.source, config.instruction, config.path)
        kept = [entry for i, entry in enumerate(before.entries) if i not in gone]
        if not kept:
            raise OpenSPMError(
                f"this would remove all {len(gone)} entries of the memory at {config.path}, and nothing can "
                "be done with an empty one; delete the folder instead"
            )
        after = replace(before, entries=tuple(kept), superseded=(*before.superseded, *gone.values()))
        write_memory(after, folder)
    for entry in gone.values():
        print(f"removed version {entry.version} of {entry.source}: {entry.language!r}")
    _report(after, removed=len(gone))


def restore(args: list[str]) -> None:
    """Put a superseded entry into use again, as the newest version."""
    config = draccus.parse(RestoreConfig, args=args)
    _required(config.source, "--source=DATASET#EPISODE")
    folder = Path(config.path)
    with changing(folder):
        before = read_memory(folder)
        old = [(e.version, i) for i, e in enumerate(before.superseded) if e.source == config.source]
        found = [(version, i) for version, i in old if config.version in (None, version)]
        if not found:
            versions = ", ".join(str(version) for version, _ in old) or "none"
            raise OpenSPMError(
                f"the memory at {config.path} holds no such superseded entry of {config.source!r}, of its "
                f"versions: {versions}; `openspm memory list --path={config.path} --all=true` lists them"
            )
        _, newest = max(found)
        after = before.restored(newest)
        write_memory(after, folder)
    _report(after, restored=config.source, version=after.entries[-1].version)


def merge(args: list[str]) -> None:
    """Merge near-duplicates; the memory keeps what they were as superseded."""
    config = draccus.parse(MergeConfig, args=args)
    folder = Path(config.path)
    with changing(folder):
        before = read_memory(folder)
        result = merge_near_duplicates(
            before.entries, config.distance_m, config.angle_rad, config.instruction or None
        )
        after = before
        if result.superseded:
            after = replace(
                before, entries=result.entries, superseded=(*before.superseded, *result.superseded)
            )
            write_memory(after, folder)
    n_merged = len(result.superseded)
    _report(after, merged=n_merged, into=len(after.entries) - len(before.entries) + n_merged)


def rate(args: list[str]) -> None:
    """Count an outcome of one entry."""
    config = draccus.parse(RateConfig, args=args)
    _required(config.source, "--source=DATASET#EPISODE")
    if config.success is None:
        raise OpenSPMError("how did it end? pass --success=true or --success=false")
    folder = Path(config.path)
    with changing(folder):
        before = read_memory(folder)
        index, entry = _the_one(before, config)
        rated = with_outcome(entry, config.success)
        entries = tuple(rated if i == index else other for i, other in enumerate(before.entries))
        after = replace(before, entries=entries)
        write_memory(after, folder)
    _report(after, quality=rated.quality, trials=rated.trials, successes=rated.successes)


def _the_one(memory: Memory, config: RateConfig) -> tuple[int, MemoryEntry]:
    """The entry to rate, and its number. Raises if it is none or several, with the option that tells."""
    chosen = _chosen(memory, config.source, config.instruction, config.path)
    if config.entry is not None:
        if config.entry not in chosen:
            raise OpenSPMError(
                f"entry {config.entry} is none of those that come from {config.source!r}; pass "
                f"--entry=NUMBER with one of: {_numbered(chosen)}"
            )
        return config.entry, chosen[config.entry]
    if len(chosen) > 1:
        languages = sorted({entry.language for entry in chosen.values()})
        how = f"--instruction=TEXT with one of: {'; '.join(languages)}"
        if len(languages) == 1:
            how = f"--entry=NUMBER with one of: {_numbered(chosen)}"
        raise OpenSPMError(f"{len(chosen)} entries come from {config.source!r}; pass {how}")
    [one] = chosen.items()
    return one


def _numbered(entries: Mapping[int, MemoryEntry]) -> str:
    """Entries by number, with what may tell them apart."""
    return "; ".join(
        f"{i} ({entry.language!r}, version {entry.version}, {len(entry.key_poses)} key poses, quality "
        f"{entry.quality:.2f}, succeeded {entry.successes} of {entry.trials})"
        for i, entry in entries.items()
    )


def cameras(args: list[str]) -> None:
    """Put another calibration into a memory."""
    config = draccus.parse(CamerasConfig, args=args)
    _required(config.file, "--file=CALIBRATION")
    folder, file = Path(config.path), Path(config.file)
    load_cameras(file)
    with changing(folder):
        after = read_memory(folder, cameras=file)
        write_memory(after, folder)
    _report(after, cameras=sorted(after.cameras))


def _required(value: str, option: str) -> None:
    if not value:
        raise OpenSPMError(f"nothing to do; pass {option}")


def _chosen(memory: Memory, source: str, instruction: str, path: str) -> dict[int, MemoryEntry]:
    """Entries by index of a source and of an instruction, where these are given. Raises if there is none."""
    found = {
        i: entry
        for i, entry in enumerate(memory.entries)
        if source in ("", entry.source) and instruction in ("", entry.language)
    }
    if not found:
        asked = " and ".join(repr(value) for value in (source, instruction) if value)
        raise OpenSPMError(
            f"the memory at {path} holds no entry of {asked}; it knows: {_known(memory.entries)}. "
            f"`openspm memory list --path={path}` lists its entries"
        )
    return found


def _known(entries: Sequence[MemoryEntry], limit: int = 20) -> str:
    languages = sorted({entry.language for entry in entries})
    return "; ".join(languages[:limit]) + (" ..." if len(languages) > limit else "")


def _report(after: Memory, **numbers: object) -> None:
    """Print one JSON object: what there is now, and what was done."""
    now = {"entries": len(after.entries), "superseded": len(after.superseded)}
    print(json.dumps({**now, **numbers}))
