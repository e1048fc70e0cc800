"""From cues to colours: which pixels of the first frames are the object's, agreed over all demonstrations.

Mining says where the hand touched an object, not what the object looks like. Pixels near those places, if
possible those that changed when the object was carried off, start a colour model; its patches, grown a
little, replace the places, and so on, until the model covers whatever consistently belongs together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.perception import foreground
from lerobot_openspm.perception.foreground import Blob, disc, find_blobs, grow
from lerobot_openspm.perception.objects.mask_association import column
from lerobot_openspm.types import ContactCue, Mask, View

SEED_RADIUS = 0.03
CHANGED_RADIUS = 0.07
RELEASE_RADIUS = 0.03
# Nothing is said about the pixels this near a seed: they may be more of the same object.
NEUTRAL_RADIUS = 0.22
CHANGED_LEVELS = 25
ROUNDS = 5
PRESENCE = 0.55
MIN_ENCLOSED = 4
# Of two like objects the cameras see one at most so many times as large as the other, in pixels.
ALIKE = 4.0
# Among like objects, a colour of theirs is so many times as dense where the hand touched as elsewhere.
DENSER = 3.0


@dataclass(frozen=True)
class Picture:
    """One view of one scene's first frame, with the cues for one object.

    Attributes:
        scene: Index of the scene.
        camera: Name of the camera.
        view: The view.
        bins: Its colour bins ``(H, W)``.
        changed: Pixels ``(H, W)`` that differ in the later frame; None without a later frame.
        cues: The cues.
        floor: World height below which no part of a release column is sought, metres.
    """

    scene: int
    camera: str
    view: View
    bins: foreground.Bins
    changed: Mask | None
    cues: tuple[ContactCue, ...]
    floor: float

    def seed(self) -> Mask:
        """Pixels ``(H, W)`` that may be the object's, judging by the cues alone."""
        seed = np.zeros(self.bins.shape, bool)
        for cue in self.cues:
            if cue.kind == "release":
                for point in column(cue, self.floor):
                    seed |= disc(self.view, point, RELEASE_RADIUS)
                continue
            near = disc(self.view, cue.point_world, SEED_RADIUS)
            if self.changed is not None and (self.changed & near).sum() > 0.3 * max(near.sum(), 1):
                near = disc(self.view, cue.point_world, CHANGED_RADIUS) & self.changed
            seed |= near
        return seed

    def neutral(self) -> Mask:
        """Pixels ``(H, W)`` within a wide radius of the cues."""
        mask = np.zeros(self.bins.shape, bool)
        for cue in self.cues:
            for point in column(cue, self.floor) if cue.kind == "release" else [cue.point_world]:
                mask |= disc(self.view, point, NEUTRAL_RADIUS)
        return mask


def changed_pixels(first: View, later: View) -> Mask | None:
    """Pixels ``(H, W)`` that differ between two frames; None if the camera moved in between."""
    if not np.allclose(first.T_world_cam, later.T_world_cam, atol=1e-3):
        return None
    difference = np.abs(first.image.astype(np.int16) - later.image.astype(np.int16)).max(axis=-1)
    return difference > CHANGED_LEVELS


def learn_colours(pictures: Sequence[Picture], among_others: bool = False) -> NDArray[np.float32]:
    """Log-odds ``(N_BINS,)`` per colour of the object that the pictures' cues touch.

    Args:
        pictures: The pictures.
        among_others: Whether others just like it may be in them, which are no evidence against its colours.
    """
    regions = [picture.seed() for picture in pictures]
    outsides = [~(picture.neutral() | region) for picture, region in zip(pictures, regions, strict=True)]
    near, far = (sum(int(mask.sum()) for mask in masks) for masks in (regions, outsides))
    # By density: the whole of another such object has far more pixels than the seeds within this one.
    weight = DENSER * near / far if among_others and far else 1.0
    log_odds = _evidence(pictures, regions, outsides, weight)
    for _ in range(ROUNDS):
        regions, outsides = [], []
        for picture in pictures:
            blob = hinted_blob(picture, log_odds)
            region = (
                np.zeros(picture.bins.shape, bool)
                if blob is None
                else grow(blob.mask, 1 + 0.2 * blob.area**0.5)
            )
            regions.append(region)
            own = region
            if among_others and blob is not None:
                own = region | _alike(picture, log_odds, blob)
            outsides.append(~grow(own, 2) if region.any() else region)
        log_odds = _evidence(pictures, regions, outsides)
    return log_odds


