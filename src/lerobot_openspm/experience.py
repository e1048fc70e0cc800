"""Everything a policy has learned besides its weights: entries, objects, robot, cameras.

Three files lie beside a checkpoint's weights: ``memory.json`` (what a person reads), ``memory.safetensors``
(the arrays it refers to, by checksum) and ``cameras.json`` (the calibration).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.files import write_beside
from lerobot_openspm.geometry.camera import Camera, cameras_to_dict, load_cameras
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.memory.store import entries_from_parts, entries_to_parts, robot_from_dict, robot_to_dict
from lerobot_openspm.perception.learning import SHAPES
from lerobot_openspm.perception.model import KnownObject
from lerobot_openspm.perception.segmentation.make import SEGMENTERS
from lerobot_openspm.perception.store import from_parts as object_from_parts
from lerobot_openspm.perception.store import to_parts as object_to_parts

# Version 2: objects known by patches. Version 3: key poses with the axis of their constraint. Version 4:
# objects known by boxes, or by shapes whose pixels a segmenter finds.
FORMAT, VERSION = "openspm-memory", 4
MEMORY_JSON, MEMORY_ARRAYS, CAMERAS_JSON = "memory.json", "memory.safetensors", "cameras.json"
FILES = (MEMORY_JSON, MEMORY_ARRAYS, CAMERAS_JSON)
MAX_JSON_BYTES, MAX_ARRAY_BYTES = 512_000_000, 4_000_000_000


@dataclass(frozen=True)
class Experience:
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
    """

    entries: tuple[MemoryEntry, ...]
    objects: dict[str, KnownObject]
    robot: RobotModel
    cameras: dict[str, Camera]
    perception: str
    simulator_objects: tuple[str, ...] = ()
    segmentation: str = "demonstrations"
    shape: str = "demonstrations"

    @property
    def yaw_periods(self) -> dict[str, float]:
        """Angle by object that turns it into itself, radians; 0 for a body of revolution."""
        return {name: model.yaw_period for name, model in self.objects.items()}

    def appended(self, newer: Experience) -> Experience:
        """This experience with the entries of another one added.

        An episode that both hold is taken from the newer one, its version counted up. Objects that both know
        keep the older model, because a key pose means nothing in another model's frame.

        Raises:
            MemoryFormatError: The newer one comes from another robot.
        """
        kept, added = list(self.entries), []
        for new in newer.entries:
            old = next((entry for entry in kept if _same_demonstration(entry, new)), None)
            if old is not None:
                kept.remove(old)
            added.append(new if old is None else replace(new, version=old.version + 1))
        return replace(
            self,
            entries=(*kept, *added),
            objects={**newer.objects, **self.objects},
            robot=self.robot.covering(newer.robot),
        )


def _same_demonstration(a: MemoryEntry, b: MemoryEntry) -> bool:
    """Whether two entries were mined from the same episode; datasets of one name may hold different ones."""
    return (
        (a.source, a.language, a.key) == (b.source, b.language, b.key)
        and all(x.n_steps == y.n_steps for x, y in zip(a.key_poses, b.key_poses, strict=True))
        and all(np.allclose(x.T_obj_ee, y.T_obj_ee) for x, y in zip(a.key_poses, b.key_poses, strict=True))
    )


def save_experience(experience: Experience, directory: Path) -> None:
    """Write the three files, each beside its place and then renamed, so that none is ever half-written."""
    rows, arrays = entries_to_parts(experience.entries)
    objects = []
    for model in experience.objects.values():
        fields, model_arrays = object_to_parts(model)
        objects.append(fields)
        arrays |= {f"objects.{model.name}.{key}": value for key, value in model_arrays.items()}
    blob = save_arrays({key: np.ascontiguousarray(value) for key, value in arrays.items()})
    memory = {
        "format": FORMAT,
        "version": VERSION,
        "arrays": {"file": MEMORY_ARRAYS, "sha256": hashlib.sha256(blob).hexdigest()},
        "perception": experience.perception,
        "segmentation": experience.segmentation,
        "shape": experience.shape,
        "simulator_objects": list(experience.simulator_objects),
        "robot": robot_to_dict(experience.robot),
        "objects": objects,
        "entries": rows,
    }
    directory.mkdir(parents=True, exist_ok=True)
    write_beside(directory / MEMORY_ARRAYS, blob)
    write_beside(directory / CAMERAS_JSON, _json(cameras_to_dict(experience.cameras)))
    # Last, because it vouches for the arrays.
    write_beside(directory / MEMORY_JSON, _json(memory))


