"""Record a few demonstrations, and see what OpenSPM remembers of them.

    python examples/01_record_and_mine.py

A scripted hand shows each task a few times on the simulated tabletop. Mining then reduces every demonstration
to its key poses: where the hand was, relative to the object that mattered, when something changed.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.collection import CollectConfig, SimulatorConfig, collect
from lerobot_openspm.memory.io import write_memory
from lerobot_openspm.training import dataset_processor, memory_of

NAME = "local/openspm_tabletop"
CALIBRATION = Path(__file__).parents[1] / "configs/cameras/openspm_tabletop.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--tasks", default="bowl_on_plate,turn_on_stove", help="tasks to demonstrate")
    parser.add_argument("--demonstrations", type=int, default=4, help="of each task")
    parser.add_argument("--dataset", type=Path, help="a recorded dataset, instead of recording one")
    parser.add_argument("--output", type=Path, default=Path("outputs/examples/01"))
    options = parser.parse_args()

    # 1. Record. The result is an ordinary LeRobotDataset: videos, states, actions, instructions.
    root = options.dataset or options.output / "dataset"
    if options.dataset is None:
        collect(
            CollectConfig(
                SimulatorConfig(task=options.tasks), episodes=options.demonstrations, root=str(root)
            )
        )

    # 2. Mine. All that has to be known of the robot is where its cameras are; what the objects look like is
    #    learned from the demonstrations themselves.
    meta = LeRobotDatasetMetadata(NAME, root=root)
    config = OpenSPMConfig(cameras=str(CALIBRATION), device="cpu", push_to_hub=False)
    mined = dataset_processor(meta, config).mine()
    memory = memory_of(mined, config)

    # 3. Look. Demonstrations of one task should agree: a small spread means that the anchor is the right one.
    by_task = defaultdict(list)
    for entry in memory.entries:
        by_task[entry.language].append(entry)
    names = ", ".join(memory.objects)
    print(f"{meta.total_episodes} demonstrations, {meta.total_frames} frames; objects: {names}")
    for instruction, entries in by_task.items():
        print(f"\n{instruction!r}, remembered {len(entries)} times")
        for i, pose in enumerate(entries[0].key_poses):
            same = [entry.key_poses[i] for entry in entries if i < len(entry.key_poses)]
            spread = np.std([p.T_obj_ee[:3, 3] for p in same if p.phase == pose.phase], axis=0)
            spread_mm = 1000 * np.linalg.norm(spread)
            print(
                f"  {pose.phase:10s} relative to the {pose.anchor.place:8s} "
                f"hand {'closed' if pose.closed else 'open':6s} spread {spread_mm:5.1f} mm"
            )

    # 4. Keep. The memory is JSON that a person can read, and arrays beside it.
    directory = options.output / "memory"
    write_memory(memory, directory)
    print(f"\nsaved to {directory}; `openspm inspect --path={directory}` shows it")


if __name__ == "__main__":
    main()
