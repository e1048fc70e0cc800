"""`openspm memory add | remove | restore | merge | rate | cameras`: each changes a memory as a whole."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import draccus

from lerobot_openspm.cli.memory import MemoryOption
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.geometry.camera import load_cameras
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.exchange import combined, read_import
from lerobot_openspm.memory.io import changing, read_memory, write_memory
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.merging import merge_near_duplicates
from lerobot_openspm.memory.quality import with_success

MAX_NAMED = 20


@dataclass
class AddConfig(MemoryOption):
    """Add entries to a memory."""

    other: str = ""  # folder of another memory or checkpoint, or a file that ``openspm memory export`` wrote


@dataclass
class RemoveConfig(MemoryOption):
    """Remove entries from a memory. They are kept as superseded: ``list --all=true`` shows them."""

    source: str = ""  # remove entries of this dataset and episode, as ``list`` names them
    instruction: str = ""  # remove entries of this very instruction


@dataclass
class RestoreConfig(MemoryOption):
    """Put a superseded entry into use again, in the place of that of the same source and instruction."""

    source: str = ""  # dataset and episode of the entry, as ``list --all=true`` names them
    instruction: str = ""  # its very instruction, where several entries have the same source
    version: int | None = None  # which version; the newest superseded one if not given


@dataclass
class MergeConfig(MemoryOption):
    """Merge near-duplicates: entries of one task whose key poses all lie close together."""

    instruction: str = ""  # merge only entries of this very instruction
    distance_m: float = 0.01  # every two of what is merged have each key pose within this distance
    angle_rad: float = 0.1  # and within this angle

    def __post_init__(self) -> None:
        for name in ("distance_m", "angle_rad"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0")


@dataclass
class RateConfig(MemoryOption):
    """Say how acting by an entry ended; its quality follows."""

    source: str = ""  # dataset and episode of the entry, as ``list`` names them
    instruction: str = ""  # its very instruction, where several entries have the same source
    entry: int | None = None  # its number in the memory, from 0, where several have the same of both
    success: bool | None = None  # whether it succeeded


@dataclass
class CamerasConfig(MemoryOption):
    """Give a memory another calibration."""

    file: str = ""  # calibration file, as ``openspm calibrate`` writes it


def add(args: list[str]) -> None:
    """Add entries of another memory or of an exported file."""
    config = draccus.parse(AddConfig, args=args)
    _required(config.other, "--other=FOLDER or --other=FILE")
    imported = read_import(Path(config.other))
    before, after = _changed(config.path, lambda memory: combined(memory, imported, config.other))
    n_added = len(after.entries) + len(after.superseded) - len(before.entries) - len(before.superseded)
    _report(after, added=n_added, unchanged=len(imported.memory.entries) - n_added)


def remove(args: list[str]) -> None:
    """Remove entries; the memory keeps them as superseded."""
    config = draccus.parse(RemoveConfig, args=args)
    _required(config.source + config.instruction, "--source=DATASET#EPISODE or --instruction=TEXT")

    def without(memory: Memory) -> Memory:
        gone = _chosen(memory, config)
        kept = tuple(entry for i, entry in enumerate(memory.entries) if i not in gone)
        if not kept:
            raise OpenSPMError(
                f"this would remove all {len(gone)} entries of the memory at {config.path}, and nothing can "
                "be done with an empty one; delete the folder instead"
            )
        return replace(memory, entries=kept, superseded=(*memory.superseded, *gone.values()))

    before, after = _changed(config.path, without)
    gone = after.superseded[len(before.superseded) :]
    for entry in gone:
        print(f"removed version {entry.version} of {entry.source}: {entry.language!r}")
    _report(after, removed=len(gone))


def restore(args: list[str]) -> None:
    """Put a superseded entry into use again, as the newest version."""
    config = draccus.parse(RestoreConfig, args=args)
    _required(config.source, "--source=DATASET#EPISODE")

    def restored(memory: Memory) -> Memory:
        old = [
            (e.version, i, e.language)
            for i, e in enumerate(memory.superseded)
            if e.source == config.source and config.instruction in ("", e.language)
        ]
        found = [one for one in old if config.version in (None, one[0])]
        if not found:
            versions = ", ".join(str(version) for version, *_ in old) or "none"
            raise OpenSPMError(
                f"the memory at {config.path} holds no such superseded entry of {_asked(config)}, of its "
                f"versions: {versions}; `openspm memory list --path={config.path} --all=true` lists them"
            )
        if len(languages := sorted({language for *_, language in found})) > 1:
            raise OpenSPMError(_several(len(found), config.source, languages))
        return memory.restored(max(found)[1])

    _, after = _changed(config.path, restored)
    _report(after, restored=config.source, version=after.entries[-1].version)


def merge(args: list[str]) -> None:
    """Merge near-duplicates; the memory keeps what they were as superseded."""
    config = draccus.parse(MergeConfig, args=args)

    def merged(memory: Memory) -> Memory:
        language = config.instruction or None
        entries, gone = merge_near_duplicates(memory.entries, config.distance_m, config.angle_rad, language)
        return replace(memory, entries=entries, superseded=(*memory.superseded, *gone)) if gone else memory

    before, after = _changed(config.path, merged)
    n_merged = len(after.superseded) - len(before.superseded)
    _report(after, merged=n_merged, into=len(after.entries) - len(before.entries) + n_merged)


def rate(args: list[str]) -> None:
    """Count a success or failure of one entry."""
    config = draccus.parse(RateConfig, args=args)
    _required(config.source, "--source=DATASET#EPISODE")
    success = config.success
    if success is None:
        raise OpenSPMError("how did it end? pass --success=true or --success=false")
    index = 0

    def rated(memory: Memory) -> Memory:
        nonlocal index
        index = _the_one(memory, config)
        entries = (with_success(e, success) if i == index else e for i, e in enumerate(memory.entries))
        return replace(memory, entries=tuple(entries))

    _, after = _changed(config.path, rated)
    entry = after.entries[index]
    _report(after, quality=entry.quality, trials=entry.trials, successes=entry.successes)


def cameras(args: list[str]) -> None:
    """Put another calibration into a memory."""
    config = draccus.parse(CamerasConfig, args=args)
    _required(config.file, "--file=CALIBRATION")
    found = load_cameras(Path(config.file))
    _, after = _changed(config.path, lambda memory: replace(memory, cameras=found))
    _report(after, cameras=sorted(found))


def _changed(path: str, change: Callable[[Memory], Memory]) -> tuple[Memory, Memory]:
    """A memory before and after a change, which is saved if it is one; nobody else changes it meanwhile."""
    folder = Path(path)
    with changing(folder):
        before = read_memory(folder)
        if (after := change(before)) is not before:
            write_memory(after, folder)
    return before, after


def _the_one(memory: Memory, config: RateConfig) -> int:
    """Number of the entry to rate. Raises if it is none or several, with the option that tells."""
    chosen = _chosen(memory, config)
    if config.entry is not None:
        if config.entry not in chosen:
            raise OpenSPMError(
                f"entry {config.entry} is none of those that come from {config.source!r}; pass "
                f"--entry=NUMBER with one of: {_numbered(chosen)}"
            )
        return config.entry
    if len(chosen) > 1:
        languages = sorted({entry.language for entry in chosen.values()})
        if len(languages) > 1:
            raise OpenSPMError(_several(len(chosen), config.source, languages))
        raise OpenSPMError(
            f"{len(chosen)} entries come from {config.source!r}; pass --entry=NUMBER with one of: "
            f"{_numbered(chosen)}"
        )
    return next(iter(chosen))


def _several(count: int, source: str, languages: Sequence[str]) -> str:
    return (
        f"{count} entries come from {source!r}; pass --instruction=TEXT with one of: {'; '.join(languages)}"
    )


def _asked(config: RemoveConfig | RestoreConfig | RateConfig) -> str:
    return " and ".join(repr(value) for value in (config.source, config.instruction) if value)


def _numbered(entries: Mapping[int, MemoryEntry]) -> str:
    """Entries by number, with what may tell them apart."""
    return "; ".join(
        f"{i} ({entry.language!r}, version {entry.version}, {len(entry.key_poses)} key poses, quality "
        f"{entry.quality:.2f}, succeeded {entry.successes} of {entry.trials})"
        for i, entry in entries.items()
    )


def _required(value: str, option: str) -> None:
    if not value:
        raise OpenSPMError(f"nothing to do; pass {option}")


def _chosen(memory: Memory, config: RemoveConfig | RateConfig) -> dict[int, MemoryEntry]:
    """Entries by index of a source and of an instruction, where these are given. Raises if there is none."""
    found = {
        i: entry
        for i, entry in enumerate(memory.entries)
        if config.source in ("", entry.source) and config.instruction in ("", entry.language)
    }
    if not found:
        known = sorted({entry.language for entry in memory.entries})
        raise OpenSPMError(
            f"the memory at {config.path} holds no entry of {_asked(config)}; it knows: "
            f"{'; '.join(known[:MAX_NAMED])}{' ...' if len(known) > MAX_NAMED else ''}. "
            f"`openspm memory list --path={config.path}` lists its entries"
        )
    return found


def _report(after: Memory, **numbers: object) -> None:
    """Print one JSON object: what there is now, and what was done."""
    now = {"entries": len(after.entries), "superseded": len(after.superseded)}
    print(json.dumps({**now, **numbers}))
