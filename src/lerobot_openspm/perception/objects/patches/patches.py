"""Objects that hardly move between demonstrations: found again by matching small patches of the images.

Where an object stays within a few centimetres and keeps its direction, the pixels around it look alike in all
first frames, whatever its colours and its surroundings. A patch around the place that the hand touched is
sought near there in a new image, and its displacement in pixels is one in the world, on the object's plane.
Which patches to use is learned (:mod:`lerobot_openspm.perception.objects.patches.learn`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.model import Patch, PatchModel, Picture, Probe
from lerobot_openspm.types import UNKNOWN_YAW_STD, Mask, PoseEstimate, Support, View

# How far from each patch's own place an object is sought.
REACH_M = 0.035
MIN_PATCH_PX = 7
# A patch with less contrast than this, in CIELAB levels, is found everywhere.
MIN_CONTRAST = 4.0
# A patch is looked for at the height it was learned at; an object this much above or below is another matter.
MAX_LIFT_M = 0.005
# Probes whose places differ by this much are 1/e consistent.
CONSISTENT_M = 0.005
# Of the typical correlation.
FOUND_CORRELATION = 0.5
# A hand camera sees the patch as in the demonstrations only from the same place.
MAX_CAMERA_SHIFT_M, MAX_CAMERA_TURN_RAD = 0.02, 0.10
# A patch of which more is hidden is not looked for.
MAX_HIDDEN_SHARE = 0.2


@dataclass(frozen=True)
class Sight:
    """One patch's answer for one view: a point ``(3,)`` and the correlation behind it."""

    point_world: Array
    correlation: float


def cut(view: View, point_world: Array, radius: float) -> Patch | None:
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


def match(patch: Patch, probe: Probe, view: View) -> Sight | None:
    """Find a patch near its old place in another view of the same camera; None at the image's border.

    A hand camera may have been a little elsewhere then: the patch is expected where its point is seen now.

    Args:
        patch: What to find.
        probe: Tells the camera that the patch was seen with, and its pose.
        view: Of the same camera, at the same size (:func:`as_seen`).
    """
    camera = probe.calibration
    uv_then, _ = project(camera, probe.T_world_cam, patch.point_world)
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
    return Sight(
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


def localise_patches(
    views: Mapping[str, View],
    model: PatchModel,
    hidden: Mapping[str, Mask] | None = None,
    T_expected: Array | None = None,
) -> PoseEstimate:
    """Find an object known by patches in the views of one moment.

    Args:
        views: Views by camera name. Those of a camera that has moved since the patches were taken do not
            help.
        model: The object.
        hidden: Pixels ``(H, W)`` by camera name that something may be in front of; patches there do not help.
        T_expected: Pose ``(4, 4)`` at which the object is expected. Out of the patches' reach nothing can be
            said of it.
    """
    information, weighted = np.zeros((2, 2)), np.zeros(2)
    correlations, places, area_px = [], [], 0.0
    for probe in model.probes:
        view = as_seen(views.get(probe.camera), probe)
        covered = (hidden or {}).get(probe.camera)
        if view is None or (covered is not None and _is_covered(probe, covered)):
            continue
        found = [match(patch, probe, view) for patch in probe.patches]
        sights = [one for one in found if one is not None]
        if not sights:
            continue
        weight = np.eye(2) / probe.std_m**2
        information += weight
        places.append(np.median([one.point_world[:2] for one in sights], axis=0))
        weighted += weight @ places[-1]
        area_px += float(np.mean([patch.image[..., 0].size for patch in probe.patches]))
        correlations.append(float(np.median([one.correlation for one in sights])))
    unknown = np.diag([1.0, 1.0, 1.0, UNKNOWN_YAW_STD**2])
    if not correlations:
        return PoseEstimate("not_found", np.eye(4), unknown, 0.0, {}, visible=0.0)
    confidence = float(np.clip(np.mean(correlations) / max(model.typical_correlation, 1e-3), 0, 1))
    status = (
        "found" if np.mean(correlations) >= FOUND_CORRELATION * model.typical_correlation else "not_found"
    )
    # Height and direction are taken to be the demonstrated ones; they are not measured.
    covariance = np.diag([0.0, 0.0, REACH_M**2, UNKNOWN_YAW_STD**2])
    # The probes look at the same pixels and err together: many are no surer than one.
    covariance[:2, :2] = len(correlations) * np.linalg.inv(information)
    place = np.linalg.solve(information, weighted)
    T_world_obj = se3.from_yaw(np.append(place, model.height), 0.0)
    visible = float(_can_tell(model, status == "found", T_expected))
    apart = np.linalg.norm(np.stack(places) - place, axis=1).max()
    quality = float(np.clip(model.typical_correlation, 0, 1))
    support = Support("patches", area_px, float(np.exp(-apart / CONSISTENT_M)), quality)
    return PoseEstimate(status, T_world_obj, covariance, confidence, {}, visible, support)


def _can_tell(model: PatchModel, found: bool, T_expected: Array | None) -> bool:
    """Whether patches say anything of an object that is expected somewhere.

    A lifted object looks like one that has moved sideways, and what is expected out of the patches' reach is
    not missed there.
    """
    if T_expected is None:
        return True
    if abs(T_expected[2, 3] - model.height) > MAX_LIFT_M:
        return False
    places = np.stack([patch.point_world[:2] for probe in model.probes for patch in probe.patches])
    return found or bool(np.linalg.norm(places - T_expected[:2, 3], axis=1).min() <= REACH_M)


def _is_covered(probe: Probe, hidden: Mask) -> bool:
    """Whether much of where a probe's patches lie may be hidden."""
    height, width = hidden.shape
    scale = np.array([width / probe.calibration.width, height / probe.calibration.height])
    shares = []
    for patch in probe.patches:
        size = np.array([patch.image.shape[1], patch.image.shape[0]])
        low, high = (
            np.floor(patch.corner * scale).astype(int),
            np.ceil((patch.corner + size) * scale).astype(int),
        )
        shares.append(hidden[low[1] : high[1], low[0] : high[0]].mean())
    return float(np.median(shares)) > MAX_HIDDEN_SHARE


def as_seen(view: View | None, probe: Probe) -> View | None:
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
