"""What SAM 3D says of an object, checked and brought into this project's frames.

SAM 3D works in PyTorch3D's camera frame: x left, y up, z forward, points as rows, so that
`p_cam = (p_obj * scale) @ R + translation`. Here the frame is OpenCV's: x right, y down, z forward, points as
columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.sam3d.worker import MAX_POINTS

type Arrays = Mapping[str, NDArray]

# Turns PyTorch3D's camera frame into OpenCV's and back.
FLIP = np.diag([-1.0, -1.0, 1.0])
ANSWER = {"rotation_wxyz": (4,), "translation": (3,), "scale": (3,), "centre": (3,), "extents": (3,)}
# A quaternion that went through half precision is off by less.
UNIT_TOLERANCE = 0.01


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


def reconstruction_from(arrays: Arrays) -> Reconstruction:
    """Check an answer and bring it into our frames.

    Raises:
        PerceptionError: Something is missing, not finite, of another shape, not a rotation, or no object.
    """
    for name, shape in ANSWER.items():
        expect(name in arrays and arrays[name].shape == shape, name, arrays, f"shape {shape}")
    many = np.ndim(arrays.get("points", 0)) == 2 and arrays["points"].shape[1] == 3
    fits = many and 8 <= len(arrays["points"]) <= MAX_POINTS
    expect(fits, "points", arrays, f"shape (n, 3) with n at least 8 and at most {MAX_POINTS}")
    for name in (*ANSWER, "points"):
        expect(bool(np.isfinite(arrays[name]).all()), name, arrays, "finite numbers")
    values = {name: np.asarray(arrays[name], float) for name in (*ANSWER, "points")}
    quat_wxyz, scale, extents = values["rotation_wxyz"], values["scale"], values["extents"]
    norm = float(np.linalg.norm(quat_wxyz))
    expect(abs(norm - 1) < UNIT_TOLERANCE, "rotation_wxyz", arrays, "a unit quaternion")
    expect(bool((scale > 0).all()), "scale", arrays, "positive numbers")
    size = extents * scale
    expect(bool((extents >= 0).all()) and size.max() > 0, "extents", arrays, "the sizes of a box")
    slack = 0.01 * extents.max()
    inside = bool((np.abs(values["points"] - values["centre"]) <= extents / 2 + slack).all())
    expect(inside, "points", arrays, "points within the box")
    R_cam_obj = FLIP @ se3.matrix_from_quat_xyzw(quat_wxyz[[1, 2, 3, 0]]).T
    T_cam_obj = se3.transform(R_cam_obj, FLIP @ values["translation"])
    centre = se3.apply(T_cam_obj, (values["centre"] * scale)[None])[0]
    points_cam = se3.apply(T_cam_obj, values["points"] * scale)
    expect(bool((points_cam[:, 2] > 0).all()), "translation", arrays, "an object in front of the camera")
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


def make_upright(T_world_box: Array, extents: Array) -> tuple[Array, Array, float]:
    """Turn a box about its centre, by the least angle, until one of its axes is vertical.

    Of the two directions along the long side, which a box does not tell apart, x takes the one with a heading
    from -90 up to 90 degrees.

    Args:
        T_world_box: Pose ``(4, 4)`` of the box, its origin at the box's centre.
        extents: Of the box along its own axes ``(3,)``, metres.

    Returns:
        Upright pose ``(4, 4)`` with its origin at the footprint's centre and x along the long side; length,
        width and height ``(3,)``, metres; the angle turned by, at most 0.956 radians.
    """
    R = T_world_box[:3, :3]
    vertical = int(np.abs(R[2]).argmax())
    axis = R[:, vertical] * (1.0 if R[2, vertical] >= 0 else -1.0)
    tilt = float(np.arctan2(np.hypot(axis[0], axis[1]), axis[2]))
    # The turn about axis x z by the angle between the two takes the axis to the vertical.
    across = np.array([axis[1], -axis[0], 0.0])
    length = float(np.linalg.norm(across))
    turn = se3.exp_so3(across / length * tilt) if length > 1e-12 else np.eye(3)
    level = [k for k in range(3) if k != vertical]
    long, short = sorted(level, key=lambda k: -extents[k])
    heading = turn @ R[:, long]
    yaw = float(se3.wrap_angle(np.arctan2(heading[1], heading[0]), np.pi))
    foot = T_world_box[:3, 3] - [0.0, 0.0, extents[vertical] / 2]
    size = np.asarray(extents, float)[[long, short, vertical]]
    return se3.from_yaw(foot, yaw), size, tilt


def expect(fine: bool, name: str, arrays: Arrays, expected: str) -> None:
    """Raise PerceptionError, which tells what an answer's array is and should be, unless it is fine."""
    if not fine:
        got = arrays.get(name)
        what = "nothing" if got is None else f"shape {got.shape}: {np.asarray(got).ravel()[:6]}"
        raise PerceptionError(
            f"SAM 3D worker: its answer's {name!r}: got {what}, expected {expected}; see docs/sam3d.md for "
            "its arrays"
        )
