"""Does the policy still act as it did? Recorded episodes are shown to it again, and every action compared.

    python -m benchmarks.replay --record=true       # ten episodes of each simulator, with what the policy did
    python -m benchmarks.replay                     # after a change that should not change what it does

A change that only moves code must give every bit of every action again. The observations are those of the
recording, whatever the policy does, so one wrong action does not hide the next.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from tqdm import tqdm

from lerobot_openspm.modeling_openspm import OpenSPMPolicy

SEED = 2_350_000  # a tuning seed; LIBERO's episodes begin from scenes drawn by it, not from the benchmark's


@dataclass
class ReplayConfig:
    """What is compared.

    Args:
        record: Run the episodes in the simulators and write them down, instead of comparing.
        episodes: Folder of the recorded episodes.
        tabletop: Checkpoint that acts on the tabletop; "" leaves its episodes out.
        libero: Checkpoint that acts on LIBERO; "" leaves its episodes out.
    """

    record: bool = False
    episodes: str = "outputs/replay"
    tabletop: str = "outputs/demo/demos_10/train/checkpoints/last/pretrained_model"
    libero: str = "outputs/libero/demos_10/train/checkpoints/last/pretrained_model"


def main(config: ReplayConfig) -> int:
    """Record or compare; returns the number of episodes that differ."""
    torch.set_num_threads(1)
    checkpoints = {"tabletop": config.tabletop, "libero": config.libero}
    folder, results = Path(config.episodes), {}
    for suite, checkpoint in checkpoints.items():
        if not checkpoint:
            continue
        policy = OpenSPMPolicy.from_pretrained(checkpoint)
        if config.record:
            (folder / suite).mkdir(parents=True, exist_ok=True)
            for name, episode in tqdm(_run(policy, suite), desc=f"{suite}, recording", unit="episode"):
                np.savez_compressed(folder / suite / f"{name}.npz", **episode)
        files = sorted((folder / suite).glob("*.npz"))
        if not files:
            raise FileNotFoundError(f"no recorded episodes in {folder / suite}; pass --record=true first")
        results[suite] = [_compare(policy, file) for file in tqdm(files, desc=suite, unit="episode")]
    for suite, found in results.items():
        for one in found:
            if one["first_difference"] is not None:
                print(f"{suite} {one['episode']}: actions differ from step {one['first_difference']} on")
    differ = sum(one["first_difference"] is not None for found in results.values() for one in found)
    counts = {f"{suite}_episodes": len(found) for suite, found in results.items()}
    steps = sum(one["steps"] for found in results.values() for one in found)
    print(json.dumps({**counts, "steps": steps, "differ": differ}))
    return differ


def _compare(policy: OpenSPMPolicy, file: Path) -> dict[str, Any]:
    """Show one recorded episode to the policy; where its actions first differ, if they do."""
    with np.load(file) as recorded:
        arrays = dict(recorded)
    policy.reset()
    first = None
    for step, action in enumerate(arrays["action"]):
        batch: dict[str, Any] = {
            key: torch.from_numpy(value[step]).permute(2, 0, 1).contiguous()[None].float() / 255
            for key, value in arrays.items()
            if key.startswith("observation.images.")
        }
        batch["observation.state"] = torch.from_numpy(arrays["observation.state"][step])[None]
        batch["task"] = [str(arrays["task"])]
        with torch.inference_mode():
            got = policy.select_action(batch)[0].numpy()
        if first is None and not np.array_equal(got, action):
            first = step
    return {"episode": file.stem, "steps": len(arrays["action"]), "first_difference": first}


def _run(policy: OpenSPMPolicy, suite: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Run the suite's episodes, and yield each with its name."""
    for name, world, interfere in _tabletop_worlds() if suite == "tabletop" else _libero_worlds():
        yield name, _run_one(policy, world, interfere)


def _run_one(policy: OpenSPMPolicy, world: Any, interfere: Any) -> dict[str, Any]:
    """Run one episode; everything that was seen and done, by LeRobot's names."""
    policy.reset()
    cameras = list(policy.config.image_features)
    seen: dict[str, list[np.ndarray]] = {key: [] for key in ("observation.state", *cameras, "action")}
    over = False
    while not over and len(seen["action"]) < world.max_steps:
        if interfere is not None:
            interfere(len(seen["action"]))
        state = world.state()
        images = {key: world.image(key.removeprefix("observation.images.")) for key in cameras}
        batch: dict[str, Any] = {
            key: torch.from_numpy(image.copy()).permute(2, 0, 1).contiguous()[None].float() / 255
            for key, image in images.items()
        }
        batch["observation.state"] = torch.from_numpy(np.array(state))[None]
        batch["task"] = [world.instruction]
        with torch.inference_mode():
            action = policy.select_action(batch)[0].numpy()
        for key, value in {"observation.state": state, **images, "action": action}.items():
            seen[key].append(np.array(value))
        over, _ = world.step(action)
    return {**{key: np.stack(value) for key, value in seen.items()}, "task": np.array(world.instruction)}


def _tabletop_worlds() -> Iterator[tuple[str, Any, Any]]:
    """Every task once, the tasks that grasp once more with the object moved or dropped on the way."""
    from benchmarks.disturbances import GRASPED, Disturbance
    from benchmarks.worlds import TabletopWorld
    from lerobot_openspm.envs.tabletop.env import TabletopEnv
    from lerobot_openspm.envs.tabletop.tasks import TASK_NAMES

    for number, task in enumerate(TASK_NAMES):
        env = TabletopEnv(task=task)
        yield task, TabletopWorld(env, SEED + number), None
        if task in GRASPED:
            kind = ("displaced", "dropped")[number % 2]
            world = TabletopWorld(env, SEED + 100 + number)
            yield f"{task}_{kind}", world, Disturbance(world, kind, np.random.default_rng(number))
        env.close()


def _libero_worlds() -> Iterator[tuple[str, Any, Any]]:
    """Every task of LIBERO-GOAL once."""
    from benchmarks.worlds import LIBERO_IMAGE_SIZE, LiberoWorld
    from lerobot_openspm.envs.libero.simulator import LiberoSimulator, tasks

    for number, task in enumerate(tasks()):
        simulator = LiberoSimulator(task, LIBERO_IMAGE_SIZE)
        simulator.reset(SEED + number)
        yield task, LiberoWorld(simulator), None
        simulator.close()


if __name__ == "__main__":
    sys.exit(main(draccus.parse(ReplayConfig)) > 0)
