"""Everything a policy has learned besides its weights: entries, objects, robot, cameras."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.geometry.vector_layout import VectorLayout
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.looks import Looks
from lerobot_openspm.memory.not_learned import NotLearned, still_not_learned
from lerobot_openspm.memory.quality import with_success
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.perception.objects.base import KnownObject
from lerobot_openspm.types import Symmetry

Layouts = tuple[VectorLayout, VectorLayout]


@dataclass(frozen=True)
class Memory:
    """What was mined from demonstrations.

    Attributes:
        entries: The memory's entries.
        objects: Models of the objects by name.
        robot: The robot that gave the demonstrations.
        cameras: Calibration by camera key.
        perception: Whose object frames the entries are in: "demonstrations" or "oracle".
        segmentation: What found the objects' pixels: "demonstrations", or a segmenter by name.
        shape: What was learned of the objects: "demonstrations", "box" or "sam3d".
        simulator_objects: Objects in the order of the simulator's pose vector (oracle ablation only).
        layouts: How the robot's state and action vectors are laid out; None where it is not known.
        superseded: Entries that were replaced, merged or removed. They are kept to look at, never retrieved.
        not_learned: What the demonstrations could not teach.
        workplaces: Of how many workplaces its checkpoint holds memories; only the first one's says it.
    """

    entries: Sequence[MemoryEntry]
    objects: dict[str, KnownObject]
    robot: RobotModel
    cameras: dict[str, Camera]
    perception: str
    simulator_objects: tuple[str, ...] = ()
    segmentation: str = "demonstrations"
    shape: str = "demonstrations"
    layouts: Layouts | None = None
    superseded: Sequence[MemoryEntry] = ()
    not_learned: tuple[NotLearned, ...] = ()
    workplaces: int = 1

    @property
    def yaw_periods(self) -> dict[str, float]:
        """Angle by object that turns it into itself, radians; 0 for a body of revolution."""
        return {name: model.yaw_period for name, model in self.objects.items()}

    @property
    def points(self) -> dict[str, Array]:
        """Points ``(n, 3)`` of each object's surface in its frame, where its shape is known.

        None with the oracle: its objects' frames are the simulator's, not those that shapes were learned in.
        """
        if self.perception == "oracle":
            return {}
        points = {name: np.asarray(model.points, float) for name, model in self.objects.items()}
        return {name: own for name, own in points.items() if len(own)}

    @property
    def symmetries(self) -> dict[str, Symmetry]:
        """How each object turns into itself, of those that do.

        None with the oracle, as with :attr:`points`.
        """
        if self.perception == "oracle":
            return {}
        symmetries = {name: model.symmetry for name, model in self.objects.items()}
        return {name: one for name, one in symmetries.items() if one is not None}

    @property
    def looks(self) -> Looks:
        """What decides how one object takes the place of another."""
        return Looks(self.points, self.symmetries)

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
        objects = {**newer.objects, **self.objects}
        return replace(
            self,
            entries=(*known.values(), *added),
            objects=objects,
            robot=robot,
            layouts=self.layouts or newer.layouts,
            superseded=(*self.superseded, *replaced),
            not_learned=still_not_learned(self.not_learned, newer.not_learned, objects, newer.entries),
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

    def with_successes(self, successes: Iterable[tuple[MemoryEntry, bool]]) -> Memory:
        """This memory after some of its entries were acted by, each with whether it succeeded.

        All entries are read and kept, also those of a large memory (about 0.3 ms each).
        """
        entries = list(self.entries)
        by_source: dict[str, list[int]] = defaultdict(list)
        for i, entry in enumerate(entries):
            by_source[entry.source].append(i)
        for used, success in successes:
            for i in by_source[used.source]:
                if entries[i].version == used.version and _same_demonstration(entries[i], used):
                    entries[i] = with_success(entries[i], success)
                    break
        return replace(self, entries=tuple(entries))


def _same_demonstration(a: MemoryEntry, b: MemoryEntry) -> bool:
    """Whether two entries were mined from the same episode; datasets of one name may hold different ones."""
    return (
        (a.source, a.language, a.key) == (b.source, b.language, b.key)
        and all(x.n_steps == y.n_steps for x, y in zip(a.key_poses, b.key_poses, strict=True))
        and all(np.allclose(x.T_obj_ee, y.T_obj_ee) for x, y in zip(a.key_poses, b.key_poses, strict=True))
    )


def check_layouts(ours: Layouts | None, theirs: Layouts | None, whose: str, where: str) -> None:
    """Check that the numbers of two layouts have the same meaning; their names may differ.

    Args:
        ours: Layouts of state and action that the memory was mined with; None where it is not known.
        theirs: Those of something that is to go with it.
        whose: Names the latter in errors: "the checkpoint's".
        where: Names the memory in errors.

    Raises:
        MemoryFormatError: They are of different robots.
    """
    if ours is None or theirs is None:
        return
    for what, own, other in zip(("state", "action"), ours, theirs, strict=True):
        if _meaning(own) != _meaning(other):
            raise MemoryFormatError(
                f"{where}: 'layouts': the memory's {what} is {list(own.names)} with rotation "
                f"{own.rotation_kind}, {whose} {list(other.names)} with rotation {other.rotation_kind}: they "
                "are of different robots or controllers and cannot go together"
            )


def _meaning(layout: VectorLayout) -> tuple[Any, ...]:
    return (layout.size, layout.position, layout.rotation, layout.rotation_kind, layout.gripper)
