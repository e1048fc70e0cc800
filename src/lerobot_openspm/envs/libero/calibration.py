"""Calibration of LIBERO's two cameras as LeRobot shows them, read from the simulator."""

import math
from typing import Any

import numpy as np

from lerobot_openspm.envs.calibration import MUJOCO_FROM_OPENCV
from lerobot_openspm.envs.libero.simulator import CAMERAS, LiberoSimulator, tasks

MOUNTS = {"image": "world", "image2": "ee"}


def calibration_document(height: int = 256, width: int = 256) -> dict[str, Any]:
    """Both cameras in the camera file's format, keyed by LeRobot's observation names.

    robosuite draws images upside down; LeRobot turns them by 180 degrees, which leaves them mirrored left to
    right: hence the negative focal length.
    """
    simulator = LiberoSimulator(next(iter(tasks())))
    simulator.reset(0)
    cameras = {f"observation.images.{name}": _camera(simulator, name, height, width) for name in CAMERAS}
    simulator.close()
    return {"format": "openspm-cameras", "version": 1, "cameras": cameras}


def _camera(simulator: LiberoSimulator, name: str, height: int, width: int) -> dict[str, Any]:
    model, data = simulator.sim.model, simulator.sim.data
    index = model.camera_name2id(CAMERAS[name])
    focal = 0.5 * height / math.tan(math.radians(float(model.cam_fovy[index])) / 2)
    T_world_mujoco = np.eye(4)
    T_world_mujoco[:3, :3] = data.cam_xmat[index].reshape(3, 3)
    T_world_mujoco[:3, 3] = data.cam_xpos[index]
    T_world_mount = np.eye(4) if MOUNTS[name] == "world" else simulator.ee_pose()
    T_mount_cam = np.linalg.inv(T_world_mount) @ T_world_mujoco @ MUJOCO_FROM_OPENCV
    return {
        "width": width,
        "height": height,
        "fx": -focal,
        "fy": focal,
        "cx": (width - 1) / 2,
        "cy": (height - 1) / 2,
        "mount": MOUNTS[name],
        "T_mount_cam": np.round(T_mount_cam, 9).tolist(),
    }
