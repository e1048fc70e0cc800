"""A memory on disk."""

from pathlib import Path

import pytest
from tests.memory.memories import a_memory

from lerobot_openspm.memory.io import write_memory


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """Its folder."""
    write_memory(a_memory(), tmp_path)
    return tmp_path
