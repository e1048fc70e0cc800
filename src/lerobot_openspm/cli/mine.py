"""`openspm mine`: mine a dataset into a memory, without training, and say what was found."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import draccus

from lerobot_openspm.cli.options import DatasetOption
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.memory.io import write_memory
from lerobot_openspm.mining.annotate import check_folder, write_annotated
from lerobot_openspm.training import dataset_processor, memory_of


@dataclass
class MineConfig:
    """Mine the key poses of a LeRobotDataset into a memory.

    Args:
        dataset: The demonstrations.
        output: Folder to write the memory to.
        annotated: Folder to write a copy of the dataset to, whose frames say which phase they belong to and
            which key pose comes next; none if not given.
        policy: Options of the policy that say how to mine, e.g. ``--policy.cameras=FILE``.
    """

    dataset: DatasetOption = field(default_factory=DatasetOption)
    output: str = "outputs/memory"
    annotated: str | None = None
    policy: OpenSPMConfig = field(default_factory=lambda: OpenSPMConfig(device="cpu", push_to_hub=False))


def main(args: list[str]) -> None:
    """Mine, save, and print one JSON object."""
    config = draccus.parse(MineConfig, args=args)
    start_s = time.monotonic()
    meta = config.dataset.metadata()
    processor = dataset_processor(meta, config.policy)
    annotated = Path(config.annotated) if config.annotated else None
    if annotated is not None:
        check_folder(processor.demonstrations, annotated)
    mined = processor.mine(held_out=annotated is not None)
    memory = memory_of(mined, config.policy)
    write_memory(memory, Path(config.output))
    if annotated is not None:
        write_annotated(processor.demonstrations, mined, annotated)
    summary = {
        "entries": len(memory.entries),
        "episodes": int(meta.total_episodes),
        "key_poses": sum(len(entry.key_poses) for entry in memory.entries),
        "skipped": int(meta.total_episodes) - len(memory.entries),
        "objects": sorted(memory.objects),
        "not_learned": [vars(one) for one in memory.not_learned],
        "output": config.output,
        "annotated": config.annotated,
        "seconds": round(time.monotonic() - start_s, 1),
    }
    print(json.dumps(summary))
