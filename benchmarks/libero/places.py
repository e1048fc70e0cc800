"""Which things of a suite are learned from demonstrations, and how well they are found in scenes never shown.

    python -m benchmarks.libero.places --suite=libero_spatial

Records demonstrations of the tasks that experts know, mines a memory from them, and compares one first look
at each of many seeded scenes with the simulator's poses. Everything is kept, and a second run does the rest.
"""

from __future__ import annotations

import functools
import itertools
import json
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from benchmarks.calls import watched
from benchmarks.episodes import LazyImages
from benchmarks.harness import Row, measured_folder, resume
from benchmarks.libero import evaluate, place_errors, variants
from benchmarks.libero.evaluate import kept_simulator, move_hand
from benchmarks.libero.place_errors import judged, not_known, several_of_a_kind, summary
from benchmarks.libero.variants import exchanged
from benchmarks.results import run, write
from benchmarks.stages import DEMOS, LIBERO, DatasetOption, dataset
from benchmarks.truth import offsets_in
from benchmarks.worlds import LiberoWorld

from benchmarks import calls, truth
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.collection import SUMMARY_FILE
from lerobot_openspm.envs.libero.simulator import DO_NOTHING, OBJECTS, SUITE, LiberoSimulator
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.envs.suites import find_suite
from lerobot_openspm.episodes import new_episode
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.files import write_json
from lerobot_openspm.language.names import TABLE_NAMES
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.mining import objects as mining_objects
from lerobot_openspm.mining.dataset import dataset_metadata
from lerobot_openspm.mining.objects import contact_cues
from lerobot_openspm.perception.objects.base import Kind
from lerobot_openspm.perception.objects.kinds import KINDS
from lerobot_openspm.perception.objects.patches.learn import PATCHES, learn_patches
from lerobot_openspm.perception.objects.surface.learn import SURFACE
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.pipeline import Perception
from lerobot_openspm.training import dataset_processor, memory_of
from lerobot_openspm.types import Detections, Hand, PoseEstimate

FIRST_SEED, FIRST_TUNING_SEED = 20_000, TUNING_SEED_START + 600_000
# LIBERO at times draws two things into each other, and one is thrown off: it still moves after half a second.
STILL_M, STILL_STEPS, REDRAWN = 0.002, 10, 10_000
LEARNED = "learned.json"


@dataclass
class PlacesConfig:
    """What to measure.

    Args:
        suite: libero_goal, libero_spatial or libero_object.
        exchanged: Whether things change places in the scenes, see `variants`.
        demos: Demonstrations a task to learn from.
        kinds: Of objects that are asked to learn, several with commas, or "all".
        scenes: Of each task. Every scene has a seed of its own: tasks of a suite may draw alike.
        dataset: The demonstrations; recorded if not given.
        output: Folder for what is measured; outputs/bench/NAME if not given.
        workers: Scenes at a time, each in a process of its own; a single one stays in this process.
        tuning: Take scenes of tuning seeds; nothing is published then.
    """

    suite: str = SUITE
    exchanged: bool = False
    demos: int = DEMOS
    kinds: str = "all"
    scenes: int = 50
    dataset: DatasetOption = field(default_factory=DatasetOption)
    output: str | None = None
    workers: int = 2
    tuning: bool = False

    def __post_init__(self) -> None:
        if self.suite not in OBJECTS:
            raise ValueError(f"suite is {self.suite!r}, expected one of {', '.join(OBJECTS)}")
        if unknown := [kind for kind in self.asked() if kind not in KINDS]:
            raise ValueError(f"there are no kinds {unknown}, expected all or some of {', '.join(KINDS)}")

    def asked(self) -> list[str]:
        """Names of the kinds that are asked to learn."""
        return list(KINDS) if self.kinds == "all" else self.kinds.split(",")

    @property
    def name(self) -> str:
        """The figure's name."""
        kinds = "" if self.kinds == "all" else "_" + "_".join(self.asked())
        demos = "" if self.demos == DEMOS else f"_demos_{self.demos}"
        return f"places_{self.suite}{'_exchanged' * self.exchanged}{demos}{kinds}{'_tuning' * self.tuning}"

    @property
    def first_seed(self) -> int:
        """The first scene's seed."""
        return FIRST_TUNING_SEED if self.tuning else FIRST_SEED

    def drawn(self, tasks: Sequence[str]) -> list[tuple[str, int]]:
        """Task and seed of every scene."""
        scenes = itertools.product(tasks, range(self.scenes))
        return [(task, seed) for seed, (task, _) in enumerate(scenes, self.first_seed)]

    def demonstrations(self) -> Path:
        """Folder of the demonstrations, recorded if need be."""
        if self.dataset.root is not None:
            return Path(self.dataset.root)
        return dataset(LIBERO, self.demos, self.suite)


