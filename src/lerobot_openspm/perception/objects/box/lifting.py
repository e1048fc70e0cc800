"""From an object's masks in calibrated views to points in the world.

The paper lifts masks "into point-set constraints in the world coordinate frame". Where a view has depth its
pixels are points already. Else two views or more bound the object by their visual hull, and a single view
leaves the rays and the plane that the object stands on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from lerobot_openspm.errors import ObservationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import intersect_plane, ray_directions
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.foreground import Blob, grow, reach, triangulate
from lerobot_openspm.perception.objects.mask_association import whole_mask
from lerobot_openspm.perception.objects.shape import hull
from lerobot_openspm.perception.objects.shape.fitting import Evidence
from lerobot_openspm.types import Mask, View

Source = Literal["depth", "hull", "plane"]

MIN_POINTS = 8
# A pixel whose depth is further from the middle one of its neighbours is between two surfaces or on another.
FLYING_M, FLYING_SHARE = 0.008, 0.01
# A point this many times further from its neighbours than points usually are belongs to nothing.
LONELY, NEIGHBOURS = 4.0, 8
# Depths and support planes are known to about this, metres: what lies further below the plane is an error.
BELOW_PLANE_M = 0.01
# How far around a mask the plane is looked at, beyond the pixels that may show both, pixels.
RING_PX = (2, 6)
HULL_SHARE = 0.9
HULL_MARGIN = 1.3
MAX_HALF_SIZE_M = 0.5


@dataclass(frozen=True)
class Lifted:
    """An object's points in the world.

    Attributes:
        points_world: Points ``(n, 3)``, metres; on its seen surfaces ("depth"), on the surface of its visual
            hull ("hull"), or where its rays meet the support plane ("plane"): the footprint and its shadow.
        source: What they come from.
        spacing: Distance between neighbouring points, metres.
        ray_gap_m: Largest distance of the rays through the centres of its whole masks from the point nearest
            to all; NaN where fewer than two masks end before the image does.
    """

    points_world: Array
    source: Source
    spacing: float
    ray_gap_m: float


def lift(views: Mapping[str, View], masks: Mapping[str, Mask], height: float) -> Lifted | None:
    """Points of one object from its masks; None where the masks leave too few of them.

    Args:
        views: The views of one moment, by camera.
        masks: The object's mask ``(H, W)`` in those of them that show it.
        height: World z of the plane that it stands on, metres.

    Raises:
        ObservationError: A mask belongs to no view, or a mask or a depth image has not the image's size.
    """
    if unknown := sorted(set(masks) - set(views)):
        raise ObservationError(
            f"masks of {unknown} but views of {sorted(views)}; give the view of every mask"
        )
    blobs = {}
    for name, mask in masks.items():
        _check_size(name, views[name], mask)
        if blob := whole_mask(mask):
            blobs[name] = blob
    if not blobs:
        return None
    seen = {name: views[name] for name in blobs}
    centre, gap = common_point(seen, blobs, height)
    points, spacing, source = _points(seen, blobs, centre, height)
    if len(points) < MIN_POINTS:
        return None
    return Lifted(points, source, spacing, gap)


def _points(
    views: Mapping[str, View], blobs: Mapping[str, Blob], centre: Array, height: float
) -> tuple[Array, float, Source]:
    """Points ``(n, 3)`` by the best source there is, their spacing, and that source."""
    deep = [name for name, view in views.items() if view.depth is not None]
    if deep:
        parts = [depth_points(views[name], blobs[name].mask) for name in deep]
        points = _settled(np.concatenate(parts), height)
        if len(points) >= MIN_POINTS:
            return points, _pixel_m(views[deep[0]], centre), "depth"
    if len(views) >= 2:
        return *_hull(views, blobs, centre, height), "hull"
    ((name, view),) = views.items()
    return plane_points(view, blobs[name].mask, height), _pixel_m(view, centre), "plane"


def common_point(views: Mapping[str, View], blobs: Mapping[str, Blob], height: float) -> tuple[Array, float]:
    """About the object's middle ``(3,)``, and the rays' largest distance from it (NaN for a single ray).

    A mask that the image's border cuts has another centre than the object: it is used only where no whole
    mask is left.
    """
    names = [name for name, blob in blobs.items() if blob.whole]
    gap = np.nan
    if len(names) >= 2 or (not names and len(blobs) >= 2):
        chosen = names or list(blobs)
        point, miss = triangulate([views[n] for n in chosen], [blobs[n].centre for n in chosen])
        return point, miss if names else gap
    name = (names or list(blobs))[0]
    return intersect_plane(views[name].camera, views[name].T_world_cam, blobs[name].centre, height), gap


def depth_points(view: View, mask: Mask) -> Array:
    """Points ``(n, 3)`` of a mask's pixels that have a depth in accordance with the mask's others nearby."""
    v, u = np.nonzero(mask)
    low, high = np.array([v.min(), u.min()]), np.array([v.max(), u.max()]) + 1
    depth = np.where(mask, np.asarray(view.depth, float), np.nan)[low[0] : high[0], low[1] : high[1]]
    depth[~(depth > 0) | ~np.isfinite(depth)] = np.nan
    padded = np.pad(depth, 2, constant_values=np.nan)
    near = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(*depth.shape, 25)
    known = np.isfinite(depth)
    middle = np.nanmedian(near[known], axis=-1)
    steady = np.abs(depth[known] - middle) <= np.maximum(FLYING_M, FLYING_SHARE * middle)
    rows, columns = (axis[steady] for axis in np.nonzero(known))
    uv = np.stack([columns + low[1], rows + low[0]], axis=1).astype(float)
    rays = ray_directions(view.camera, view.T_world_cam, uv)
    along = depth[known][steady] / (rays @ view.T_world_cam[:3, 2])
    return view.T_world_cam[:3, 3] + along[:, None] * rays


def support_height(view: View, mask: Mask) -> float | None:
    """World z, metres, of what lies around a mask in a view with depth: the plane that the object stands on.

    Half of the pixels around an object show that plane, beside and behind it, unless things crowd there.
    None where too few of them have a depth.
    """
    around = grow(mask, RING_PX[1]) & ~grow(mask, RING_PX[0])
    points = depth_points(view, around) if around.any() else np.empty((0, 3))
    return float(np.median(points[:, 2])) if len(points) >= MIN_POINTS else None


def plane_points(view: View, mask: Mask, height: float) -> Array:
    """Where the rays of a mask's pixels meet the plane ``z = height`` ahead of the camera ``(n, 3)``."""
    v, u = np.nonzero(mask)
    points = intersect_plane(view.camera, view.T_world_cam, np.stack([u, v], axis=1), height)
    return points[(points - view.T_world_cam[:3, 3]) @ view.T_world_cam[:3, 2] > 0]


