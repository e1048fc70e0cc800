"""Where an object is in the first frames, before its shape is known: from its patches and the cues."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import intersect_plane
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception import foreground
from lerobot_openspm.perception.foreground import Blob, reach, triangulate
from lerobot_openspm.perception.objects.base import Instances, Look
from lerobot_openspm.perception.objects.mask_association import touched, whole_mask
from lerobot_openspm.perception.objects.shape import colour_bootstrap
from lerobot_openspm.perception.objects.shape.colour_bootstrap import Picture
from lerobot_openspm.perception.objects.shape.fitting import Evidence
from lerobot_openspm.perception.objects.shape.hull import Posed
from lerobot_openspm.types import DemonstrationScene, View

# Two rays that are to meet in an object may miss each other by this much, metres.
MAX_RAY_GAP = 0.05

# One view's evidence, and the patch of it that is the object; None where it was not seen.
Patched = tuple[Evidence, Blob | None]


def pictures_of(index: int, name: str, scene: DemonstrationScene, floor: float) -> list[Picture]:
    """A scene's views with the cues for one object and what changed when it was carried off."""
    cues = tuple(cue for cue in scene.cues if cue.name == name)
    look, later = Look(scene.views), scene.later_views or {}
    return [
        Picture(
            index, key, view, look.bins(key),
            colour_bootstrap.changed_pixels(view, later[key]) if key in later else None, cues, floor,
        )
        for key, view in scene.views.items()
    ]  # fmt: skip


def coloured(pictures: Sequence[Picture], log_odds: NDArray[np.float32]) -> dict[int, list[Patched]]:
    """By scene, each view's foreground by colour and the patch that the cues point at."""
    visible = colour_bootstrap.hiding_pixels(pictures, log_odds)
    groups: dict[int, list[Patched]] = {}
    for picture in pictures:
        probability = foreground.probability(picture.bins, log_odds)
        evidence = Evidence(picture.view, probability, visible.get(picture.camera), picture.camera)
        groups.setdefault(picture.scene, []).append(
            (evidence, colour_bootstrap.hinted_blob(picture, log_odds))
        )
    return groups


def masked(name: str, scene: DemonstrationScene, floor: float, instances: Instances) -> list[Patched]:
    """Each view's foreground by a segmenter: the instance that the hand touched, or nothing."""
    cues = [cue for cue in scene.cues if cue.name == name]
    seen = touched(scene.views, instances, cues, floor)
    group: list[Patched] = []
    for camera, view in scene.views.items():
        blob = whole_mask(seen[camera].mask) if camera in seen else None
        mask = np.zeros(view.image.shape[:2], bool) if blob is None else blob.mask
        group.append((Evidence(view, mask.astype(np.float32), None, camera), blob))
    return group


def why_nowhere(groups: Mapping[int, list[Patched]]) -> str:
    """Why :func:`first_poses` finds no place."""
    shown = max((sum(blob is not None for _, blob in group) for group in groups.values()), default=0)
    if shown == 0:
        return "nothing where the hand touched it stands out from what is around it, in any picture"
    if shown == 1:
        return "no two cameras show it at once"
    return "the cameras disagree about where it is"


def first_poses(groups: Mapping[int, list[Patched]]) -> tuple[list[Posed], float]:
    """Places from the patches' centres, at one height and yaw 0, and half the size of a cube around them."""
    places: dict[int, Array] = {}
    singles: dict[int, tuple[View, Blob]] = {}
    sizes: list[float] = []
    for index, group in groups.items():
        seen = [(one.view, blob) for one, blob in group if blob is not None]
        # Patches cut off by the image's border have a wrong centre: only if nothing else is left.
        seen = [(view, blob) for view, blob in seen if blob.whole] or seen
        if len(seen) >= 2:
            point, gap = triangulate([view for view, _ in seen], [blob.centre for _, blob in seen])
            if gap < MAX_RAY_GAP:
                places[index] = point
                sizes += [reach(view, blob, point) for view, blob in seen]
        elif seen:
            singles[index] = seen[0]
    if not places:
        return [], 0.0
    height = float(np.median([point[2] for point in places.values()]))
    for index, (view, blob) in singles.items():
        places[index] = intersect_plane(view.camera, view.T_world_cam, blob.centre, height)
    posed = [
        Posed(tuple(one for one, _ in groups[i]), se3.from_yaw([point[0], point[1], height], 0.0))
        for i, point in sorted(places.items())
    ]
    return posed, 1.25 * float(np.median(sizes))
