"""`openspm calibrate`: estimate a camera's pose from a dataset's own episodes, write a calibration file."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import draccus
import numpy as np
from tqdm import tqdm

from lerobot_openspm.calibration.estimate import Estimate, estimate_camera
from lerobot_openspm.calibration.tracks import track_features
from lerobot_openspm.cli.options import EpisodesOption
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.files import write_json
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera, cameras_to_dict, load_cameras
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.signals import Episode
from lerobot_openspm.training import open_demonstrations

EPISODES = 10

logger = logging.getLogger(__name__)


@dataclass
class CalibrateConfig:
    """Estimate one camera's pose from a LeRobotDataset's images and hand poses.

    Args:
        dataset: The demonstrations; if no episodes are chosen ten are used, of as many tasks as possible.
        camera: Key of the camera in the dataset.
        mount: What carries the camera: "world" where it stands still, "ee" where the hand carries it.
        fov_deg: Vertical field of view in degrees; estimated if not given, which is less exact.
        mirrored: Whether images are mirrored left to right; found if not given.
        output: Calibration file to write. Other cameras that it holds are kept.
        truth: Calibration file to compare with; the dataset's ``meta/openspm_cameras.json`` if not given and
            there.
        seed: Seed of the first estimate's random draws.
        policy: Options of the policy that say how to read the state, e.g.
            ``--policy.rotation=axis_angle``.
    """

    dataset: EpisodesOption = field(default_factory=EpisodesOption)
    camera: str = "observation.images.front"
    mount: str = "world"
    fov_deg: float | None = None
    mirrored: bool | None = None
    output: str = "outputs/cameras.json"
    truth: str | None = None
    seed: int = 0
    policy: OpenSPMConfig = field(default_factory=lambda: OpenSPMConfig(device="cpu", push_to_hub=False))

    def __post_init__(self):
        """Refuse values that make no sense before anything is read."""
        if self.mount not in ("world", "ee"):
            raise CalibrationError(f"--mount is {self.mount!r}, expected 'world' or 'ee'")
        if self.fov_deg is not None and not 5 <= self.fov_deg <= 150:
            raise CalibrationError(f"--fov_deg is {self.fov_deg}, expected 5 to 150 degrees (vertically)")


def main(args: list[str]) -> None:
    """Estimate, save, and print one JSON object."""
    config = draccus.parse(CalibrateConfig, args=args)
    known = load_cameras(Path(config.output)) if Path(config.output).exists() else {}
    truth = _truth(config)
    meta = config.dataset.metadata()
    demonstrations = open_demonstrations(meta, config.policy)
    episodes = demonstrations.episodes(config.dataset.episodes)
    chosen = episodes if config.dataset.episodes is not None else choose_episodes(episodes, EPISODES)
    estimate = calibrate(demonstrations, chosen, config)
    _log(estimate)
    Path(config.output).parent.mkdir(parents=True, exist_ok=True)
    write_json(Path(config.output), cameras_to_dict({**known, config.camera: estimate.camera}))
    found = {"reprojection_px": round(estimate.reprojection_px, 3), "file": config.output}
    compared = {} if truth is None else errors(estimate.camera, truth)
    print(json.dumps({"camera": config.camera, **found, **compared}))


def choose_episodes(episodes: Sequence[Episode], count: int) -> list[Episode]:
    """The first of every task, in the order of how far the hand turns, then the second of every task ..."""
    seen: Counter[str] = Counter()
    ranked = []
    for episode in episodes:
        R = episode.T_world_ee[:, :3, :3]
        turn = float(np.linalg.norm(se3.log_so3(R @ R[0].T), axis=1).max())
        ranked.append((seen[episode.task], -turn, episode.index, episode))
        seen[episode.task] += 1
    return [episode for *_, episode in sorted(ranked, key=lambda item: item[:3])[:count]]


def calibrate(
    demonstrations: Demonstrations, episodes: Sequence[Episode], config: CalibrateConfig
) -> Estimate:
    """Follow features through the episodes and estimate the camera from them.

    Raises:
        DatasetError: The dataset has no such camera.
        CalibrationError: The episodes do not determine the camera.
    """
    cv2.setNumThreads(1)  # the images are small: threads cost more than they bring
    tracks, size = [], (0, 0)
    for number, episode in enumerate(tqdm(episodes, desc="Episodes")):
        images = demonstrations.images(episode, config.camera)
        tracks += track_features(images, number, moving_only=config.mount == "world")
        size = images.shape[2], images.shape[1]
    return estimate_camera(
        tracks,
        [episode.T_world_ee for episode in episodes],
        width=size[0],
        height=size[1],
        mount="ee" if config.mount == "ee" else "world",
        fov_deg=config.fov_deg,
        mirrored=config.mirrored,
        rng=np.random.default_rng(config.seed),
    )


def _truth(config: CalibrateConfig) -> Camera | None:
    """The calibration to compare with, if there is one. It enters no estimate."""
    if config.truth is None:
        if config.dataset.root is None:
            return None
        beside = Path(config.dataset.root) / "meta" / "openspm_cameras.json"
        return load_cameras(beside).get(config.camera) if beside.exists() else None
    camera = load_cameras(Path(config.truth)).get(config.camera)
    if camera is None:
        raise CalibrationError(f"{config.truth} holds no camera {config.camera!r} to compare with")
    return camera


def errors(camera: Camera, truth: Camera) -> dict[str, Any]:
    """Distance in mm and angle in degrees between an estimate and the truth."""
    metres, radians = se3.distances(camera.T_mount_cam, truth.T_mount_cam)
    return {
        "position_mm": round(1e3 * float(metres), 2),
        "rotation_deg": round(float(np.rad2deg(radians)), 3),
    }


def _log(estimate: Estimate) -> None:
    camera = estimate.camera
    logger.info(
        "%d tracks of %d features; standard deviations: position %.1f mm, orientation %.2f degrees; vertical "
        "field of view %.2f degrees (standard deviation of the focal length %.2f %%); images are %s",
        estimate.n_tracks, estimate.n_features, 1e3 * estimate.position_sd_m,
        np.rad2deg(estimate.rotation_sd_rad), np.rad2deg(2 * np.arctan(camera.height / 2 / camera.fy)),
        100 * estimate.focal_sd, "mirrored" if camera.fx < 0 else "not mirrored",
    )  # fmt: skip
