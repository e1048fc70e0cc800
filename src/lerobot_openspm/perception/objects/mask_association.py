"""Which of a segmenter's instances the hand touched, and which of them are one object in several views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from lerobot_openspm.geometry.camera import intersect_plane, project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.foreground import Blob
from lerobot_openspm.perception.objects.base import Instances
from lerobot_openspm.types import ContactCue, DemonstrationScene, Mask, Segmentation, Segmenter, View

# By camera: one object's mask.
ObjectMasks = dict[str, Segmentation]

# A cue belongs to an instance within this distance of its mask.
TOUCH_M = 0.04
MIN_PIXELS = 12
# Pieces of a mask smaller than this share of its largest are specks.
SPECK_SHARE = 0.1
MAX_OBJECTS = 3
# So many demonstrations are enough to learn one object from.
MAX_SCENES = 30


def column(cue: ContactCue, floor: float) -> list[Array]:
    """Points ``(3,)`` every 2 cm from a contact cue straight down to the world height ``floor``."""
    heights = np.arange(cue.point_world[2], floor - 1e-9, -0.02)
    return [np.array([*cue.point_world[:2], z], dtype=np.float64) for z in heights]


def whole_mask(mask: Mask) -> Blob | None:
    """The pieces of a mask ``(H, W)`` that are no specks, taken together; None if there are hardly any."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].astype(float)
    areas[0] = 0
    if areas.max() < MIN_PIXELS:
        return None
    kept = (areas >= SPECK_SHARE * areas.max())[labels] & (labels > 0)
    v, u = np.nonzero(kept)
    last = np.array(mask.shape) - 1
    whole = min(u.min(), v.min()) > 0 and v.max() < last[0] and u.max() < last[1]
    return Blob(kept, np.array([u.mean(), v.mean()]), float(len(u)), bool(whole))


def touched(
    views: Mapping[str, View], instances: Instances, cues: Sequence[ContactCue], floor: float
) -> ObjectMasks:
    """Per camera, the instance that is nearest to where the hand touched the object.

    Args:
        views: The first frame's views.
        instances: What the segmenter found in them.
        cues: Where the object was touched; below a release, down to the world height ``floor``.
        floor: World height below which nothing stands, metres.

    Returns:
        At most one instance per camera; none where the nearest is too far off.
    """
    points = [
        np.stack(column(cue, floor) or [cue.point_world]) if cue.kind == "release" else cue.point_world[None]
        for cue in cues
    ]
    found = {}
    for camera, ones in instances.items():
        distances = [
            float(np.mean([_distance(views[camera], one.mask, near) for near in points])) for one in ones
        ]
        if distances and min(distances) < TOUCH_M:
            found[camera] = ones[int(np.argmin(distances))]
    return found


def segmented(
    phrases: Sequence[str], scenes: Sequence[DemonstrationScene], segmenter: Segmenter
) -> dict[str, list[tuple[DemonstrationScene, Instances]]]:
    """By phrase, at most :data:`MAX_SCENES` scenes with a cue for it, and what a segmenter found of it there.

    A scene is shown to the segmenter once, with all its phrases: large models encode an image once for all.
    """
    wanted: dict[int, list[str]] = {}
    for phrase in phrases:
        with_cue = [i for i, scene in enumerate(scenes) if any(cue.name == phrase for cue in scene.cues)]
        for i in with_cue[:: max(1, -(-len(with_cue) // MAX_SCENES))]:
            wanted.setdefault(i, []).append(phrase)
    pairs: dict[str, list[tuple[DemonstrationScene, Instances]]] = {phrase: [] for phrase in phrases}
    for i, names in sorted(wanted.items()):
        found = segmenter.segment(scenes[i].views, names)
        for name in names:
            pairs[name].append((scenes[i], found[name]))
    return pairs


def _distance(view: View, mask: Mask, points_world: Array) -> float:
    """Smallest distance in metres, at the points' depth, of points ``(n, 3)`` from a mask; 0 within it."""
    uv, depth = project(view.camera, view.T_world_cam, points_world)
    v, u = np.nonzero(mask)
    pixels = np.stack([u, v], axis=1).astype(float)
    best = np.inf
    for point, metres in zip(uv, depth, strict=True):
        if metres > 0:
            gap = float(np.sqrt(((pixels - point) ** 2).sum(axis=1).min()))
            best = min(best, max(gap - 1, 0) * metres / view.camera.focal_px)
    return best


def associate(
    views: Mapping[str, View], instances: Instances, middle_height: float, radius: float
) -> list[ObjectMasks]:
    """Instances of all views that lie at one place, the most confident places first.

    Args:
        views: The views of one moment.
        instances: What the segmenter found in them.
        middle_height: World z of the middle of such an object, metres: masks' centres meet on that plane.
        radius: Half the diagonal of its footprint, metres; masks that the border cuts are placed worse.
    """
    rays = []
    for camera, ones in instances.items():
        view = views[camera]
        for one in ones:
            blob = whole_mask(one.mask)
            if blob is None:
                continue
            point = intersect_plane(view.camera, view.T_world_cam, blob.centre, middle_height)
            if (point - view.T_world_cam[:3, 3]) @ view.T_world_cam[:3, 2] > 0:
                clean = Segmentation(blob.mask, one.confidence)
                rays.append((not blob.whole, -one.confidence, camera, point, clean))
    rays.sort(key=lambda ray: ray[:3])
    groups: list[tuple[Array, ObjectMasks]] = []
    for is_cut, _, camera, point, one in rays:
        reach = (2.0 if is_cut else 1.0) * radius
        near = [
            (float(np.linalg.norm(point - place)), i)
            for i, (place, group) in enumerate(groups)
            if camera not in group
        ]
        distance, i = min(near, default=(np.inf, 0))
        if distance < reach:
            groups[i][1][camera] = one
        else:
            groups.append((point, {camera: one}))
    found = [group for _, group in groups]
    found.sort(key=lambda group: -sum(one.confidence for one in group.values()))
    return found[:MAX_OBJECTS]
