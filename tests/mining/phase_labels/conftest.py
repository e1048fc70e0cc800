"""The tiny Qwen3-VL, in this process and as a checkpoint's folder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(scope="session")
def tiny_qwen3vl_parts() -> tuple[Any, Any]:
    """Model and processor with random weights."""
    from tests.mining.phase_labels import tiny_qwen3vl  # imports transformers, which takes seconds

    processor = tiny_qwen3vl.processor()
    return tiny_qwen3vl.model(processor.tokenizer), processor


@pytest.fixture(scope="session")
def tiny_qwen3vl_folder(make_once: Callable[..., Path], tiny_qwen3vl_parts: tuple[Any, Any]) -> Path:
    """The same as files."""

    def save(folder: Path) -> None:
        for part in tiny_qwen3vl_parts:
            part.save_pretrained(folder)

    return make_once("tiny_qwen3vl", save)
