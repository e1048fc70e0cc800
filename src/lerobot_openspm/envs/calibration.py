"""Calibration of the tabletop's cameras, read from the MuJoCo model."""

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.envs.tabletop.scene import CAMERA_NAMES
from lerobot_openspm.envs.tabletop.simulator import compiled_model

# MuJoCo's cameras look along -z with y up, OpenCV's along z with y down.
MUJOCO_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
MOUNTS = {"front": "world", "side": "world", "wrist": "ee"}


def camera_calibration(camera: str, height: int = 256, width: int = 256) -> dict[str, Any]:
    """Intrinsics and mounting of one camera at an image size.

    Pixel centres are at integer coordinates; the camera's frame is OpenCV's (x right, y down, z forward).

    Args:
        camera: A name in `CAMERA_NAMES`.
        height: Image height in pixels.
        width: Image width in pixels.

    Returns:
        width, height, fx, fy, cx, cy (pixels), mount ("world" or "ee"), T_mount_cam (nested lists, 4 x 4).
    """
    model = compiled_model()
    index = model.camera(camera).id
    focal = 0.5 * height / math.tan(math.radians(float(model.cam_fovy[index])) / 2)
    T_mount_mujoco = np.eye(4)
    T_mount_mujoco[:3, :3] = _matrix(model.cam_quat[index])
    # The hand's body frame is the ee frame, so a camera on the hand is given in ee coordinates already.
    T_mount_mujoco[:3, 3] = model.cam_pos[index]
    return {
        "width": width,
        "height": height,
        "fx": focal,
        "fy": focal,
        "cx": (width - 1) / 2,
        "cy": (height - 1) / 2,
        "mount": MOUNTS[camera],
        "T_mount_cam": np.round(T_mount_mujoco @ MUJOCO_FROM_OPENCV, 9).tolist(),
    }


def calibration_document(height: int = 256, width: int = 256) -> dict[str, Any]:
    """All cameras in the camera file's format, keyed by LeRobot's observation names."""
    cameras = {f"observation.images.{name}": camera_calibration(name, height, width) for name in CAMERA_NAMES}
    return {"format": "openspm-cameras", "version": 1, "cameras": cameras}


def _matrix(quat_wxyz: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(np.roll(quat_wxyz, -1)).as_matrix()
