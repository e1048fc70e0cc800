import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from tests.policy.lerobot_commands import REPOSITORY

EXAMPLES = sorted((REPOSITORY / "examples").glob("*.py"))


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., str]:
    """Run an example in an empty folder; returns what it printed."""

    def run(name: str, *options: object) -> str:
        done = subprocess.run(
            [sys.executable, str(REPOSITORY / "examples" / name), *map(str, options)],
            cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    return run


@pytest.mark.slow
def test_a_memory_is_mined_and_looked_into(run: Callable[..., str], tiny_dataset: Path, tmp_path: Path):
    printed = run("01_record_and_mine.py", "--dataset", tiny_dataset, "--output", "one")
    assert "6 demonstrations" in printed
    assert "'put the bowl on the plate', remembered 3 times" in printed
    assert (tmp_path / "one/memory/memory.json").is_file()

    printed = run("03_look_into_the_memory.py", "--memory", "one/memory", "--output", "three")
    assert "'put the bowl on the plate': running" in printed
    assert printed.count("openspm_tabletop#") == 3
    assert cv2.imread(str(tmp_path / "three/key_poses.png")).shape == (512, 512, 3)


@pytest.mark.slow
def test_training_and_evaluation(run: Callable[..., str], tiny_dataset: Path, tmp_path: Path):
    printed = run(
        "02_train_and_evaluate.py", "--dataset", tiny_dataset, "--steps", 20, "--episodes", 1, "--max-length",
        20, "--image-size", 128, "--output", "two",
    )  # fmt: skip
    assert "time_limit after 20 steps" in printed
    assert list((tmp_path / "two/eval").rglob("*.mp4"))


@pytest.mark.slow
def test_examples_run_with_their_defaults_made_small(run: Callable[..., str], tmp_path: Path):
    run("01_record_and_mine.py", "--tasks", "turn_on_stove", "--demonstrations", 2)
    assert (tmp_path / "outputs/examples/01/memory/memory.json").is_file()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_is_short_and_says_how_to_run_it(path: Path):
    text = path.read_text()
    assert len(text.splitlines()) < 80
    assert f"python examples/{path.name}" in text
