"""`openspm join`: put the checkpoints of several workplaces into one policy."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import draccus

from lerobot_openspm.cli.options import require_checkpoint
from lerobot_openspm.workplaces import join


@dataclass
class PoliciesOption:
    """The checkpoints, each of another workplace."""

    paths: list[str] = field(default_factory=list[str])  # e.g. [A,B]; the weights are those of the first


@dataclass
class JoinConfig:
    """Put the checkpoints of several workplaces into one policy. It tells by the hand where it is.

    At a workplace the cameras and the robot's base keep their places. Where several have the hand at the same
    place, the one is meant that knows the instruction best.
    """

    output_dir: str  # folder of the new checkpoint
    policy: PoliciesOption = field(default_factory=PoliciesOption)


def main(args: list[str]) -> None:
    """Join, and print one JSON object."""
    config = draccus.parse(JoinConfig, args=args)
    paths = [Path(path) for path in config.policy.paths]
    for path in paths:
        require_checkpoint(path, "--policy.paths")
    memories = join(paths, Path(config.output_dir))
    entries = [len(memory.entries) for memory in memories]
    print(json.dumps({"output": config.output_dir, "workplaces": len(memories), "entries": entries}))
