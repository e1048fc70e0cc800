"""A camera from demonstrations: tracks in, calibrated camera and its standard deviations out."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.calibration.initial import first_estimate, moving
from lerobot_openspm.calibration.observations import Mount, observe
from lerobot_openspm.calibration.refine import refine, refine_with_shared_features, variances
from lerobot_openspm.calibration.tracks import Track
from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array

# An estimate less certain than this is refused: two of these are 2 cm and 2 degrees.
MAX_POSITION_SD_M, MAX_ROTATION_SD_RAD = 0.01, np.deg2rad(1)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Estimate:
    """A calibrated camera and how sure it is.

    Attributes:
        camera: The camera.
        reprojection_px: Root mean square distance between where features were seen and where they should be.
        position_sd_m: Standard deviation of the camera's position.
        rotation_sd_rad: Standard deviation of its orientation.
        focal_sd: Standard deviation of the focal length, in parts of it; 0 where it was given.
        n_tracks: Tracks that the camera explains.
        n_features: Features that these are of.
    """

    camera: Camera
    reprojection_px: float
    position_sd_m: float
    rotation_sd_rad: float
    focal_sd: float
    n_tracks: int
    n_features: int


def estimate_camera(
    tracks: Sequence[Track],
    T_world_ee: Sequence[Array],
    *,
    width: int,
    height: int,
    mount: Mount,
    fov_deg: float | None,
    mirrored: bool | None,
    rng: np.random.Generator,
) -> Estimate:
    """Estimate a camera's pose from features that move with the hand, or lie still where the hand carries it.

    Args:
        tracks: Features that were followed; many may be of other things.
        T_world_ee: Hand poses ``(n, 4, 4)`` of each episode.
        width: Image width in pixels.
        height: Image height in pixels.
        mount: What carries the camera, ``"world"`` or ``"ee"``.
        fov_deg: Vertical field of view in degrees; estimated if None. Pixels are taken to be square and the
            optical centre to be in the middle.
        mirrored: Whether images are mirrored left to right; found if None.
        rng: Draws the tracks that first estimates are made from.

    Raises:
        CalibrationError: The tracks do not determine the camera.
    """
    focal = height / 2 / math.tan(math.radians(fov_deg or 60) / 2)
    blank = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, mount, np.eye(4))
    free_focal = fov_deg is None
    tracks = moving(tracks, height)
    camera = first_estimate(tracks, T_world_ee, blank, free_focal=free_focal, mirrored=mirrored, rng=rng)
    camera, believed = refine(camera, observe(tracks, T_world_ee, mount), free_focal=free_focal)
    camera, points, problem = refine_with_shared_features(camera, believed, free_focal=free_focal)
    r, variance = problem.residuals(camera, points), variances(camera, points, problem)
    estimate = Estimate(
        camera,
        reprojection_px=float(np.sqrt((r**2).sum(axis=1).mean())),
        position_sd_m=float(np.sqrt(variance[3:6].sum())),
        rotation_sd_rad=float(np.sqrt(variance[:3].sum())),
        focal_sd=float(np.sqrt(variance[6:].sum())),
        n_tracks=believed.n_tracks,
        n_features=problem.n_features,
    )
    _refuse_what_is_uncertain(estimate)
    return estimate


def _refuse_what_is_uncertain(estimate: Estimate) -> None:
    position_m, rotation_rad = estimate.position_sd_m, estimate.rotation_sd_rad
    if position_m <= MAX_POSITION_SD_M and rotation_rad <= MAX_ROTATION_SD_RAD:
        return
    raise CalibrationError(
        f"the episodes leave the camera's position open by {1e3 * position_m:.0f} mm and its orientation by "
        f"{np.rad2deg(rotation_rad):.1f} degrees (standard deviations), expected at most "
        f"{1e3 * MAX_POSITION_SD_M:.0f} mm and {np.rad2deg(MAX_ROTATION_SD_RAD):.0f}; record episodes in "
        "which the hand turns about two axes by 45 degrees or more while the camera sees it, and name them "
        "in --episodes=[...]"
    )