def learn(root: Path, folder: Path, kinds: Collection[str]) -> dict[str, Any]:
    """Mine a memory of all demonstrations with these kinds of objects; what is learned of each touched thing.

    Returns:
        ``objects`` by name; ``seconds`` that all of mining took, and ``learn_objects_s``, the part of it in
        which perception learned the objects.
    """
    kept = folder / LEARNED
    if kept.is_file():
        return json.loads(kept.read_text())
    cameras = str(root / "meta/openspm_cameras.json")
    options = OpenSPMConfig(
        device="cpu", push_to_hub=False, cameras=cameras, rotation="axis_angle", control_hz=20
    )
    processor = dataset_processor(dataset_metadata("local/places", str(root)), options)
    begin = time.monotonic()
    with (
        patch.dict(KINDS, learning(kinds), clear=True),
        watched(mining_objects, "learn_objects") as learning_s,
    ):
        mined = processor.mine()
    memory, seconds = memory_of(mined, options), time.monotonic() - begin
    write_memory(memory, folder)
    cues = [(item.episode.index, cue) for item in mined.episodes for cue in contact_cues(item)]
    frames = offsets_in(memory, processor.demonstrations)
    told: dict[str, Any] = {}
    for name in sorted({cue.name for _, cue in cues}):
        model = memory.objects.get(name)
        told[name] = {
            "touched": len({episode for episode, cue in cues if cue.name == name}),
            "grasped": len({e for e, cue in cues if cue.name == name and cue.kind == "grasp"}),
            "learned": None if model is None else model.to_record()[0]["kind"],
            "T_sim_obj": frames[name].tolist() if name in frames else None,
        }
    spent = {"seconds": round(seconds, 1), "learn_objects_s": round(sum(learning_s), 1)}
    learned = {"episodes": len(mined.episodes), **spent, "objects": told}
    write_json(kept, learned)
    return learned


def learning(names: Collection[str]) -> dict[str, Kind]:
    """The kinds of some names; patches, which surfaces learn beside themselves, learn alone without these."""
    kinds = {name: kind for name, kind in KINDS.items() if name in names}
    if PATCHES.name in kinds and SURFACE.name not in kinds:
        kinds[PATCHES.name] = replace(PATCHES, learn=learn_patches)
    return kinds


def look_at_scene(config: PlacesConfig, folder: Path, task: str, seed: int) -> Row:
    """Draw a scene, look once for everything that the hand touched, and compare with the simulator."""
    memory, frames = _memory(folder)
    simulator, seed = draw(task, seed, config.exchanged)
    poses = simulator.object_poses()
    seen = observe(memory, simulator)
    estimates, spent_s = look(memory, seen, several_of_a_kind(poses, memory.objects))
    meant = sorted_out(memory, seen, estimates)
    found = {
        name: not_known(name, poses, memory.objects)
        if T is None or name not in estimates
        else judged(name, estimates[name], meant[name], poses, T, memory.objects)
        for name, T in frames.items()
    }
    return {"task": task, "seed": seed, "look_cpu_ms": round(1000 * spent_s), "objects": found}


