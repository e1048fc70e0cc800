"""A box on a table, as a camera sees it and as SAM 3D would describe it."""

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from tests.perception.drawn_world import SIZE, cameras

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.types import Segmentation, View

EXTENTS = np.array([0.12, 0.06, 0.05])
T_WORLD_OBJ = se3.from_yaw([0.03, -0.02, 0.0], 0.6)
# From the footprint's centre to the box's.
UP = np.array([0, 0, EXTENTS[2] / 2])
PYTORCH3D = np.diag([-1.0, -1.0, 1.0])


def surface(extents: np.ndarray, n: int = 16) -> np.ndarray:
    """Points of a box's six sides, the box's centre at the origin."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.5, 0.5, n), np.linspace(-0.5, 0.5, n)))
    sides = [np.insert(np.stack([u, v], 1), axis, side, 1) for axis in range(3) for side in (-0.5, 0.5)]
    return np.concatenate(sides) * extents


def seen(mirrored: bool = False, depth: bool = True) -> tuple[View, Segmentation]:
    """The box and the table below it; the depth is the table's except at the box, where it is the box's."""
    camera, T_world_cam = cameras()["front"]
    points = se3.apply(T_WORLD_OBJ, surface(EXTENTS, 60) + UP)
    uv, z = project(camera, T_world_cam, points)
    mask = np.zeros((SIZE, SIZE), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(uv).astype(np.int32)), 1)
    v, u = np.indices((SIZE, SIZE))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    table = T_world_cam[2, 3] / -(rays @ T_world_cam[2, :3])
    nearest = table.copy()
    cells = np.rint(uv).astype(int)
    np.minimum.at(nearest, (cells[:, 1], cells[:, 0]), z)
    image = np.full((SIZE, SIZE, 3), 120, np.uint8)
    image[mask > 0] = (200, 30, 30)
    image[:, 0] = 255  # so that left and right differ
    measured = nearest.astype(np.float32)
    measured[:3] = 0
    if mirrored:
        camera = replace(camera, fx=-camera.fx, cx=SIZE - 1 - camera.cx)
        image, mask, measured = image[:, ::-1].copy(), mask[:, ::-1].copy(), measured[:, ::-1].copy()
    view = View(image, camera, T_world_cam, measured if depth else None)
    return view, Segmentation(mask > 0, 0.9)


def described(T_world_cam: np.ndarray, size: float = 1.0) -> dict[str, np.ndarray]:
    """SAM 3D's answer for the box: its canonical frame has the length along z and is a tenth off the centre.

    With another size, the same picture of a box that is larger and further away.
    """
    points = surface(EXTENTS)
    # Canonical axes: x is the box's width, y its height, z its length.
    R_obj_canonical = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    scale, centre = 0.3, np.array([0.1, -0.05, 0.02])
    canonical = points @ R_obj_canonical / scale + centre
    p_cam = se3.apply(se3.inverse(T_world_cam) @ T_WORLD_OBJ, points + UP)
    # Rows: p = (canonical * scale) @ R + t, solved for R and t from the points themselves.
    target = p_cam @ PYTORCH3D
    lengthened = np.hstack([canonical * scale, np.ones((len(points), 1))])
    solution = np.linalg.lstsq(lengthened, target, rcond=None)[0]
    quat_xyzw = Rotation.from_matrix(solution[:3]).as_quat()
    return {
        "rotation_wxyz": quat_xyzw[[3, 0, 1, 2]],
        "translation": solution[3] * size,
        "scale": np.full(3, scale * size),
        "centre": centre,
        "extents": EXTENTS @ np.abs(R_obj_canonical) / scale,
        "points": canonical.astype(np.float32),
    }
