"""Training and validation loss over epochs; the last two demonstrations of every task are held out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch
from benchmarks.results import run, write
from benchmarks.stages import DEMOS, LIBERO, dataset, first_episodes, policy
from torch import Tensor
from tqdm import tqdm

from lerobot_openspm.flow.training_set import TrainingSet
from lerobot_openspm.mining.dataset import dataset_metadata
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.training import dataset_processor, open_demonstrations, training_set

EVERY = 300
HELD_OUT = 2
# Each frame's loss is the mean over so many draws of noise and flow time.
DRAWS = 16
PLOT = Path("docs/images/libero_losses.png")


@dataclass
class LossesConfig:
    """There is nothing to choose."""


def main(_: LossesConfig) -> dict[str, Any]:
    """Train on eight demonstrations a task, judge every checkpoint on both kinds, plot, write and return."""
    root = dataset(LIBERO)
    meta = dataset_metadata("local/libero", str(root))
    learned = first_episodes(root, DEMOS - HELD_OUT)
    last, _ = policy(LIBERO, "losses", f"--save_freq={EVERY}", episodes=learned)
    config = OpenSPMPolicy.from_pretrained(last).config
    config.memory_episodes = learned
    frames = _frames(meta, config, learned)
    losses: dict[str, list[float]] = {name: [] for name in frames}
    steps = sorted(int(folder.name) for folder in last.parents[1].glob("[0-9]*"))
    samples: TrainingSet | None = None
    for step in tqdm(steps, unit="checkpoint"):
        acting = OpenSPMPolicy.from_pretrained(last.parents[1] / f"{step:06d}" / last.name)
        if samples is None:
            mined = dataset_processor(meta, config).key_poses(held_out=True)
            samples = training_set(mined, acting.require_memory().robot, config)
        for name, index in frames.items():
            losses[name].append(_loss(acting, samples, index))
    epochs = [round(step * config.samples_per_frame / len(frames["training"]), 2) for step in steps]
    _plot(epochs, losses)
    n = sum(len(index) for index in frames.values())
    return write("libero_losses", {"seed": 0, "n": n, "epochs": epochs, **losses, "plot": PLOT.name})


def _frames(meta: Any, config: Any, learned: list[int]) -> dict[str, Tensor]:
    """Dataset indices of the demonstrations learned from, and of those held out."""
    indices: dict[str, list[int]] = {"training": [], "validation": []}
    for episode in open_demonstrations(meta, config).episodes():
        kind = "training" if episode.index in learned else "validation"
        indices[kind] += range(episode.from_index, episode.from_index + len(episode))
    return {name: torch.tensor(index) for name, index in indices.items()}


def _loss(acting: OpenSPMPolicy, samples: TrainingSet, index: Tensor) -> float:
    """Flow-matching loss of frames as they are, with the same noise for every checkpoint."""
    generator = torch.Generator().manual_seed(0)
    condition, actions = samples.draw(index, 1, training=False)
    with torch.inference_mode():
        found = [
            acting.flow.loss(
                condition,
                actions,
                torch.randn(actions.shape, generator=generator),
                torch.rand(len(actions), generator=generator),
            ).mean()
            for _ in range(DRAWS)
        ]
    return round(float(torch.stack(found).mean()), 4)


def _plot(epochs: list[float], losses: dict[str, list[float]]) -> None:
    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    axes.plot(epochs, losses["training"], label="training, eight demonstrations a task")
    axes.plot(epochs, losses["validation"], label="validation, two held-out demonstrations a task")
    axes.set(xlabel="epochs", ylabel="flow-matching loss", yscale="log")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(PLOT, dpi=130)


if __name__ == "__main__":
    run(LossesConfig, main)
