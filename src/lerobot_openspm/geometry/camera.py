"""Pinhole cameras: calibration files, projection of world points, rays through pixels.

Camera frames are OpenCV's: x right, y down, z forward. Pixel centres have integer coordinates, so the
optical centre of an image of width w is near ``(w - 1) / 2``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

FORMAT, VERSION = "openspm-cameras", 1
MAX_FILE_BYTES = 1_000_000


@dataclass(frozen=True)
class Camera:
    """A calibrated pinhole camera, fixed in the world or carried by the hand.

    Attributes:
        width: Image width in pixels.
        height: Image height in pixels.
        fx: Focal length in pixels, horizontally; negative where images are mirrored left to right, as
            LeRobot shows LIBERO.
        fy: Focal length in pixels, vertically.
        cx: Optical centre, horizontal pixel coordinate.
        cy: Optical centre, vertical pixel coordinate.
        mount: Frame that carries the camera, ``"world"`` or ``"ee"``.
        T_mount_cam: Pose ``(4, 4)`` of the camera in that frame.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    mount: Literal["world", "ee"]
    T_mount_cam: Array

    @property
    def focal_px(self) -> float:
        """Pixels per radian near the optical centre, for sizes."""
        return abs(self.fx)

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera read out at another resolution. Raises CalibrationError on another aspect ratio."""
        sx, sy = width / self.width, height / self.height
        if abs(sx / sy - 1) > 0.01:
            raise CalibrationError(
                f"images are {width} x {height} but the calibration is for {self.width} x {self.height}, "
                "another aspect ratio; calibrate for the images' shape"
            )
        # Pixel centres are integers, so half a pixel is added before scaling and removed after.
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5, cy=(self.cy + 0.5) * sy - 0.5,
        )  # fmt: skip

    def T_world_cam(self, T_world_ee: ArrayLike) -> Array:
        """Pose ``(4, 4)`` of the camera in the world, given the hand's ``T_world_ee``."""
        return self.T_mount_cam if self.mount == "world" else np.asarray(T_world_ee, float) @ self.T_mount_cam


def check_sizes(cameras: Mapping[str, Camera], sizes: Mapping[str, tuple[int, int]], where: str) -> None:
    """Compare a calibration with the images it is for.

    Args:
        cameras: The calibration.
        sizes: Height and width of every camera's images, by camera key.
        where: Names the calibration in errors.

    Raises:
        CalibrationError: A camera has no images, or images of another aspect ratio.
    """
    for key, camera in cameras.items():
        if key not in sizes:
            raise CalibrationError(
                f"{where}: cameras[{key!r}] has no images here, expected one of {', '.join(sorted(sizes))}; "
                "rename it in the file, or leave it out"
            )
        height, width = sizes[key]
        try:
            camera.scaled(width, height)
        except CalibrationError as error:
            raise CalibrationError(f"{where}: cameras[{key!r}] 'width' and 'height': {error}") from error


def project(camera: Camera, T_world_cam: ArrayLike, points_world: ArrayLike) -> tuple[Array, Array]:
    """Project world points into the image.

    Args:
        camera: Intrinsics.
        T_world_cam: Camera pose ``(4, 4)``.
        points_world: Points ``(..., 3)`` in metres.

    Returns:
        Pixel coordinates ``(..., 2)`` as (horizontal, vertical), and depths ``(...)`` in metres along the
        optical axis. Points behind the camera have a depth <= 0 and NaN coordinates.
    """
    points_world = np.asarray(points_world, float)
    p_cam = se3.apply(se3.inverse(T_world_cam), points_world.reshape(-1, 3))
    depth = p_cam[:, 2]
    ahead = np.where(depth > 1e-6, depth, np.nan)
    uv = np.stack(
        [camera.fx * p_cam[:, 0] / ahead + camera.cx, camera.fy * p_cam[:, 1] / ahead + camera.cy], -1
    )
    return uv.reshape(*points_world.shape[:-1], 2), depth.reshape(points_world.shape[:-1])


