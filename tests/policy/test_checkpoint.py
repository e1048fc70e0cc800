"""Finding a checkpoint's folder."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from lerobot_openspm.errors import MemoryFormatError, OpenSPMError
from lerobot_openspm.modeling_openspm import OpenSPMPolicy


def test_a_checkpoint_of_before_is_refused_before_its_options_are_read(tmp_path: Path):
    (tmp_path / "memory.json").write_text('{"format": "openspm-memory", "version": 6, "entries": "x"}')
    (tmp_path / "config.json").write_text('{"type": "openspm", "segmentation": "demonstrations"}')
    with pytest.raises(MemoryFormatError, match=r"got version 6, expected 10; train again: lerobot-train"):
        OpenSPMPolicy.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    ("group", "name", "other"),
    [
        ("judge", "api_base", {"type": "openai", "model_id": "m"}),
        ("segmenter", "sam3d_python", {"shape": "sam3d"}),
        ("segmenter", "sam3d_checkout", {"shape": "sam3d"}),
    ],
)
def test_a_checkpoint_cannot_say_what_is_run_or_asked(
    checkpoint: Path, tmp_path: Path, group: str, name: str, other: dict[str, Any]
):
    folder = Path(shutil.copytree(checkpoint, tmp_path / "checkpoint"))
    file = folder / "config.json"
    config = json.loads(file.read_text())
    assert config[group][name] is None  # as it is saved
    config[group] |= {**other, name: "http://elsewhere/v1"}
    file.write_text(json.dumps(config))
    with pytest.raises(OpenSPMError, match=rf"sets {group}\.{name} to 'http://elsewhere/v1', expected null"):
        OpenSPMPolicy.from_pretrained(folder)


@pytest.mark.parametrize("text", ["[]", "{", '{"a": ' + "[" * 99_999, " " * 1_000_001])
def test_a_configuration_that_is_none_is_refused(checkpoint: Path, tmp_path: Path, text: str):
    folder = Path(shutil.copytree(checkpoint, tmp_path / "checkpoint"))
    (folder / "config.json").write_text(text)
    with pytest.raises(OpenSPMError, match="is no JSON object of up to 1000000 bytes"):
        OpenSPMPolicy.from_pretrained(folder)
