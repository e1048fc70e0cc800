"""A first estimate of the camera from features whose place on their body is not known.

While the hand does not turn, a feature fixed to it moves as the hand does, from an unknown start: its image
is that of the hand's position shifted by three unknown numbers. These are eliminated from the linear
equations of the projection; what is left, over a few tracks, is the camera's rotation and focal length. The
camera's position is known only up to where the features are, which the turning of the hand tells later
(`refine`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.calibration.adjust import residuals, triangulate
from lerobot_openspm.calibration.observations import Mount, Observations, observe
from lerobot_openspm.calibration.tracks import Track
from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array

MAX_TURN_RAD = np.deg2rad(4)
MIN_FRAMES = 8
# In parts of the image height.
MIN_MOTION, INLIER = 8 / 256, 2 / 256
HYPOTHESES, TRACKS_PER_HYPOTHESIS, SCORED_TRACKS = 300, 4, 400
MIN_TRACKS = 12
FOV_RANGE_RAD = np.deg2rad([10, 130])
# Features of a hand lie near it; things in a room do not lie further from the robot's base than this.
REACH_M: dict[Mount, float] = {"world": 0.5, "ee": 5.0}
NEAREST_M = 0.02


def moving(tracks: Sequence[Track], height: int) -> list[Track]:
    """The tracks that go some way in the image: what stands still there tells nothing of the camera."""
    return [t for t in tracks if np.ptp(t.uv, axis=0).max() > MIN_MOTION * height]


def without_turns(tracks: Sequence[Track], T_world_ee: Sequence[Array]) -> list[Track]:
    """Pieces of tracks in which the hand keeps its orientation."""
    pieces = []
    for track in tracks:
        R = T_world_ee[track.episode][track.start : track.start + len(track.uv), :3, :3]
        begin = 0
        while len(R) - begin >= MIN_FRAMES:
            turned = np.linalg.norm(se3.log_so3(R[begin:] @ R[begin].T), axis=1) > MAX_TURN_RAD
            end = begin + int(turned.argmax()) if turned.any() else len(R)
            if end - begin >= MIN_FRAMES:
                pieces.append(Track(track.episode, track.start + begin, track.uv[begin:end]))
            begin = end
    return pieces


def possible(points: Array, p_cam: Array, observations: Observations, mount: Mount) -> NDArray[Any]:
    """Which features ``(n_tracks,)`` lie in front of the camera and within reach."""
    behind = observations.per_track((p_cam[:, 2] < NEAREST_M).astype(float)) > 0
    return ~behind & (np.linalg.norm(points, axis=1) < REACH_M[mount])


def first_estimate(
    tracks: Sequence[Track],
    T_world_ee: Sequence[Array],
    camera: Camera,
    *,
    free_focal: bool,
    mirrored: bool | None,
    rng: np.random.Generator,
) -> Camera:
    """Find the camera that the most tracks agree with (RANSAC).

    Args:
        tracks: Features that were followed.
        T_world_ee: Hand poses ``(n, 4, 4)`` of each episode.
        camera: Image size, mount, and the focal length unless it is free; its pose does not matter.
        free_focal: Whether the focal length is found too.
        mirrored: Whether images are mirrored left to right; found if None.
        rng: Draws the tracks to try.

    Raises:
        CalibrationError: Too few features move with the hand, or no camera explains any.
    """
    pieces = moving(without_turns(tracks, T_world_ee), camera.height)
    if len(pieces) < MIN_TRACKS:
        raise CalibrationError(
            f"only {len(pieces)} features were seen to move by {MIN_MOTION:.0%} of the image's height, "
            f"expected at least {MIN_TRACKS}; give more episodes with --episodes=[...], or check --mount (a "
            "camera on the hand needs --mount=ee)"
        )
    seen = [observe([piece], T_world_ee, camera.mount) for piece in pieces]
    chance = np.array([np.sqrt(np.ptp(p.uv, axis=0).max() * len(p.uv)) for p in pieces])
    some = rng.choice(len(pieces), min(SCORED_TRACKS, len(pieces)), replace=False)
    scored = observe([pieces[i] for i in some], T_world_ee, camera.mount)
    best, best_score = None, 0.0
    for _ in range(HYPOTHESES):
        drawn = rng.choice(len(pieces), TRACKS_PER_HYPOTHESIS, replace=False, p=chance / chance.sum())
        candidate = _solve([seen[i] for i in drawn], camera, free_focal, mirrored)
        if candidate is not None and (score := _score(candidate, scored)) > best_score:
            best, best_score = candidate, score
    if best is None:
        raise CalibrationError(
            "no camera explains how features move with the hand; check --mount, --fov_deg and that "
            "observation.state is the pose of the hand that the camera sees (or that carries it)"
        )
    return best


def _score(camera: Camera, scored: Observations) -> float:
    points = triangulate(camera, scored, np.arange(scored.n_tracks))
    r, p_cam = residuals(camera, points[scored.track], scored.T_mount_body, scored.uv)
    quality = np.maximum(0, 1 - (scored.rms(r) / (INLIER * camera.height)) ** 2)
    return float(quality[possible(points, p_cam, scored, camera.mount)].sum())


def _solve(
    pieces: Sequence[Observations], camera: Camera, free_focal: bool, mirrored: bool | None
) -> Camera | None:
    """The camera of a few tracks; None where they do not determine one."""
    centre, unit = np.array([camera.cx, camera.cy]), camera.fy
    systems = [_without_offset(p.T_mount_body[:, :3, 3], (p.uv - centre) / unit) for p in pieces]
    _, vectors = np.linalg.eigh(sum(left.T @ left for left, _ in systems))
    # M = s diag(f / unit, f / unit, 1) R_cam_mount, up to a sign that depths decide.
    m = vectors[:, 0]
    offsets = np.array([offset @ m for _, offset in systems])
    M = m.reshape(3, 3)
    depths = [M[2] @ p.T_mount_body[0, :3, 3] + o[2] for p, o in zip(pieces, offsets, strict=True)]
    if np.mean(depths) < 0:
        M, offsets = -M, -offsets
    lengths = np.linalg.norm(M, axis=1)
    focal = float(unit * np.sqrt(lengths[0] * lengths[1]) / lengths[2]) if free_focal else unit
    found_mirrored = bool(np.linalg.det(M) < 0)
    fov = 2 * np.arctan(camera.height / 2 / focal)
    if (mirrored is not None and mirrored != found_mirrored) or not FOV_RANGE_RAD[0] < fov < FOV_RANGE_RAD[1]:
        return None
    undo = np.array([-unit / focal if found_mirrored else unit / focal, unit / focal, 1.0])
    U, stretch, Vt = np.linalg.svd(undo[:, None] * M)
    if stretch[2] < stretch[0] / 3:
        return None
    R_cam_mount, offset = U @ Vt, np.median(undo * offsets, axis=0) / stretch.mean()
    T_mount_cam = se3.transform(R_cam_mount.T, -R_cam_mount.T @ offset)
    return replace(camera, fx=-focal if found_mirrored else focal, fy=focal, T_mount_cam=T_mount_cam)


def _without_offset(positions: Array, xy: Array) -> tuple[Array, Array]:
    """One track's equations for M's nine numbers, its own three eliminated, and these three from the nine."""
    A, B = np.zeros((len(xy), 2, 9)), np.zeros((len(xy), 2, 3))
    for axis in range(2):
        A[:, axis, 3 * axis : 3 * axis + 3] = positions
        A[:, axis, 6:] = -xy[:, axis, None] * positions
        B[:, axis, axis] = 1
        B[:, axis, 2] = -xy[:, axis]
    A, B = A.reshape(-1, 9), B.reshape(-1, 3)
    offset = -np.asarray(np.linalg.lstsq(B, A, rcond=None)[0], float)
    return A + B @ offset, offset