def ray_directions(camera: Camera, T_world_cam: ArrayLike, uv: ArrayLike) -> Array:
    """Unit directions ``(..., 3)`` in the world of the rays through pixels ``(..., 2)``."""
    uv = np.asarray(uv, float)
    x, y = (uv[..., 0] - camera.cx) / camera.fx, (uv[..., 1] - camera.cy) / camera.fy
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.asarray(T_world_cam, float)[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def intersect_plane(camera: Camera, T_world_cam: ArrayLike, uv: ArrayLike, height: ArrayLike) -> Array:
    """Points ``(..., 3)`` where rays through pixels ``(..., 2)`` meet the horizontal plane ``z = height``."""
    rays = ray_directions(camera, T_world_cam, uv)
    origin = np.asarray(T_world_cam, float)[:3, 3]
    along = (np.asarray(height, float) - origin[2]) / rays[..., 2]
    return origin + along[..., None] * rays


def cameras_from_dict(data: Mapping[str, Any], where: str) -> dict[str, Camera]:
    """Read the contents of a calibration file; `where` names it in errors.

    Raises:
        CalibrationError: A field is missing or not a number, or a pose is not rigid.
    """
    if data.get("format") != FORMAT or data.get("version") != VERSION:
        raise CalibrationError(
            f"{where}: got format {data.get('format')!r} version {data.get('version')!r}, "
            f"expected {FORMAT!r} version {VERSION}"
        )
    cameras = data.get("cameras")
    if not isinstance(cameras, Mapping) or not cameras:
        raise CalibrationError(f"{where}: 'cameras' must be an object with at least one camera")
    return {
        key: _camera_from_dict(fields, f"{where}: cameras[{key!r}]")
        for key, fields in cast(Mapping[str, Mapping[str, Any]], cameras).items()
    }


def _camera_from_dict(fields: Mapping[str, Any], where: str) -> Camera:
    try:
        width, height = int(fields["width"]), int(fields["height"])
        fx, fy, cx, cy = (float(fields[name]) for name in ("fx", "fy", "cx", "cy"))
        mount, T_mount_cam = str(fields["mount"]), np.asarray(fields["T_mount_cam"], float)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{where}: missing or malformed field: {error}") from error
    for name in ("width", "height"):
        if float(fields[name]) != int(fields[name]):
            raise CalibrationError(f"{where}: {name!r} is {fields[name]}, expected whole pixels")
    if mount not in ("world", "ee"):
        raise CalibrationError(f"{where}: 'mount' is {mount!r}, expected 'world' or 'ee'")
    if T_mount_cam.shape != (4, 4) or not se3.is_rigid(T_mount_cam):
        raise CalibrationError(f"{where}: 'T_mount_cam' is not a rigid (4, 4) transform")
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(abs(fx), fy, width, height) > 0):
        raise CalibrationError(
            f"{where}: sizes and focal lengths must be positive and finite (fx may be negative: mirrored); "
            f"got width {width}, height {height}, fx {fx}, fy {fy}"
        )
    return Camera(width, height, fx, fy, cx, cy, mount, T_mount_cam)


def cameras_to_dict(cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """The JSON form of a calibration, read back by :func:`cameras_from_dict`."""
    fields = ("width", "height", "fx", "fy", "cx", "cy", "mount")
    return {
        "format": FORMAT,
        "version": VERSION,
        "cameras": {
            key: {
                **{name: getattr(camera, name) for name in fields},
                "T_mount_cam": camera.T_mount_cam.tolist(),
            }
            for key, camera in cameras.items()
        },
    }


def load_cameras(path: Path) -> dict[str, Camera]:
    """Read a calibration file. Raises CalibrationError naming the file and the field."""
    if not path.is_file():
        raise CalibrationError(
            f"no calibration file at {path}; pass --policy.cameras=FILE (see configs/cameras)"
        )
    if path.stat().st_size > MAX_FILE_BYTES:
        raise CalibrationError(f"{path}: larger than {MAX_FILE_BYTES} bytes, not a calibration file")
    try:
        data = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: not JSON: {error}") from error
    if not isinstance(data, dict):
        raise CalibrationError(f"{path}: expected a JSON object, got {type(data).__name__}")
    return cameras_from_dict(cast(dict[str, Any], data), str(path))
