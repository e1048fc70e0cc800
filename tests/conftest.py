"""Fixtures for every test."""

from collections.abc import Iterator

import pytest
from tests.hub.loopback_hub import LoopbackHub


@pytest.fixture
def loopback_hub() -> Iterator[LoopbackHub]:
    """An empty Hub on 127.0.0.1; what talks to it runs in a subprocess with `loopback_hub.env(tmp_path)`."""
    with LoopbackHub().running() as hub:
        yield hub