def _settled(points: Array, height: float) -> Array:
    """Points without those below the support plane and those far from all others."""
    points = points[points[:, 2] > height - BELOW_PLANE_M]
    if len(points) <= NEIGHBOURS:
        return points
    distances, _ = KDTree(points).query(points, NEIGHBOURS + 1)
    usual = distances[:, 1:].mean(axis=1)
    return points[usual <= LONELY * np.median(usual)]


def _hull(
    views: Mapping[str, View], blobs: Mapping[str, Blob], centre: Array, height: float
) -> tuple[Array, float]:
    """Surface points ``(n, 3)`` of the visual hull above the support plane, and their spacing."""
    sizes = [reach(views[name], blob, centre) for name, blob in blobs.items()]
    half_size = float(min(HULL_MARGIN * max(sizes), MAX_HALF_SIZE_M))
    evidence = tuple(
        Evidence(views[name], blob.mask.astype(np.float32), camera=name) for name, blob in blobs.items()
    )
    T_world_cube = se3.from_yaw(centre, 0.0)
    votes = hull.vote([hull.Posed(evidence, T_world_cube)], half_size)
    cloud = votes.cloud(HULL_SHARE, (height - centre[2], np.inf))
    if cloud is None:
        return np.empty((0, 3)), votes.spacing
    return se3.apply(T_world_cube, cloud.points), votes.spacing


def _pixel_m(view: View, point_world: Array) -> float:
    """Metres between neighbouring pixels at a point's depth."""
    return float(np.linalg.norm(point_world - view.T_world_cam[:3, 3])) / view.camera.focal_px


def _check_size(name: str, view: View, mask: Mask) -> None:
    size = view.image.shape[:2]
    for what, array in (("mask", mask), ("depth image", view.depth)):
        if array is not None and array.shape != size:
            raise ObservationError(
                f"camera {name!r}: {what} of shape {array.shape} with an image of {size}; give both at the "
                "image's size"
            )
