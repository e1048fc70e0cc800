"""Everything a policy has learned besides its weights: entries, objects, robot, cameras."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from lerobot_openspm.errors import CalibrationError, MemoryFormatError
from lerobot_openspm.geometry.camera import Camera, load_cameras
from lerobot_openspm.geometry.vector_layout import VectorLayout
from lerobot_openspm.memory.bank import EntryBank, anchored_objects, texts_of
from lerobot_openspm.memory.columns import columns_of
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.files import (
    CAMERAS_JSON,
    MEMORY_JSON,
    OLD_ARRAYS,
    VERSION,
    Arrays,
    Fields,
    columns_from_arrays,
    columns_to_arrays,
    file_field,
    lines_from_arrays,
    read_arrays,
    read_cameras,
    read_header,
    write_files,
)
from lerobot_openspm.memory.header import Header, check_layouts, header_from_fields, header_to_fields
from lerobot_openspm.memory.old_versions import entries_from_parts
from lerobot_openspm.memory.quality import with_outcome
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.perception.objects.base import KnownObject
from lerobot_openspm.perception.objects.store import from_parts as object_from_parts
from lerobot_openspm.perception.objects.store import to_parts as object_to_parts

__all__ = ["CAMERAS_JSON", "MEMORY_JSON", "VERSION", "Memory", "read_memory", "write_memory"]

# So many entries are read when a memory is loaded; of a larger one, each when it is asked for.
READ_AT_LOAD = 2000


@dataclass(frozen=True)
class Memory:
    """What was mined from demonstrations.

    Attributes:
        entries: The memory bank.
        objects: Models of the objects by name.
        robot: The robot that gave the demonstrations.
        cameras: Calibration by camera key.
        perception: Whose object frames the entries are in: "demonstrations" or "oracle".
        segmentation: What found the objects' pixels: "demonstrations", or a segmenter by name.
        shape: What was learned of the objects: "demonstrations", "box" or "sam3d".
        simulator_objects: Objects in the order of the simulator's pose vector (oracle ablation only).
        layouts: How the robot's state and action vectors are laid out; None in memories of before version 5.
        superseded: Entries that were replaced, merged or removed. They are kept to look at, never retrieved.
    """

    entries: Sequence[MemoryEntry]
    objects: dict[str, KnownObject]
    robot: RobotModel
    cameras: dict[str, Camera]
    perception: str
    simulator_objects: tuple[str, ...] = ()
    segmentation: str = "demonstrations"
    shape: str = "demonstrations"
    layouts: tuple[VectorLayout, VectorLayout] | None = None
    superseded: Sequence[MemoryEntry] = ()

    @property
    def yaw_periods(self) -> dict[str, float]:
        """Angle by object that turns it into itself, radians; 0 for a body of revolution."""
        return {name: model.yaw_period for name, model in self.objects.items()}

    def appended(self, newer: Memory) -> Memory:
        """This memory with the entries of another one added.

        An episode that both hold is taken from the newer one, its version counted up. Objects that both know
        keep the older model, because a key pose means nothing in another model's frame.

        Raises:
            MemoryFormatError: The newer one comes from another robot.
        """
        check_layouts(self.layouts, newer.layouts, "the newer one's", "appending")
        robot = self.robot.covering(newer.robot)
        known = dict(enumerate(self.entries))
        by_source: dict[str, list[int]] = defaultdict(list)
        for i, entry in known.items():
            by_source[entry.source].append(i)
        added: list[MemoryEntry] = []
        replaced: list[MemoryEntry] = []
        for new in newer.entries:
            alike = (i for i in by_source[new.source] if i in known and _same_demonstration(known[i], new))
            if (old := next(alike, None)) is not None:
                replaced.append(known.pop(old))
                new = replace(new, version=replaced[-1].version + 1)
            added.append(new)
        return replace(
            self,
            entries=(*known.values(), *added),
            objects={**newer.objects, **self.objects},
            robot=robot,
            layouts=self.layouts or newer.layouts,
            superseded=(*self.superseded, *replaced),
        )

    def restored(self, index: int) -> Memory:
        """This memory with a superseded entry in use again, in the place of what came after it.

        Args:
            index: Which of the superseded ones.
        """
        entry = self.superseded[index]
        task = (entry.source, entry.language)
        replaced = [e for e in self.entries if (e.source, e.language) == task]
        # Not by identity: a large memory makes new objects whenever its entries are gone through.
        old = [e for i, e in enumerate(self.superseded) if i != index]
        version = max(e.version for e in (entry, *replaced, *old) if (e.source, e.language) == task) + 1
        kept = [e for e in self.entries if (e.source, e.language) != task]
        return replace(self, entries=(*kept, replace(entry, version=version)), superseded=(*old, *replaced))

    def with_outcomes(self, outcomes: Iterable[tuple[MemoryEntry, bool]]) -> Memory:
        """This memory after some of its entries were acted by, each with whether it succeeded.

        All entries are read and kept, also those of a large memory (about 0.3 ms each).
        """
        entries = list(self.entries)
        by_source: dict[str, list[int]] = defaultdict(list)
        for i, entry in enumerate(entries):
            by_source[entry.source].append(i)
        for used, success in outcomes:
            for i in by_source[used.source]:
                if entries[i].version == used.version and _same_demonstration(entries[i], used):
                    entries[i] = with_outcome(entries[i], success)
                    break
        return replace(self, entries=tuple(entries))


def _same_demonstration(a: MemoryEntry, b: MemoryEntry) -> bool:
    """Whether two entries were mined from the same episode; datasets of one name may hold different ones."""
    return (
        (a.source, a.language, a.key) == (b.source, b.language, b.key)
        and all(x.n_steps == y.n_steps for x, y in zip(a.key_poses, b.key_poses, strict=True))
        and all(np.allclose(x.T_obj_ee, y.T_obj_ee) for x, y in zip(a.key_poses, b.key_poses, strict=True))
    )


def write_memory(memory: Memory, directory: Path) -> None:
    """Write a memory: whatever interrupts this, the folder holds the one before or this one, whole."""
    arrays: Arrays = {}
    objects: list[Fields] = []
    for model in memory.objects.values():
        fields, own = object_to_parts(model)
        objects.append(fields)
        arrays |= {f"objects.{model.name}.{key}": value for key, value in own.items()}
    groups = (memory.entries, memory.superseded)
    arrays |= columns_to_arrays([columns_of(group) for group in groups])
    header = header_to_fields(header_of(memory, objects))
    texts = chain.from_iterable(map(texts_of, groups))
    write_files(directory, header, texts, arrays, memory.cameras)


def header_of(memory: Memory, objects: list[Fields]) -> Header:
    """What the header of a memory says, given the fields of the objects' models."""
    groups = (memory.entries, memory.superseded)
    anchored = tuple(sorted(frozenset[str]().union(*map(anchored_objects, groups))))
    return Header(
        memory.perception, memory.segmentation, memory.shape, memory.simulator_objects,
        memory.layouts, memory.robot, objects, len(memory.entries), anchored,
    )  # fmt: skip


