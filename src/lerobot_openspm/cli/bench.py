"""`openspm bench COMMAND`: what users measure on their own checkpoint, dataset and machine."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import draccus

from lerobot_openspm.cli.options import DatasetOption, require_checkpoint, run_command


@dataclass
class PolicyOption:
    """What to measure."""

    path: str  # folder of the checkpoint


@dataclass
class LatencyConfig:
    """Measure how long a checkpoint's decisions take, on a frame of a dataset.

    Args:
        policy: The checkpoint.
        dataset: Where the frame is.
        episode: The frame's episode.
        frame: Its number in the episode.
        instruction: What is asked; the episode's own task if not given.
        threads: That torch computes with.
        repeats: How many first actions are timed, and ten times as many chunks.
    """

    policy: PolicyOption
    dataset: DatasetOption = field(default_factory=DatasetOption)
    episode: int = 0
    frame: int = 0
    instruction: str | None = None
    threads: int = 1
    repeats: int = 100

    def __post_init__(self) -> None:
        if self.threads < 1 or self.repeats < 1:
            raise ValueError(f"threads and repeats must be at least 1, got {self.threads} and {self.repeats}")


def latency(args: list[str]) -> None:
    """Print the time of a chunk of actions, and of an episode's first action, with images."""
    config = draccus.parse(LatencyConfig, args=args)
    import torch

    from lerobot_openspm.bench import latency as measure
    from lerobot_openspm.mining.dataset import open_dataset
    from lerobot_openspm.modeling_openspm import OpenSPMPolicy
    from lerobot_openspm.search import observation_of

    require_checkpoint(Path(config.policy.path), "--policy.path")
    dataset = open_dataset(config.dataset.metadata())
    torch.set_num_threads(config.threads)
    policy = OpenSPMPolicy.from_pretrained(config.policy.path)
    observation = observation_of(policy, dataset, config.episode, config.frame, config.instruction)
    found = measure.latency(policy, observation, 10 * config.repeats, config.repeats)
    print(json.dumps({"instruction": observation.instruction, "threads": config.threads, **found}))


COMMANDS = {"latency": (__name__, "latency", "how long a checkpoint's decisions take on this machine")}


def main(args: list[str]) -> None:
    """Run one measurement."""
    run_command("openspm bench", COMMANDS, args)
