"""Objects that hardly move between demonstrations: found again by matching small patches of the images.

Where an object stays within a few centimetres and keeps its direction, the pixels around it look alike in all
first frames, whatever its colours and its surroundings. A patch around the place that the hand touched is
sought near there in a new image, and its displacement in pixels is one in the world, on the object's plane.

Which camera shows the object well, and how large its patch should be, is not known: a patch that is too large
follows the table, one that is too small finds no hold. Every choice, a *probe*, is tried on the
demonstrations, and judged by how well it explains where the hand went.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.model import Patch, PatchModel, Picture, Probe
from lerobot_openspm.perception.types import UNKNOWN_YAW_STD, Hint, PoseEstimate, Scene, View

# The hand's target moves with the object; if it kept within this in all demonstrations, patches do.
MAX_SPREAD_M = 0.03
RADII_M = (0.035, 0.05, 0.07, 0.10)
# A hand that lets go of something stands above what it puts it on by an unknown height.
RELEASE_DROPS_M = (0.0, 0.05, 0.10)
REFERENCES = 5
# How far from each patch's own place an object is sought.
REACH_M = 0.035
# Probes that explain the hints nearly as well as the best are used together.
KEPT_RATIO, KEPT_SLACK_M = 1.15, 0.0002
MAX_PROBES = 4
MIN_STD_M = 5e-4
MIN_PATCH_PX = 7
# Less alike than this in the demonstrations: the object turns, or is not what the patches show.
LEARNED_CORRELATION = 0.8
# Of the typical correlation.
FOUND_CORRELATION = 0.5
# A place touched less often says nothing of how far its object moves.
MIN_TOUCHES = 3
# Patches have to explain this much of where the hand went, unless it went to about the same place every time.
EXPLAINED_SHARE, STILL_M = 0.6, 0.004
# A patch with less contrast than this, in CIELAB levels, is found everywhere.
MIN_CONTRAST = 4.0
# An object that turns looks more like its turned patch, by this much, in more than this share of the scenes.
TURN_DEG, TURN_GAIN, TURN_SHARE = 10.0, 0.01, 0.25
# A hand camera sees the patch as in the demonstrations only from the same place.
MAX_CAMERA_SHIFT_M, MAX_CAMERA_TURN_RAD = 0.02, 0.10


@dataclass(frozen=True)
class _Sight:
    """One probe's answer for one view: a point ``(3,)`` and the correlation behind it."""

    point_world: Array
    correlation: float


# How badly a probe explains the hints, metres; the points that it found; itself; its median correlation.
_Trial = tuple[float, Array, Probe, float]


def spread(scenes: Sequence[Scene], name: str) -> float:
    """Largest distance of a touched place from the middle of its demonstrations' like ones, metres.

    Infinite where no place was touched often enough to tell.
    """
    hints = [hint for scene in scenes for hint in scene.hints if hint.name == name]
    groups = [group for group in _places(hints) if len(group) >= MIN_TOUCHES]
    reach = [np.ptp(np.stack([hint.point_world for hint in group])[:, :2], axis=0) / 2 for group in groups]
    return float(np.max(reach)) if reach else np.inf


def learn_patches(name: str, scenes: Sequence[Scene]) -> PatchModel | None:
    """Learn an object that hardly moves; None if no patch of any camera is found again.

    Args:
        name: The object.
        scenes: Demonstrations with hints at it.
    """
    hints = [next(hint for hint in scene.hints if hint.name == name) for scene in scenes]
    groups = _places(hints)
    # Every place that was touched is a candidate for the patches' middle: some lie beside the object.
    by_place = [_try_all(place, scenes, hints, groups) for place in groups]
    tried = min(by_place, key=lambda results: min((residual for residual, *_ in results), default=np.inf))
    if not tried:
        return None
    best = min(residual for residual, *_ in tried)
    if best > max(EXPLAINED_SHARE * _residual(np.zeros((len(hints), 2)), hints, groups), STILL_M):
        return None
    kept = sorted(
        (one for one in tried if one[0] <= KEPT_RATIO * best + KEPT_SLACK_M), key=lambda one: one[0]
    )[:MAX_PROBES]
    agreed = np.median(np.stack([points for _, points, _, _ in kept]), axis=0)
    probes = []
    for _, points, probe, _ in kept:
        error = points - agreed
        std = 1.4826 * float(np.median(np.linalg.norm(error - np.median(error, axis=0), axis=1)))
        probes.append(
            Probe(probe.camera, probe.calibration, probe.T_world_cam, probe.patches, max(std, MIN_STD_M))
        )
    height = float(probes[0].patches[0].point_world[2])
    return PatchModel(
        name, tuple(probes), height, float(np.median([correlation for *_, correlation in kept]))
    )