def read_memory(directory: Path, cameras: Path | None = None) -> Memory:
    """Read a memory.

    Args:
        directory: Folder of a checkpoint or of a mined memory.
        cameras: Calibration file to use instead of the memory's own.

    Raises:
        MemoryFormatError: A file is missing, truncated, changed, malformed, too large, or of a newer version.
        CalibrationError: The calibration is malformed, or not the one that the memory was saved with.
    """
    while True:
        header = read_header(directory)
        try:
            return _load(directory, header, cameras)
        except (MemoryFormatError, CalibrationError):
            # Another process may have saved a newer memory in between; then its files are named differently.
            if header == read_header(directory):
                raise


def _load(directory: Path, fields: Fields, cameras_file: Path | None) -> Memory:
    where = str(directory / MEMORY_JSON)
    header = header_from_fields(fields, where)
    if fields["version"] < 5:
        arrays = read_arrays(directory / OLD_ARRAYS, fields["arrays"]["sha256"])
        entries, superseded = entries_from_parts(fields["entries"], arrays, where), ()
    else:
        arrays = _arrays_of(fields, directory)
        entries, superseded = _entries_of(fields, header, arrays, directory)
    models: dict[str, KnownObject] = {}
    for model_fields in header.objects:
        prefix = f"objects.{model_fields.get('name')}."
        own = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
        model = object_from_parts(model_fields, own, where)
        models[model.name] = model
    cameras = read_cameras(directory, fields) if cameras_file is None else load_cameras(cameras_file)
    return Memory(
        entries, models, header.robot, cameras, header.perception, header.simulator_objects,
        header.segmentation, header.shape, header.layouts, superseded,
    )  # fmt: skip


def _arrays_of(fields: Fields, directory: Path) -> Arrays:
    file = file_field(fields, "arrays", directory)
    return read_arrays(directory / file["file"], file.get("sha256"))


def _entries_of(
    fields: Fields, header: Header, arrays: Arrays, directory: Path
) -> tuple[Sequence[MemoryEntry], Sequence[MemoryEntry]]:
    """The entries, and those that were superseded."""
    file = directory / file_field(fields, "entries", directory)["file"]
    lines, columns = lines_from_arrays(arrays, str(file)), columns_from_arrays(arrays, str(file))
    bank = EntryBank(file, lines, columns, frozenset(header.anchored))
    if header.n_entries > len(bank):
        raise MemoryFormatError(
            f"{directory / MEMORY_JSON}: 'n_entries' is {header.n_entries}, but {file.name} holds {len(bank)}"
        )
    entries, superseded = bank[: header.n_entries], bank[header.n_entries :]
    return (tuple(entries), tuple(superseded)) if len(bank) <= READ_AT_LOAD else (entries, superseded)


def check_anchors(memory: Memory, where: str) -> None:
    """Every object that a key pose is relative to has to be one that perception can look for.

    Args:
        memory: What was loaded.
        where: Names its file in errors.

    Raises:
        MemoryFormatError: There is no model of an object.
    """
    known_objects = memory.objects
    for name in sorted(anchored_objects(memory.entries) - set(known_objects)):
        if memory.perception != "oracle":
            raise MemoryFormatError(
                f"{where}: entries have key poses at {name!r}, which is none of the 'objects' that "
                f"perception knows ({', '.join(sorted(known_objects)) or 'none'}); train or pull it again"
            )


def check_labels(memory: Memory, labels: Mapping[str, int] | None, where: str) -> None:
    """Every object that is found by given masks has to have a number in them.

    Args:
        memory: What was loaded.
        labels: Number by phrase; None where masks are not given.
        where: Names the file with the labels in errors.

    Raises:
        MemoryFormatError: An object has none.
    """
    if labels is not None and (missing := sorted(set(memory.objects) - set(labels))):
        raise MemoryFormatError(
            f"{where}: 'mask_labels' has no number for {', '.join(missing)}, which the memory has key poses "
            f"at; it has {', '.join(sorted(labels))}. Pass --policy.mask_labels='{{...}}' with all of them"
        )
