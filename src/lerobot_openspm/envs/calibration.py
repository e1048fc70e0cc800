"""Calibration of MuJoCo's cameras, read from the simulator, in the camera file's format."""

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from lerobot_openspm.geometry.camera import Camera, cameras_to_dict
from lerobot_openspm.geometry.se3 import transform

# MuJoCo's cameras look along -z with y up, OpenCV's along z with y down.
MUJOCO_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

# The frame that carries a camera.
Mount = Literal["world", "ee"]


def calibration(
    model: Any,
    data: Any,
    cameras: Mapping[str, str],
    mounts: Mapping[str, Mount],
    T_world_ee: np.ndarray,
    size: tuple[int, int],
    mirrored: bool = False,
) -> dict[str, Any]:
    """The calibration file's document, keyed by LeRobot's observation names.

    Pixel centres are at integer coordinates; the camera's frame is OpenCV's (x right, y down, z forward).

    Args:
        model: MuJoCo's model.
        data: MuJoCo's data, whose positions are up to date.
        cameras: The cameras' names in the model, by the names of their images.
        mounts: What carries each of them.
        T_world_ee: The hand's pose in `data`, (4, 4).
        size: Height and width of the images in pixels.
        mirrored: Whether images are shown mirrored left to right, which makes the focal length negative.
    """
    (height, width), found = size, {}
    for image, name in cameras.items():
        index = model.camera(name).id
        focal = 0.5 * height / math.tan(math.radians(float(model.cam_fovy[index])) / 2)
        T_world_mujoco = transform(data.cam_xmat[index].reshape(3, 3), data.cam_xpos[index])
        T_world_mount = np.eye(4) if mounts[image] == "world" else T_world_ee
        T_mount_cam = np.linalg.inv(T_world_mount) @ T_world_mujoco @ MUJOCO_FROM_OPENCV
        found[f"observation.images.{image}"] = Camera(
            width=width,
            height=height,
            fx=-focal if mirrored else focal,
            fy=focal,
            cx=(width - 1) / 2,
            cy=(height - 1) / 2,
            mount=mounts[image],
            T_mount_cam=np.round(T_mount_cam, 9),
        )
    return cameras_to_dict(found)
