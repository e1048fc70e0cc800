"""The shape backend "SAM 3D Objects": the model runs in its own environment, this is the client.

SAM 3D works in PyTorch3D's camera frame: x left, y up, z forward, points as rows, so that
`p_cam = (p_obj * scale) @ R + translation`. Everything is brought into this project's frames here: OpenCV's
camera (x right, y down, z forward), points as columns. Source: the paper, section "Semantically Conditioned
3D Perception": reconstruction of single objects gives local shape and principal-axis directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.object_shape import ObjectShape, make_upright
from lerobot_openspm.perception.objects.sam3d import worker as sam3d_worker
from lerobot_openspm.perception.objects.sam3d.process import WorkerProcess
from lerobot_openspm.perception.objects.sam3d.worker import Arrays, Message
from lerobot_openspm.perception.objects.shape import silhouette
from lerobot_openspm.types import Segmentation, View

# Turns PyTorch3D's camera frame into OpenCV's and back.
FLIP = np.diag([-1.0, -1.0, 1.0])
ANSWER = {"rotation_wxyz": (4,), "translation": (3,), "scale": (3,), "centre": (3,), "extents": (3,)}
# A quaternion that went through half precision is off by less.
UNIT_TOLERANCE = 0.01
LARGEST_M = 10.0
MIN_DEPTH_PIXELS = 16


@dataclass(frozen=True)
class Reconstruction:
    """An object as SAM 3D found it, in our frames; lengths are in metres if the point map was.

    Attributes:
        T_cam_box: Pose ``(4, 4)`` of the object's box, its origin at the box's centre, in OpenCV's frame.
        extents: Of the box along its axes ``(3,)``.
        points_cam: Points ``(n, 3)`` of its surface in the camera frame.
    """

    T_cam_box: Array
    extents: Array
    points_cam: Array

    def scaled(self, factor: float) -> Reconstruction:
        """The same picture of an object that is so many times as large and as far away."""
        T = self.T_cam_box.copy()
        T[:3, 3] *= factor
        return Reconstruction(T, self.extents * factor, self.points_cam * factor)


class Sam3dShape:
    """Shapes by SAM 3D Objects, one object a call; a :class:`ShapeBackend`. Use it in a `with` statement.

    The model knows sizes only from depth. Where the view has none, points of the object in the world tell the
    size, or else the plane it stands on.

    Args:
        command: The worker's command, from :func:`worker_command`. It is started at the first call.
        support_height: World z in metres of the plane that objects stand on, for views without depth.
        seed: Where the model's random numbers start, for each object anew.
        start_timeout_s: Until the worker must have loaded the model.
        timeout_s: Until it must have answered.
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        support_height: float | None = None,
        seed: int = 42,
        start_timeout_s: float = 600.0,
        timeout_s: float = 120.0,
    ):
        self._worker = WorkerProcess(command, start_timeout_s, timeout_s)
        self._support_height, self._seed = support_height, seed

    def __enter__(self) -> Sam3dShape:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End the worker; a later call starts another."""
        self._worker.close()

    def describe(
        self, view: View, segmentation: Segmentation, points_world: Array | None = None
    ) -> ObjectShape:
        """The object's upright box. See :class:`ShapeBackend`; quality is the overlap of shape and mask.

        Raises:
            PerceptionError: The worker cannot be used, its answer makes no sense, or nothing tells the size.
        """
        _check_view(view, segmentation)
        metric = _has_depth(view, segmentation)
        if not metric and points_world is None and self._support_height is None:
            raise PerceptionError(
                f"SAM 3D needs to know the size: got fewer than {MIN_DEPTH_PIXELS} pixels of the object with "
                "depth, no points of it and no support height; expected one of them; pass support_height=Z"
            )
        reply = self._worker.ask(Message("request", 0, request_arrays(view, segmentation), self._seed))
        found = reconstruction_from(reply.arrays)
        if not metric:
            found = found.scaled(self._factor(found, view, points_world))
        _expect(
            found.extents.max() < LARGEST_M, "extents", reply.arrays, f"less than {LARGEST_M:g} m, scaled"
        )
        box = make_upright(view.T_world_cam @ found.T_cam_box, found.extents)
        return ObjectShape(box.T_world_obj, box.extents, _quality(found, view, segmentation), box.tilt)

    def _factor(self, found: Reconstruction, view: View, points_world: Array | None) -> float:
        if points_world is not None:
            return factor_by_points(found, se3.apply(se3.inverse(view.T_world_cam), points_world))
        assert self._support_height is not None
        return factor_by_plane(found, view.T_world_cam, self._support_height)


def worker_command(python: Path, checkout: Path, checkpoint: Path | None = None) -> tuple[str, ...]:
    """The command of the real worker.

    Args:
        python: The Python of the environment that SAM 3D Objects is installed in.
        checkout: Folder of the sam-3d-objects repository.
        checkpoint: Folder of the weights with `pipeline.yaml`; `checkpoints/hf` of the checkout by default.
    """
    where = () if checkpoint is None else ("--checkpoint", str(checkpoint))
    # -P: the script's folder, with its `types.py`, must not come before the standard library.
    return (str(python), "-P", sam3d_worker.__file__, "--checkout", str(checkout), *where)


def request_arrays(view: View, segmentation: Segmentation) -> Arrays:
    """The picture, the mask and, where there is depth, the point map in PyTorch3D's camera frame.

    A mirrored picture (negative ``fx``) is turned back: the model supposes a camera that does not mirror.
    """
    arrays: dict[str, NDArray] = {
        "image": np.asarray(view.image, np.uint8),
        "mask": np.asarray(segmentation.mask, np.uint8),
    }
    if _has_depth(view, segmentation):
        arrays["pointmap"] = (_point_map(view) @ FLIP).astype(np.float32)
    return {name: array[:, ::-1] for name, array in arrays.items()} if view.camera.fx < 0 else arrays


def reconstruction_from(arrays: Arrays) -> Reconstruction:
    """Check an answer and bring it into our frames.

    Raises:
        PerceptionError: Something is missing, not finite, of another shape, not a rotation, or no object.
    """
    for name, shape in ANSWER.items():
        _expect(name in arrays and arrays[name].shape == shape, name, arrays, f"shape {shape}")
    many = np.ndim(arrays.get("points", 0)) == 2 and arrays["points"].shape[1] == 3
    most = sam3d_worker.MAX_POINTS
    fits = many and 8 <= len(arrays["points"]) <= most
    _expect(fits, "points", arrays, f"shape (n, 3) with n at least 8 and at most {most}")
    for name in (*ANSWER, "points"):
        _expect(bool(np.isfinite(arrays[name]).all()), name, arrays, "finite numbers")
    values = {name: np.asarray(arrays[name], float) for name in (*ANSWER, "points")}
    quat_wxyz, scale, extents = values["rotation_wxyz"], values["scale"], values["extents"]
    norm = float(np.linalg.norm(quat_wxyz))
    _expect(abs(norm - 1) < UNIT_TOLERANCE, "rotation_wxyz", arrays, "a unit quaternion")
    _expect(bool((scale > 0).all()), "scale", arrays, "positive numbers")
    size = extents * scale
    _expect(bool((extents >= 0).all()) and size.max() > 0, "extents", arrays, "the sizes of a box")
    slack = 0.01 * extents.max()
    inside = bool((np.abs(values["points"] - values["centre"]) <= extents / 2 + slack).all())
    _expect(inside, "points", arrays, "points within the box")
    R_cam_obj = FLIP @ se3.matrix_from_quat_xyzw(quat_wxyz[[1, 2, 3, 0]]).T
    T_cam_obj = se3.transform(R_cam_obj, FLIP @ values["translation"])
    centre = se3.apply(T_cam_obj, (values["centre"] * scale)[None])[0]
    points_cam = se3.apply(T_cam_obj, values["points"] * scale)
    _expect(bool((points_cam[:, 2] > 0).all()), "translation", arrays, "an object in front of the camera")
    return Reconstruction(se3.transform(R_cam_obj, centre), size, points_cam)


def factor_by_points(found: Reconstruction, points_cam: Array) -> float:
    """How many times as far as found the object is, from points ``(n, 3)`` of its visible surface.

    Raises:
        PerceptionError: No point lies in front of the camera.
    """
    ahead = points_cam[np.isfinite(points_cam).all(axis=1) & (points_cam[:, 2] > 0.01)]
    if not len(ahead):
        raise PerceptionError(
            f"SAM 3D needs points to know the size: got none of {len(points_cam)} before the camera, "
            "expected at least one; check the camera's calibration"
        )
    cloud = found.points_cam
    near = min(8, len(cloud))
    # In the picture next to each other, the front one is the one that is seen.
    _, index = KDTree(cloud[:, :2] / cloud[:, 2:]).query(ahead[:, :2] / ahead[:, 2:], k=near)
    front = cloud[:, 2][index].min(axis=1)
    return float(np.median(ahead[:, 2] / front))


def factor_by_plane(found: Reconstruction, T_world_cam: Array, support_height: float) -> float:
    """How many times as far as found the object is, if its lowest point is at a height of the world, metres.

    Raises:
        PerceptionError: The camera is not above the plane or does not look down on the object.
    """
    lowest = float((found.points_cam @ T_world_cam[:3, :3].T)[:, 2].min())
    drop = float(support_height - T_world_cam[2, 3])
    if drop >= 0 or lowest >= -1e-6:
        raise PerceptionError(
            f"SAM 3D needs the plane under the object to know the size: got a plane {-drop:.3f} m below the "
            f"camera and an object that reaches {-lowest:.3f} below it, expected both below; check the "
            "camera's calibration and support_height"
        )
    return drop / lowest


def _check_view(view: View, segmentation: Segmentation) -> None:
    shape, n_pixels = view.image.shape[:2], np.count_nonzero(segmentation.mask)
    if segmentation.mask.shape != shape or not n_pixels:
        raise PerceptionError(
            f"SAM 3D: got a mask of shape {segmentation.mask.shape} with {n_pixels} pixels, expected shape "
            f"{shape} and at least one pixel; pass the mask of this view"
        )
    if view.depth is not None and view.depth.shape != shape:
        raise PerceptionError(
            f"SAM 3D: got depth of shape {view.depth.shape}, expected {shape}; "
            "pass depth aligned with the image"
        )


def _has_depth(view: View, segmentation: Segmentation) -> bool:
    if view.depth is None:
        return False
    known = np.isfinite(view.depth) & (view.depth > 0) & segmentation.mask
    return np.count_nonzero(known) >= MIN_DEPTH_PIXELS


def _point_map(view: View) -> Array:
    """Points ``(H, W, 3)`` in OpenCV's camera frame, NaN where there is no depth."""
    camera = view.camera
    depth = np.asarray(view.depth, float)
    z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    v, u = np.indices(z.shape)
    return np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)


def _quality(found: Reconstruction, view: View, segmentation: Segmentation) -> float:
    """Intersection over union of the shape, drawn in the view, and the mask."""
    points = found.points_cam
    spacing = 2 * float(np.median(KDTree(points).query(points, k=2)[0][:, 1]))
    at_camera = replace(view, T_world_cam=np.eye(4))
    drawing = silhouette.draw(points, spacing, np.eye(4), at_camera, detail_px=200.0)
    if drawing is None:
        return 0.0
    mask = np.asarray(segmentation.mask, np.float32)
    common, model, _ = silhouette.overlap(drawing, mask, None)
    return min(1.0, common / (model + np.count_nonzero(segmentation.mask) - common))


def _expect(fine: bool, name: str, arrays: Arrays, expected: str) -> None:
    if not fine:
        got = arrays.get(name)
        what = "nothing" if got is None else f"shape {got.shape}: {np.asarray(got).ravel()[:6]}"
        raise PerceptionError(
            f"SAM 3D worker: its answer's {name!r}: got {what}, expected {expected}; see docs/sam3d.md for "
            "the messages"
        )
