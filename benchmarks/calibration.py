"""Error of cameras that were estimated from ten episodes, against the simulator's own.

``python -m benchmarks.calibration [--env.type=libero]``: from the demonstrations of `make demo` or of `make
libero`, recorded if need be. Ten episodes are the k-th of each task, for several k.
"""

import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.results import run, write
from benchmarks.stages import EnvironmentOption
from lerobot_openspm.calibration.estimate import estimate_camera
from lerobot_openspm.calibration.tracks import track_features
from lerobot_openspm.cli.calibrate import errors
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry.camera import Camera, load_cameras
from lerobot_openspm.mining.dataset import Demonstrations, dataset_metadata
from lerobot_openspm.mining.signals import Episode
from lerobot_openspm.training import open_demonstrations

CHOICES = 5
MAX_POSITION_MM, MAX_ROTATION_DEG = 5.0, 0.5


@dataclass
class Source:
    """A dataset and its true cameras."""

    demonstrations: Demonstrations
    episodes: list[Episode]
    cameras: dict[str, Camera]


@dataclass
class CalibrationConfig:
    """Whose cameras to estimate; of all tasks."""

    env: EnvironmentOption = field(default_factory=EnvironmentOption)


def main(config: CalibrationConfig) -> dict[str, Any]:
    """Measure, write and return the result."""
    root = config.env.dataset()
    cv2.setNumThreads(1)
    source = read(root, OpenSPMConfig(device="cpu", push_to_hub=False, rotation="axis_angle"))
    name, rows = config.env.type.removeprefix("openspm_"), {}
    for key, truth in source.cameras.items():
        runs = [one for k in range(CHOICES) for one in estimate(source, key, truth, k)]
        rows[f"{name} {key.rsplit('.', 1)[1]}"] = {
            "field of view given": summary([one for one in runs if one["fov_given"]]),
            "field of view estimated": summary([one for one in runs if not one["fov_given"]]),
        }
    return write(
        f"calibration{config.env.suffix}", {"seed": 0, "n": CHOICES, "episodes": 10, "cameras": rows}
    )


def read(folder: Path, config: OpenSPMConfig) -> Source:
    demonstrations = open_demonstrations(dataset_metadata("local/calibration", str(folder)), config)
    return Source(
        demonstrations, demonstrations.episodes(), load_cameras(folder / "meta" / "openspm_cameras.json")
    )


def kth_of_each_task(episodes: list[Episode], k: int) -> list[Episode]:
    tasks = dict.fromkeys(episode.task for episode in episodes)
    return [[e for e in episodes if e.task == task][k] for task in tasks]


def estimate(source: Source, key: str, truth: Camera, k: int) -> list[dict]:
    """Both variants for one choice of episodes; features are followed once."""
    episodes, start_s, tracks = kth_of_each_task(source.episodes, k), time.monotonic(), []
    for number, episode in enumerate(episodes):
        images = source.demonstrations.images(episode, key)
        tracks += track_features(images, number, moving_only=truth.mount == "world")
    tracking_s = time.monotonic() - start_s
    runs = []
    for fov_deg in (math.degrees(2 * math.atan(truth.height / 2 / truth.fy)), None):
        start_s = time.monotonic()
        found: dict[str, Any] = {"k": k, "fov_given": fov_deg is not None, "refused": None}
        try:
            estimated = estimate_camera(
                tracks,
                [episode.T_world_ee for episode in episodes],
                width=truth.width,
                height=truth.height,
                mount=truth.mount,
                fov_deg=fov_deg,
                mirrored=None,
                rng=np.random.default_rng(0),
            )
            found |= errors(estimated.camera, truth)
            found["position_sd_mm"] = round(1e3 * estimated.position_sd_m, 2)
            found["focal_percent"] = round(100 * (estimated.camera.fy / truth.fy - 1), 3)
            found["mirrored_right"] = estimated.camera.fx * truth.fx > 0
            found["reprojection_px"] = round(estimated.reprojection_px, 3)
        except CalibrationError as error:
            found["refused"] = str(error)
        found["seconds"] = round(tracking_s + time.monotonic() - start_s, 1)
        print(key, json.dumps(found), flush=True)
        runs.append(found)
    return runs


def summary(runs: list[dict]) -> dict:
    kept = [run for run in runs if run["refused"] is None]
    position, rotation = ([run[name] for run in kept] for name in ("position_mm", "rotation_deg"))
    good = sum(
        p <= MAX_POSITION_MM and r <= MAX_ROTATION_DEG for p, r in zip(position, rotation, strict=True)
    )
    return {
        "within": f"{good} of {len(runs)}",
        "position_mm_mean": round(float(np.mean(position)), 2) if kept else None,
        "position_mm_max": max(position, default=None),
        "rotation_deg_mean": round(float(np.mean(rotation)), 3) if kept else None,
        "rotation_deg_max": max(rotation, default=None),
        "seconds_max": max(run["seconds"] for run in runs),
        "runs": runs,
    }


if __name__ == "__main__":
    run(CalibrationConfig, main)