def _try_all(
    place: Sequence[Hint], scenes: Sequence[Scene], hints: Sequence[Hint], groups: Sequence[Sequence[Hint]]
) -> list[_Trial]:
    """Every camera and size of patches around one place."""
    middle = np.median(np.stack([hint.point_world for hint in place]), axis=0)
    drops = RELEASE_DROPS_M if place[0].kind == "release" else (0.0,)
    results = [
        _try(camera, middle - [0, 0, drop], radius, scenes, hints, groups)
        for camera in scenes[0].views
        for drop in drops
        for radius in RADII_M
    ]
    return [one for one in results if one is not None]


def _places(hints: Sequence[Hint]) -> list[list[Hint]]:
    """Hints grouped by the place on the object that they touch."""
    groups: dict[tuple[str, str], list[Hint]] = {}
    for hint in hints:
        groups.setdefault((hint.kind, hint.place), []).append(hint)
    return list(groups.values())


def _try(
    camera: str,
    middle: Array,
    radius: float,
    scenes: Sequence[Scene],
    hints: Sequence[Hint],
    groups: Sequence[Sequence[Hint]],
) -> _Trial | None:
    """Estimate every demonstration's point from others' patches, and compare with where the hand went.

    Returns:
        Distance to the hints (root mean square), the points ``(n, 2)``, the probe, its median correlation.
    """
    views = [scene.views[camera] for scene in scenes]
    chosen = np.unique(np.linspace(0, len(scenes) - 1, REFERENCES).round().astype(int))
    first = _cut(views[chosen[0]], middle, radius)
    if first is None:
        return None
    patches = {int(chosen[0]): first}
    view = views[chosen[0]]
    for index in chosen[1:]:
        # The first reference says where the object is in the others.
        seen = _match(first, view, views[index])
        patch = None if seen is None else _cut(views[index], seen.point_world, radius)
        if patch is not None:
            patches[int(index)] = patch
    points, correlations = np.full((len(scenes), 2), np.nan), np.zeros(len(scenes))
    for i, other in enumerate(views):
        # A demonstration is not asked about itself.
        found = [
            s for k, patch in patches.items() if k != i and (s := _match(patch, view, other)) is not None
        ]
        if found:
            points[i] = np.median([one.point_world[:2] for one in found], axis=0)
            correlations[i] = np.median([one.correlation for one in found])
    if np.isnan(points).any() or np.median(correlations) < LEARNED_CORRELATION:
        return None
    if np.mean([_looks_turned(first, view, other) for other in views]) > TURN_SHARE:
        return None
    residual = _residual(points, hints, groups)
    probe = Probe(camera, view.camera, view.T_world_cam, tuple(patches.values()), 0.0)
    return residual, points, probe, float(np.median(correlations))


def _residual(points: Array, hints: Sequence[Hint], groups: Sequence[Sequence[Hint]]) -> float:
    """Root mean square distance of estimates ``(n, 2)`` from hints, less each place's own offset, metres."""
    offsets = np.stack([hint.point_world[:2] for hint in hints]) - points
    left = []
    for group in groups:
        own = offsets[[i for i, hint in enumerate(hints) if any(hint is one for one in group)]]
        left.append(np.linalg.norm(own - np.median(own, axis=0), axis=1))
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


def _cut(view: View, point_world: Array, radius: float) -> Patch | None:
    """The pixels within ``radius`` metres of a point; None where hardly any are in the image."""
    uv, depth = project(view.camera, view.T_world_cam, point_world)
    if not np.isfinite(uv).all():
        return None
    half = view.camera.focal_px * radius / depth
    low = np.maximum(np.round(uv - half), 0).astype(int)
    high = np.minimum(np.round(uv + half) + 1, [view.camera.width, view.camera.height]).astype(int)
    if (high - low).min() < max(MIN_PATCH_PX, half):
        return None
    image = _lab(view.image[low[1] : high[1], low[0] : high[0]])
    if image.reshape(-1, 3).std(axis=0).max() < MIN_CONTRAST:
        return None
    return Patch(image, low.astype(float), point_world)


