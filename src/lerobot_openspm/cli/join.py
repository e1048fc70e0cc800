"""`openspm join`: put the checkpoints of several workplaces into one policy."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import draccus
from lerobot.configs import PreTrainedConfig

from lerobot_openspm.cli.options import require_checkpoint
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.workplaces import FOLDER, folder, folders

# What a policy has once, whatever the workplace.
COMMON = (
    "input_features", "output_features", "state_layout", "action_layout", "rotation", "control_hz",
    "perception", "segmenter", "conditioning", "chunk_size",
)  # fmt: skip


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
    paths, output = [Path(path) for path in config.policy.paths], Path(config.output_dir)
    if len(paths) < 2:
        raise OpenSPMError(f"--policy.paths names {len(paths)} checkpoints, expected at least two: [A,B]")
    for path in paths:
        require_checkpoint(path, "--policy.paths")
    if output.exists():
        raise OpenSPMError(f"{output} exists already; choose another --output_dir, or remove it")
    _check_alike(paths)
    beside = output.with_name(f".{output.name}.partial")
    if beside.exists():  # of a run that was interrupted
        shutil.rmtree(beside)
    shutil.copytree(paths[0], beside, ignore=shutil.ignore_patterns(FOLDER))
    memories = [read_memory(one) for path in paths for one in folders(path)]
    for i, memory in enumerate(memories):
        write_memory(memory, folder(beside, i))
    beside.rename(output)
    entries = [len(memory.entries) for memory in memories]
    print(json.dumps({"output": str(output), "workplaces": len(memories), "entries": entries}))


def _check_alike(paths: list[Path]) -> None:
    """Refuse policies that do not see and act alike. Raises OpenSPMError that names what differs."""
    first, *others = (PreTrainedConfig.from_pretrained(path) for path in paths)
    for path, other in zip(paths[1:], others, strict=True):
        for one, name in ((first, paths[0]), (other, path)):
            if not isinstance(one, OpenSPMConfig):
                raise OpenSPMError(f"{name} is a policy of type {one.type}, expected openspm")
        for name in COMMON:
            ours, theirs = getattr(first, name), getattr(other, name)
            if ours != theirs:
                raise OpenSPMError(
                    f"{path}: its {name} is {str(theirs)[:300]}, that of {paths[0]} {str(ours)[:300]}; one "
                    "policy has one, so train both alike"
                )
