"""Training and validation loss over epochs; the last two demonstrations of every task are held out."""

from __future__ import annotations

import json
import logging
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from benchmarks.common import write
from benchmarks.libero.stages import DEMOS, REPO_ID, TRAIN_CONFIG, dataset, first_episodes, run_folder
from tqdm import tqdm

from lerobot_openspm.cli.collect import SUMMARY_FILE
from lerobot_openspm.cli.pipeline import digest, discard_unless
from lerobot_openspm.files import write_beside

STEPS, EVERY = 3000, 300
SAMPLES_PER_STEP = 512
HELD_OUT = 2
PLOT = Path("docs/images/libero_losses.png")


def main() -> dict[str, Any]:
    """Train with a held-out share, read the losses from the log, plot them, write and return them.

    A training that was interrupted is begun anew.
    """
    root, output = dataset(), run_folder() / "losses"
    log = output / "losses.log"
    discard_unless(output, digest([Path(__file__), TRAIN_CONFIG, root / SUMMARY_FILE], []))
    lines = log.read_text().splitlines() if log.exists() else _train(root, log)
    training = [float(m[1]) for line in lines if (m := re.search(r" loss:([\d.]+)", line))]
    validation = [float(m[1]) for line in lines if (m := re.search(r"eval_loss=([\d.]+)", line))]
    steps = [EVERY * (i + 1) for i in range(len(training))]
    epochs = [round(step * SAMPLES_PER_STEP / _frames(root), 2) for step in steps]
    _plot(epochs, training, validation)
    return write(
        "libero_losses", {"epochs": epochs, "training": training, "validation": validation, "plot": PLOT.name}
    )


def _train(root: Path, log: Path) -> list[str]:
    shutil.rmtree(log.parent, ignore_errors=True)
    learned = json.dumps(first_episodes(root, DEMOS - HELD_OUT))
    command = [
        str(Path(sys.executable).with_name("lerobot-train")), f"--config_path={TRAIN_CONFIG}",
        f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}", f"--output_dir={log.parent}",
        f"--dataset.eval_split={HELD_OUT / DEMOS}", f"--policy.memory_episodes={learned}",
        f"--steps={STEPS}", f"--log_freq={EVERY}", f"--eval_steps={EVERY}",
        "--max_eval_samples=0", f"--policy.samples_per_frame={SAMPLES_PER_STEP}",
    ]  # fmt: skip
    lines: list[str] = []
    pipe = subprocess.PIPE
    with (
        subprocess.Popen(command, stdout=pipe, stderr=subprocess.STDOUT, text=True) as run,
        tqdm(total=STEPS, desc="Training", unit="step") as bar,
    ):
        for line in run.stdout or ():
            lines.append(line.rstrip("\n"))
            bar.update(EVERY if "eval_loss=" in line else 0)
    if run.returncode != 0:
        raise RuntimeError("lerobot-train failed:\n" + "\n".join(lines[-20:]))
    write_beside(log, ("\n".join(lines) + "\n").encode())
    return lines


def _frames(root: Path) -> int:
    """Frames that were learned from."""
    recorded = json.loads((root / SUMMARY_FILE).read_text())["episodes"]
    return sum(recorded[number]["steps"] for number in first_episodes(root, DEMOS - HELD_OUT))


def _plot(epochs: list[float], training: list[float], validation: list[float]) -> None:
    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    axes.plot(epochs, training, label="training")
    axes.plot(epochs, validation, label="validation, two held-out demonstrations a task")
    axes.set(xlabel="epochs", ylabel="flow-matching loss", yscale="log")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(PLOT, dpi=130)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    print(json.dumps(main()))