def _looks_turned(patch: Patch, seen_with: View, view: View) -> bool:
    """Whether the patch, turned either way, is found more clearly than as it is."""
    height, width = patch.image.shape[:2]
    correlations = []
    for angle in (0.0, -TURN_DEG, TURN_DEG):
        turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle, 1.0)
        image = cv2.warpAffine(patch.image, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
        seen = _match(replace(patch, image=np.asarray(image, np.uint8)), seen_with, view)
        correlations.append(0.0 if seen is None else seen.correlation)
    return max(correlations[1:]) > correlations[0] + TURN_GAIN


def _match(patch: Patch, seen_with: View | Probe, view: View) -> _Sight | None:
    """Find a patch near its old place in another view of the same camera; None at the image's border.

    A hand camera may have been a little elsewhere then: the patch is expected where its point is seen now.
    """
    camera = seen_with.camera if isinstance(seen_with, View) else seen_with.calibration
    uv_then, _ = project(camera, seen_with.T_world_cam, patch.point_world)
    uv, depth = project(camera, view.T_world_cam, patch.point_world)
    if not np.isfinite([*uv_then, *uv]).all():
        return None
    expected = patch.corner + uv - uv_then
    reach = int(np.ceil(camera.focal_px * REACH_M / depth))
    height, width = patch.image.shape[:2]
    x, y = np.round(expected).astype(int)
    low = np.maximum([x - reach, y - reach], 0)
    high = np.clip([x + width + reach, y + height + reach], 0, [camera.width, camera.height])
    window = view.image[low[1] : high[1], low[0] : high[0]]
    if window.shape[0] < height or window.shape[1] < width:
        return None
    scores = np.asarray(cv2.matchTemplate(_lab(window), patch.image, cv2.TM_CCOEFF_NORMED), np.float32)
    _, correlation, _, (u, v) = cv2.minMaxLoc(scores)
    shift = np.add(low, [u + _vertex(scores[v], u), v + _vertex(scores[:, u], v)]) - expected
    # How the projection moves as the point does, on its horizontal plane.
    moved, _ = project(camera, view.T_world_cam, patch.point_world + np.eye(3)[:2] * 1e-3)
    return _Sight(
        patch.point_world + np.append(np.linalg.solve((moved - uv).T / 1e-3, shift), 0.0), float(correlation)
    )


def _vertex(scores: NDArray[np.float32], best: int) -> float:
    """Where between its neighbours the maximum of sampled scores lies, from -0.5 to 0.5."""
    if not 0 < best < len(scores) - 1:
        return 0.0
    before, peak, after = (float(one) for one in scores[best - 1 : best + 2])
    bend = before - 2 * peak + after
    return 0.0 if bend > -1e-9 else 0.5 * (before - after) / bend


def _lab(image: NDArray[np.uint8]) -> Picture:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB), np.uint8)


def localise_patches(views: Mapping[str, View], model: PatchModel) -> PoseEstimate:
    """Find an object known by patches in the views of one moment.

    Args:
        views: Views by camera name. Those of a camera that has moved since the patches were taken do not
            help.
        model: The object.
    """
    information, weighted = np.zeros((2, 2)), np.zeros(2)
    correlations = []
    for probe in model.probes:
        view = _as_seen(views.get(probe.camera), probe)
        found = [] if view is None else [_match(patch, probe, view) for patch in probe.patches]
        sights = [one for one in found if one is not None]
        if not sights:
            continue
        weight = np.eye(2) / probe.std_m**2
        information += weight
        weighted += weight @ np.median([one.point_world[:2] for one in sights], axis=0)
        correlations.append(float(np.median([one.correlation for one in sights])))
    unknown = np.diag([1.0, 1.0, 1.0, UNKNOWN_YAW_STD**2])
    if not correlations:
        return PoseEstimate("not_found", np.eye(4), unknown, 0.0, {})
    confidence = float(np.clip(np.mean(correlations) / max(model.typical_correlation, 1e-3), 0, 1))
    status = (
        "found" if np.mean(correlations) >= FOUND_CORRELATION * model.typical_correlation else "not_found"
    )
    # Height and direction are taken to be the demonstrated ones; they are not measured.
    covariance = np.diag([0.0, 0.0, REACH_M**2, UNKNOWN_YAW_STD**2])
    covariance[:2, :2] = np.linalg.inv(information)
    place = np.linalg.solve(information, weighted)
    return PoseEstimate(status, se3.from_yaw(np.append(place, model.height), 0.0), covariance, confidence, {})


def _as_seen(view: View | None, probe: Probe) -> View | None:
    """A view at the size of the patches; None if there is none or its camera is elsewhere now."""
    if view is None:
        return None
    moved = se3.log_so3(view.T_world_cam[:3, :3] @ probe.T_world_cam[:3, :3].T)
    shifted = np.linalg.norm(view.T_world_cam[:3, 3] - probe.T_world_cam[:3, 3])
    if shifted > MAX_CAMERA_SHIFT_M or np.linalg.norm(moved) > MAX_CAMERA_TURN_RAD:
        return None
    size = (probe.calibration.width, probe.calibration.height)
    if view.image.shape[:2] == size[::-1]:
        return view
    image = np.asarray(cv2.resize(view.image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return View(image, probe.calibration, view.T_world_cam)
