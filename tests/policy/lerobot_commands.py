"""LeRobot's and our own command lines, run as a user runs them: in a process of their own."""

import os
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
CALIBRATION = REPOSITORY / "configs/cameras/openspm_tabletop.json"
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


def lerobot_train(*options: str, succeeds: bool = True) -> str:
    """Run lerobot-train with small settings, without worker processes; returns what it logged."""
    done = run_command(
        "lerobot-train",
        *([] if any("--config_path" in option for option in options) else [f"--config_path={TRAIN_CONFIG}"]),
        "--num_workers=0",
        "--log_freq=20",
        *options,
    )
    assert (done.returncode == 0) == succeeds, done.stderr[-4000:]
    return done.stderr


def training_options(dataset: Path, output: Path, steps: int = STEPS) -> tuple[str, ...]:
    """Where from, where to, and for how long."""
    return (
        f"--dataset.root={dataset}", f"--output_dir={output}", f"--steps={steps}", f"--save_freq={steps}",
        "--policy.samples_per_frame=32",
    )  # fmt: skip


def pretrained(output: Path) -> Path:
    """The checkpoint that a training run left last."""
    return output / "checkpoints/last/pretrained_model"
