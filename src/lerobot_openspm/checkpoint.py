"""Finding a checkpoint, and reading a memory that fits the policy's configuration."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from huggingface_hub import snapshot_download
from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE
from huggingface_hub.errors import HFValidationError

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import MemoryFormatError, OpenSPMError
from lerobot_openspm.geometry.arm import load_arm
from lerobot_openspm.geometry.camera import check_sizes
from lerobot_openspm.memory.io import MEMORY_JSON, WORKPLACES, arrays_file, read_memory
from lerobot_openspm.memory.memory import Memory, check_layouts
from lerobot_openspm.memory.stored_entries import anchored_objects
from lerobot_openspm.workplaces import folders

MAX_CONFIG_BYTES = 1_000_000
# Options that name programs and addresses on the user's machine.
USERS_OWN = (("judge", "api_base"), ("segmenter", "sam3d_python"), ("segmenter", "sam3d_checkout"))


def checkpoint_folder(name: str | Path, revision: str | None = None, **options: Any) -> Path:
    """The folder of a checkpoint; downloaded where it is a name on the Hub.

    Args:
        name: A folder, or a name on the Hub.
        revision: Of a checkpoint on the Hub.
        options: Of ``huggingface_hub.snapshot_download``.

    Raises:
        FileNotFoundError: There is no such folder, and it is no name on the Hub.
        MemoryFormatError: It has no memory, or one of another version.
        OpenSPMError: Its configuration says where pictures are sent or what program is run.
    """
    directory = Path(name)
    if directory.is_dir():
        arrays_file(directory)  # a checkpoint of before has options that its configuration fails on
        _check_config(directory / CONFIG_NAME)
        return directory
    download = partial(snapshot_download, str(name), **options)
    files = [CONFIG_NAME, SAFETENSORS_SINGLE_FILE, MEMORY_JSON, f"{WORKPLACES}/*/{MEMORY_JSON}"]
    try:
        directory = Path(download(allow_patterns=files, revision=revision))
    except HFValidationError as error:
        raise FileNotFoundError(
            f"no checkpoint folder at {name}, and no name on the Hub (user/name)"
        ) from error
    _check_config(directory / CONFIG_NAME)
    # The files of arrays are named there. Pushes before may have left others of this kind.
    arrays = [(one / arrays_file(one)).relative_to(directory).as_posix() for one in folders(directory)]
    download(allow_patterns=arrays, revision=directory.name)
    return directory


def _check_config(path: Path) -> None:
    """Refuse a configuration that names what only the user may: none of ours is saved with it.

    A checkpoint may come from anybody. The judge is sent the user's pictures and key, and SAM 3D's Python is
    started.
    """
    if not path.is_file():
        return
    with path.open("rb") as file:
        blob = file.read(MAX_CONFIG_BYTES + 1)
    try:
        config = json.loads(blob) if len(blob) <= MAX_CONFIG_BYTES else None
    except (ValueError, RecursionError):
        config = None
    if not isinstance(config, dict):
        raise OpenSPMError(
            f"{path} is no JSON object of up to {MAX_CONFIG_BYTES} bytes; load the checkpoint again"
        )
    for group, name in USERS_OWN:
        own = config.get(group)
        if isinstance(own, dict) and own.get(name) is not None:
            raise OpenSPMError(
                f"{path} sets {group}.{name} to {str(own[name])[:200]!r}, expected null: a checkpoint must "
                f"not say what your machine runs or sends pictures to; set it to null there, and pass "
                f"--policy.{group}.{name} if you want it"
            )


def load_memory(directory: Path, config: OpenSPMConfig, is_kept: bool) -> Memory:
    """Read a checkpoint's memory.

    Args:
        directory: The checkpoint's folder.
        config: The configuration that it has to fit.
        is_kept: Whether it is used as it is; one that is about to be mined anew or appended to is compared
            with what it is made of then.

    Raises:
        MemoryFormatError: It is damaged or empty, or made for another configuration.
        CalibrationError: Its cameras are not those of the configuration, or the arm's URDF cannot be read.
    """
    memory = read_memory(directory, None if config.cameras is None else Path(config.cameras))
    if config.arm is not None:
        memory = replace(memory, robot=replace(memory.robot, arm=load_arm(Path(config.arm))))
    if not memory.entries:
        raise MemoryFormatError(
            f"the memory in {directory} holds no entries, so nothing can be done with it; train again"
        )
    found_by = "oracle" if memory.perception == "oracle" else memory.segmentation
    for name, made, asked in (
        ("perception", found_by, config.perception),
        ("segmenter.shape", memory.shape, config.segmenter.shape),
    ):
        if made != asked:
            raise MemoryFormatError(
                f"the memory in {directory} holds key poses in the frames of {name}={made}, got "
                f"--policy.{name}={asked}; the two cannot be mixed, train with the one you evaluate"
            )
    if is_kept:
        where = str(directory / MEMORY_JSON)
        check_layouts(memory.layouts, config.layouts(), "the configuration's", where)
        check_anchors(memory, where)
        check_labels(memory, config.segmenter.labels, str(directory / CONFIG_NAME))
    check_sizes(memory.cameras, config.image_sizes, config.cameras or str(directory / MEMORY_JSON))
    return memory


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
            f"{where}: 'segmenter.labels' has no number for {', '.join(missing)}, which the memory has "
            f"key poses at; it has {', '.join(sorted(labels))}. Pass --policy.segmenter.labels='{{...}}' "
            "with all of them"
        )
