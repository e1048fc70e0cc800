"""Finding a checkpoint's folder."""

from pathlib import Path

import pytest

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.modeling_openspm import OpenSPMPolicy


def test_a_checkpoint_of_before_is_refused_before_its_options_are_read(tmp_path: Path):
    (tmp_path / "memory.json").write_text('{"format": "openspm-memory", "version": 6, "entries": "x"}')
    (tmp_path / "config.json").write_text('{"type": "openspm", "segmentation": "demonstrations"}')
    with pytest.raises(MemoryFormatError, match=r"got version 6, expected 8; train again: lerobot-train"):
        OpenSPMPolicy.from_pretrained(tmp_path)