def load_experience(directory: Path) -> Experience:
    """Read the three files.

    Raises:
        MemoryFormatError: A file is missing, truncated, malformed, too large, or of a newer version.
        CalibrationError: The calibration is malformed.
    """
    where = str(directory / MEMORY_JSON)
    memory = _read_json(directory / MEMORY_JSON)
    if memory.get("format") != FORMAT:
        raise MemoryFormatError(f"{where}: got format {memory.get('format')!r}, expected {FORMAT!r}")
    version = memory.get("version")
    if type(version) is not int or not 1 <= version <= VERSION:
        raise MemoryFormatError(
            f"{where}: got version {version!r}, this release reads up to {VERSION}; "
            "upgrade lerobot_policy_openspm"
        )
    try:
        checksum, rows, objects = memory["arrays"]["sha256"], memory["entries"], memory["objects"]
        robot, perception = robot_from_dict(memory["robot"], where), str(memory["perception"])
        simulator_objects = tuple(str(name) for name in memory["simulator_objects"])
    except (KeyError, TypeError) as error:
        raise MemoryFormatError(
            f"{where}: field {error} is missing or malformed; train or pull it again"
        ) from error
    if not isinstance(rows, list) or not isinstance(objects, list):
        raise MemoryFormatError(f"{where}: 'entries' and 'objects' must be lists")
    if perception not in ("demonstrations", "oracle"):
        raise MemoryFormatError(f"{where}: perception is {perception!r}, expected demonstrations or oracle")
    # Until version 3 nothing else was known.
    segmentation, shape = (memory.get(name, "demonstrations") for name in ("segmentation", "shape"))
    for name, got, expected in (("segmentation", segmentation, SEGMENTERS), ("shape", shape, SHAPES)):
        if got not in expected:
            raise MemoryFormatError(f"{where}: {name} is {got!r}, expected one of {', '.join(expected)}")
    arrays = _read_arrays(directory / MEMORY_ARRAYS, checksum)
    models = {}
    for fields in objects:
        if not isinstance(fields, Mapping):
            raise MemoryFormatError(f"{where}: 'objects' must hold JSON objects, got {type(fields).__name__}")
        name = str(fields.get("name"))
        prefix = f"objects.{name}."
        own = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
        models[name] = object_from_parts(fields, own, where)
    entries = entries_from_parts(rows, arrays, where)
    cameras = load_cameras(directory / CAMERAS_JSON)
    return Experience(entries, models, robot, cameras, perception, simulator_objects, segmentation, shape)


def check_anchors(experience: Experience, where: str) -> None:
    """Every object that a key pose is relative to has to be one that perception can look for.

    Args:
        experience: What was loaded.
        where: Names its file in errors.

    Raises:
        MemoryFormatError: There is no model of an object.
    """
    known = experience.objects
    for i, entry in enumerate(experience.entries):
        for name in entry.objects:
            if name not in known and experience.perception != "oracle":
                raise MemoryFormatError(
                    f"{where}: entries[{i}] has key poses at {name!r}, which is none of the 'objects' that "
                    f"perception knows ({', '.join(sorted(known)) or 'none'}); train or pull it again"
                )


def check_labels(experience: Experience, labels: Mapping[str, int] | None, where: str) -> None:
    """Every object that is found by given masks has to have a number in them.

    Args:
        experience: What was loaded.
        labels: Number by phrase; None where masks are not given.
        where: Names the file with the labels in errors.

    Raises:
        MemoryFormatError: An object has none.
    """
    if labels is not None and (missing := sorted(set(experience.objects) - set(labels))):
        raise MemoryFormatError(
            f"{where}: 'mask_labels' has no number for {', '.join(missing)}, which the memory has key poses "
            f"at; it has {', '.join(sorted(labels))}. Pass --policy.mask_labels='{{...}}' with all of them"
        )


def _read_json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(_read(path, MAX_JSON_BYTES))
    except (ValueError, RecursionError) as error:
        if isinstance(error, MemoryFormatError):
            raise
        raise MemoryFormatError(f"{path}: truncated or not JSON ({error}); train or pull it again") from error
    if not isinstance(data, dict):
        raise MemoryFormatError(f"{path}: expected a JSON object, got {type(data).__name__}")
    return data


def _read_arrays(path: Path, checksum: object) -> dict[str, np.ndarray]:
    blob = _read(path, MAX_ARRAY_BYTES)
    if hashlib.sha256(blob).hexdigest() != checksum:
        raise MemoryFormatError(
            f"{path}: its checksum is not the one in {MEMORY_JSON}: truncated, changed, or from another "
            "checkpoint; train or pull it again"
        )
    try:
        return load_arrays(blob)
    except (SafetensorError, KeyError) as error:  # KeyError: a type that NumPy does not have
        raise MemoryFormatError(f"{path}: not safetensors ({error}); train or pull it again") from error


def _read(path: Path, limit: int) -> bytes:
    if not path.is_file():
        raise MemoryFormatError(
            f"no memory at {path}: a checkpoint of this policy holds {', '.join(FILES)}; train with "
            "lerobot-train --policy.type=openspm, or pull the whole checkpoint. In a training's folder it is "
            "checkpoints/last/pretrained_model"
        )
    if path.stat().st_size > limit:
        raise MemoryFormatError(
            f"{path}: {path.stat().st_size} bytes, more than the {limit} this release reads"
        )
    return path.read_bytes()


def _json(data: object) -> bytes:
    return json.dumps(data, indent=1, allow_nan=False).encode()
