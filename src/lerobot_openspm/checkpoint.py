"""Finding a checkpoint, and reading a memory that fits the policy's configuration."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from huggingface_hub import snapshot_download
from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE
from huggingface_hub.errors import HFValidationError

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry.camera import check_sizes
from lerobot_openspm.memory.files import data_files
from lerobot_openspm.memory.header import check_layouts
from lerobot_openspm.memory.memory import (
    CAMERAS_JSON,
    MEMORY_JSON,
    Memory,
    check_anchors,
    check_labels,
    read_memory,
)  # fmt: skip


def checkpoint_folder(name: str | Path, revision: str | None = None, **options: Any) -> Path:
    """The folder of a checkpoint; downloaded where it is a name on the Hub.

    Args:
        name: A folder, or a name on the Hub.
        revision: Of a checkpoint on the Hub.
        options: Of ``huggingface_hub.snapshot_download``.

    Raises:
        FileNotFoundError: There is no such folder, and it is no name on the Hub.
    """
    directory = Path(name)
    if directory.is_dir():
        return directory
    download = partial(snapshot_download, str(name), **options)
    files = [CONFIG_NAME, SAFETENSORS_SINGLE_FILE, MEMORY_JSON, CAMERAS_JSON]
    try:
        directory = Path(download(allow_patterns=files, revision=revision))
    except HFValidationError as error:
        raise FileNotFoundError(
            f"no checkpoint folder at {name}, and no name on the Hub (user/name)"
        ) from error
    # What else it needs is named there. Pushes before may have left other files of this kind.
    download(allow_patterns=data_files(directory), revision=directory.name)
    return directory


def load_memory(directory: Path, config: OpenSPMConfig, is_kept: bool) -> Memory:
    """Read a checkpoint's memory.

    Args:
        directory: The checkpoint's folder.
        config: The configuration that it has to fit.
        is_kept: Whether it is used as it is; one that is about to be mined anew or appended to is compared
            with what it is made of then.

    Raises:
        MemoryFormatError: It is damaged or empty, or made for another configuration.
        CalibrationError: Its cameras are not those of the configuration.
    """
    memory = read_memory(directory, None if config.cameras is None else Path(config.cameras))
    if not memory.entries:
        raise MemoryFormatError(
            f"the memory in {directory} holds no entries, so nothing can be done with it; train again"
        )
    found_by = "oracle" if memory.perception == "oracle" else memory.segmentation
    for name, made, asked in (
        ("perception", found_by, config.perception),
        ("segmentation.shape", memory.shape, config.segmentation.shape),
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
        check_labels(memory, config.segmentation.labels, str(directory / CONFIG_NAME))
    check_sizes(memory.cameras, config.image_sizes, config.cameras or str(directory / CAMERAS_JSON))
    return memory