def draw(task: str, seed: int, is_exchanged: bool) -> tuple[LiberoSimulator, int]:
    """A scene in which nothing moves, the hand somewhere, and the seed that it was drawn from."""
    while True:
        simulator = kept_simulator(task, exchanged(task, seed) if is_exchanged else None)
        simulator.reset(seed)
        move_hand(simulator, np.random.default_rng(seed))
        if is_still(simulator):
            return simulator, seed
        seed += REDRAWN


@functools.lru_cache(1)
def _memory(folder: Path) -> tuple[Memory, dict[str, np.ndarray | None]]:
    """The memory, and the frames ``T_sim_obj`` of what the hand touched; None of what was not learned."""
    touched = json.loads((folder / LEARNED).read_text())["objects"]
    frames = {name: told["T_sim_obj"] for name, told in touched.items()}
    return read_memory(folder), {name: T and np.array(T) for name, T in frames.items()}


def is_still(simulator: LiberoSimulator) -> bool:
    """Whether nothing moves; takes half a second of the scene."""
    before = simulator.object_poses()
    for _ in range(STILL_STEPS):
        simulator.step(np.array(DO_NOTHING))
    after = simulator.object_poses()
    return all(np.linalg.norm(after[name][:3, 3] - T[:3, 3]) < STILL_M for name, T in before.items())


def observe(memory: Memory, simulator: LiberoSimulator) -> Observation:
    """What a policy with this memory sees of a scene now."""
    if memory.layouts is None:
        raise OpenSPMError("the memory does not say how its robot's state is laid out; mine it again")
    layout, state = memory.layouts[0], simulator.state().astype(float)
    hand = Hand(layout.poses(state), float(layout.openings(state)))
    images = dict(LazyImages(LiberoWorld(simulator), tuple(memory.cameras)))
    return Observation(simulator.instruction, state, hand, images, None)


def look(
    memory: Memory, seen: Observation, told_apart: Collection[str]
) -> tuple[Mapping[str, PoseEstimate], float]:
    """A first look for all objects of a memory, and the processor's seconds that it took.

    Of the names that words tell apart every one is sought.
    """
    perception, begin = Perception(memory, OpenSPMConfig().hand_radius_m), time.process_time()
    found = perception.detect(seen, list(memory.objects), {}, 0.0, told_apart).estimates
    return found, time.process_time() - begin


def sorted_out(
    memory: Memory, seen: Observation, estimates: Mapping[str, PoseEstimate]
) -> Mapping[str, PoseEstimate]:
    """What was found of the objects that the instruction is about, as the policy sorts them out at first."""
    episode = new_episode(seen, memory, memory.entries, OpenSPMConfig(), TABLE_NAMES, None)
    episode.controller.advance(seen.hand)  # reads the instruction
    episode.controller.scene.take_in(Detections(estimates, {}), seen.hand)
    return episode.controller.scene.detections.estimates


def main(config: PlacesConfig) -> dict[str, Any]:
    """Do what is missing, write and return the result."""
    root = config.demonstrations()
    code = [Path(str(module.__file__)) for module in (calls, evaluate, place_errors, truth, variants)]
    files = [root / "meta/info.json", root / SUMMARY_FILE, *code]
    output = Path(config.output or f"outputs/bench/{config.name}")
    options = [config.suite, str(config.exchanged), *config.asked()]
    folder = measured_folder(output, files, options, __file__)
    learned = learn(root, folder, config.asked())
    tasks = find_suite(LIBERO, config.suite).tasks("all")
    jobs = {f"{task} {seed}": (config, folder, task, seed) for task, seed in config.drawn(tasks)}
    rows = resume(folder / "scenes.jsonl", jobs, look_at_scene, config.workers)
    for told in learned["objects"].values():
        del told["T_sim_obj"]
    about = {
        "seed": config.first_seed, "n": len(rows), "demonstrations": config.demos,
        "exchanged": config.exchanged, "kinds": config.kinds,
    }  # fmt: skip
    measured = {**about, "learned": learned, **summary(rows)}
    return measured if config.tuning else write(config.name, measured, config.workers)


if __name__ == "__main__":
    run(PlacesConfig, main)
