"""Whether a camera that is not where its calibration says is told at the first look, and it alone.

    python -m benchmarks.libero.wrong_calibration

In scenes of libero_goal that no demonstration shows, each camera in turn is taken to be off along or about
one of its axes. To which side is drawn with the scene.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.episodes import load
from benchmarks.harness import Row, checkpoint_files, measured_folder, resume
from benchmarks.libero import evaluate, places
from benchmarks.libero.places import draw, observe
from benchmarks.results import run, write
from benchmarks.stages import LIBERO, policy
from scipy.spatial.transform import Rotation

from lerobot_openspm.cli.pipeline import rate
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.libero.simulator import tasks
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.pipeline import Perception

OFF_M, OFF_RAD = 0.02, np.deg2rad(3.0)
# Of a camera; it looks along its z.
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
SCENES, FIRST_SEED, FIRST_TUNING_SEED = 20, 30_000, TUNING_SEED_START + 800_000


@dataclass
class WrongCalibrationConfig:
    """What to measure.

    Args:
        scenes: Each of a seed of its own, the tasks in turn.
        output: Folder for what is measured.
        workers: Scenes at a time, each in a process of its own; a single one stays in this process.
        tuning: Take scenes of tuning seeds; nothing is published then.
    """

    scenes: int = SCENES
    output: str = "outputs/bench/wrong_calibration_libero"
    workers: int = 2
    tuning: bool = False

    def __post_init__(self) -> None:
        if self.scenes < 1 or self.workers < 1:
            raise ValueError(f"scenes and workers must be at least 1, got {self.scenes} and {self.workers}")

    @property
    def first_seed(self) -> int:
        """The first scene's seed."""
        return FIRST_TUNING_SEED if self.tuning else FIRST_SEED

    def drawn(self, tasks: Sequence[str]) -> list[tuple[str, int]]:
        """Task and seed of every scene. Tasks of libero_goal draw the same scene from a seed."""
        seeds = range(self.first_seed, self.first_seed + self.scenes)
        return list(zip(itertools.cycle(tasks), seeds, strict=False))


def errors(rng: np.random.Generator) -> dict[str, Array]:
    """Errors of a camera's pose by name: where it is taken to be ``(4, 4)`` in its true frame."""
    found: dict[str, Array] = {}
    for name, axis in AXES.items():
        along, about = np.array(axis) * rng.choice([-1, 1]), np.array(axis) * rng.choice([-1, 1])
        found[f"2 cm along {name}"] = se3.transform(np.eye(3), OFF_M * along)
        found[f"3 degrees about {name}"] = se3.transform(
            Rotation.from_rotvec(OFF_RAD * about).as_matrix(), np.zeros(3)
        )
    return found


def spoilt(memory: Memory, camera: str, T_cam_off: Array) -> Memory:
    """A memory by which a camera is off."""
    known = memory.cameras[camera]
    off = replace(known, T_mount_cam=known.T_mount_cam @ T_cam_off)
    return replace(memory, cameras={**memory.cameras, camera: off})


def told(memory: Memory, seen: Observation) -> list[str]:
    """The cameras that a first look for all objects does not believe."""
    perception = Perception(memory, OpenSPMConfig().hand_radius_m)
    return sorted(perception.detect(seen, list(memory.objects), {}, 0.0).faults)


def look_at_scene(config: WrongCalibrationConfig, checkpoint: Path, task: str, seed: int) -> Row:
    """The cameras that are not believed in a scene: as calibrated, and by camera and error."""
    memory = load(str(checkpoint)).require_memory()
    simulator, seed = draw(task, seed, False)
    seen, rng = observe(memory, simulator), np.random.default_rng(seed)
    off = {
        camera: {name: told(spoilt(memory, camera, T), seen) for name, T in errors(rng).items()}
        for camera in memory.cameras
    }
    return {"task": task, "seed": seed, "right": told(memory, seen), "off": off}


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """How often a wrong camera was told, how often it alone, and how often one that was right."""
    cameras: dict[str, Any] = {}
    for camera, by_error in rows[0]["off"].items():
        cameras[camera] = {
            error: {
                **rate(sum(bool(row["off"][camera][error]) for row in rows), len(rows)),
                "named": sum(row["off"][camera][error] == [camera] for row in rows),
            }
            for error in by_error
        }
    return {"cameras": cameras, "right": rate(sum(bool(row["right"]) for row in rows), len(rows))}


def main(config: WrongCalibrationConfig) -> dict[str, Any]:
    """Do what is missing, write and return the result."""
    checkpoint, _ = policy(LIBERO)
    code = [Path(str(module.__file__)) for module in (evaluate, places)]
    files = [*checkpoint_files(checkpoint), *code]
    folder = measured_folder(Path(config.output), files, [str(config.tuning)], __file__)
    jobs = {f"{task} {seed}": (config, checkpoint, task, seed) for task, seed in config.drawn(list(tasks()))}
    rows = resume(folder / "scenes.jsonl", jobs, look_at_scene, config.workers)
    measured = {"seed": config.first_seed, "n": len(rows), **summary(rows)}
    return measured if config.tuning else write("wrong_calibration_libero", measured, config.workers)


if __name__ == "__main__":
    run(WrongCalibrationConfig, main)