def _alike(picture: Picture, log_odds: NDArray[np.float32], blob: Blob) -> Mask:
    """Pixels ``(H, W)`` of patches that have a patch's colours and about its size."""
    mask = np.zeros(picture.bins.shape, bool)
    for other in find_blobs(foreground.probability(picture.bins, log_odds), 8, 6):
        if 1 / ALIKE < other.area / blob.area < ALIKE:
            mask |= grow(other.mask, 1 + 0.2 * other.area**0.5)
    return mask


def hinted_blob(picture: Picture, log_odds: NDArray[np.float32]) -> Blob | None:
    """The patch of the object's colours that a picture's cues point at; None if there is none."""
    blobs = find_blobs(foreground.probability(picture.bins, log_odds), 8, 6)
    seed = picture.seed()
    near = grow(seed, 4) if seed.any() else seed
    touched = [(float((blob.mask & near).sum()), blob) for blob in blobs]
    count, blob = max(touched, key=lambda pair: pair[0], default=(0.0, None))
    return blob if count >= 4 else None


def hiding_pixels(
    pictures: Sequence[Picture], log_odds: NDArray[np.float32]
) -> dict[str, NDArray[np.float32]]:
    """Per camera, 0 where the hand or the like always hides the object and 1 elsewhere, ``(H, W)``.

    At the start of every episode the hand is at the same place. Pixels that lie within the convex hull of the
    object's patch in some scenes, yet never show its colours, are taken for it.
    """
    enclosed: dict[str, NDArray[np.float32]] = {}
    shown: dict[str, NDArray[np.float32]] = {}
    for picture in pictures:
        blob = hinted_blob(picture, log_odds)
        if blob is None:
            continue
        hull = np.zeros(picture.bins.shape, np.uint8)
        cv2.fillConvexPoly(hull, cv2.convexHull(np.argwhere(blob.mask)[:, ::-1].astype(np.int32)), 1)
        colours = foreground.probability(picture.bins, log_odds) > 0.5
        enclosed[picture.camera] = enclosed.get(picture.camera, 0) + hull.astype(np.float32)
        shown[picture.camera] = shown.get(picture.camera, 0) + (hull & colours).astype(np.float32)
    visible = {}
    for camera, count in enclosed.items():
        hides = (count >= MIN_ENCLOSED) & (shown[camera] <= 0.1 * count)
        hides = cv2.morphologyEx(hides.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        visible[camera] = 1.0 - cv2.dilate(hides, np.ones((5, 5), np.uint8)).astype(np.float32)
    return visible


def _evidence(
    pictures: Sequence[Picture], regions: Sequence[Mask], outsides: Sequence[Mask], weight: float = 1.0
) -> NDArray[np.float32]:
    """Log-odds ``(N_BINS,)`` of what is inside; what is outside counts by a weight."""
    inside = [
        foreground.histogram(p.bins[region])
        for p, region in zip(pictures, regions, strict=True)
        if region.sum() >= 6
    ]
    outside = sum(foreground.histogram(p.bins[mask]) for p, mask in zip(pictures, outsides, strict=True))
    if not inside:
        return np.full(foreground.N_BINS, -foreground.MAX_LOG_ODDS, np.float32)
    return foreground.evidence(inside, weight * np.asarray(outside), PRESENCE)
