"""LeRobot's and our own command lines: in a process of their own, as a user runs them, or in this one.

A new process imports all of LeRobot first, which takes longer than most commands do. So one training runs in
a process of its own, and what further options do is tested in this one.
"""

import importlib
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
CALIBRATION = REPOSITORY / "configs/cameras/openspm_tabletop.json"
ARM = REPOSITORY / "configs/arms/libero_panda.urdf"
TRAIN_CONFIG = REPOSITORY / "configs/openspm_tabletop_train.yaml"
# Enough for weights that differ from the first ones; the memory does not depend on it.
STEPS = 60


def run_command(command: str, *options: str, timeout_s: float = 240) -> subprocess.CompletedProcess[str]:
    """Run a script of this environment from the repository's root; it may fail."""
    return subprocess.run(
        [str(Path(sys.executable).with_name(command)), *options],
        cwd=REPOSITORY,
        env=os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


@contextmanager
def own_logging() -> Iterator[None]:
    """Give the root logger back as it was; LeRobot's commands replace its handlers, pytest's among them."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        yield
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)


def call_lerobot(command: str, *options: str) -> None:
    """Run a command of LeRobot's in this process, from the repository's root; its errors are raised."""
    main = importlib.import_module(f"lerobot.scripts.{command.replace('-', '_')}").main
    with pytest.MonkeyPatch.context() as patched, own_logging():
        patched.setattr(sys, "argv", [command, *options])
        patched.chdir(REPOSITORY)
        main()


def train_arguments(*options: str) -> tuple[str, ...]:
    """Options of lerobot-train with small settings, without worker processes."""
    given = any("--config_path" in option for option in options)
    config = () if given else (f"--config_path={TRAIN_CONFIG}",)
    return (*config, "--num_workers=0", "--log_freq=20", *options)


def training_options(dataset: Path, output: Path, steps: int = STEPS) -> tuple[str, ...]:
    """Where from, where to, and for how long."""
    return (
        f"--dataset.root={dataset}", f"--output_dir={output}", f"--steps={steps}", f"--save_freq={steps}",
        "--policy.samples_per_frame=32",
    )  # fmt: skip


def pretrained(output: Path) -> Path:
    """The checkpoint that a training run left last."""
    return output / "checkpoints/last/pretrained_model"
