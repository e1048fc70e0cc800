"""True masks and depths of the drawn world, and the points of a box that one camera sees."""

from dataclasses import replace

import cv2
import numpy as np
from tests.perception.drawn_world import DISTRACTOR, SHAPES, SIZE, cameras, views_of

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project, ray_directions
from lerobot_openspm.perception.objects.box.box import Box
from lerobot_openspm.perception.segmentation.given import GivenSegmenter
from lerobot_openspm.types import Segmentation, View

LABELS = {"block": 1, "cup": 2, "distractor": 3}
FINE = 4


def body(name: str, T_world_obj: np.ndarray) -> Box:
    """A shape of the drawn world as a box or cylinder."""
    half, height, _, _, is_round = SHAPES.get(name, DISTRACTOR)
    return Box(T_world_obj, np.array([2 * half[0], 2 * half[1], height]), is_round)


def labels_of(view: View, bodies: dict[str, Box], numbers: dict[str, int] = LABELS) -> np.ndarray:
    """Number of the body that covers most of each pixel, the nearest before those behind it."""
    height, width = view.image.shape[:2]
    fine = np.zeros((FINE * height, FINE * width), np.uint8)
    for name in sorted(bodies, key=lambda one: -_distance(view, bodies[one])):
        uv, _ = project(view.camera, view.T_world_cam, bodies[name].vertices())
        corners = np.rint(((uv + 0.5) * FINE - 0.5) * 16).astype(np.int32)
        cv2.fillConvexPoly(fine, cv2.convexHull(corners), numbers[name], shift=4)
    labels = np.zeros((height, width), np.int32)
    for number in numbers.values():
        share = cv2.resize((fine == number).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        labels[share > 0.5] = number
    return labels


def depth_of(view: View, boxes: list[Box]) -> np.ndarray:
    """Metres along the optical axis to the nearest of the boxes and the table ``z = 0``."""
    v, u = np.indices(view.image.shape[:2])
    rays = ray_directions(view.camera, view.T_world_cam, np.stack([u, v], axis=-1))
    origin = view.T_world_cam[:3, 3]
    nearest = -origin[2] / rays[..., 2]
    for box in boxes:
        R, t = box.T_world_obj[:3, :3], box.T_world_obj[:3, 3]
        start, along = (origin - t) @ R, rays @ R
        low, high = box.size * [-0.5, -0.5, 0.0], box.size * [0.5, 0.5, 1.0]
        ends = np.sort(np.stack([(low - start) / along, (high - start) / along]), axis=0)
        enters, leaves = ends[0].max(axis=-1), ends[1].min(axis=-1)
        nearest = np.where((enters < leaves) & (enters < nearest), enters, nearest)
    return (nearest * (rays @ view.T_world_cam[:3, 2])).astype(np.float32)


def masked_views(
    poses: dict[str, np.ndarray], T_moved: np.ndarray | None = None, only: tuple[str, ...] | None = None
) -> dict[str, View]:
    """The views of the drawn world with true labels."""
    views = views_of(poses, T_moved)
    bodies = {name: body(name, T) for name, T in poses.items()}
    return {
        camera: replace(view, labels=labels_of(view, bodies))
        for camera, view in views.items()
        if only is None or camera in only
    }


def masks_of(views: dict[str, View], name: str) -> dict[str, np.ndarray]:
    return {camera: view.labels == LABELS[name] for camera, view in views.items()}


def segmenter() -> GivenSegmenter:
    return GivenSegmenter(LABELS)


def instances_of(views: dict[str, View], name: str) -> dict[str, tuple[Segmentation, ...]]:
    return segmenter().segment(views, [name])[name]


def box_views(box: Box, T_moved: np.ndarray | None = None) -> dict[str, View]:
    """Views of one box alone, with labels and exact depth; the image shows nothing."""
    views = {}
    for name, (camera, T_world_usual) in cameras().items():
        T_world_cam = T_world_usual if T_moved is None else T_moved @ T_world_usual
        view = View(np.zeros((SIZE, SIZE, 3), np.uint8), camera, T_world_cam)
        views[name] = replace(view, labels=labels_of(view, {"block": box}), depth=depth_of(view, [box]))
    return views


def turned_yaw(T: np.ndarray, T_true: np.ndarray, period: float) -> float:
    """Difference of two yaws up to a symmetry, radians."""
    return float(abs(se3.wrap_angle(se3.yaw_of(T) - se3.yaw_of(T_true), period)))


def _distance(view: View, one: Box) -> float:
    return float(np.linalg.norm(one.T_world_obj[:3, 3] - view.T_world_cam[:3, 3]))
