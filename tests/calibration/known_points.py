"""Cameras that follow known points: tracks with noise and outliers, no images."""

import numpy as np
from scipy.interpolate import CubicSpline

from lerobot_openspm.calibration.tracks import Track
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera, project

SIZE, FOCAL = 256, 300.0
# Where a camera stands and what it looks at, in its mount.
PLACES = {"world": ([0.9, 0.1, 0.9], [0, 0, 0.2]), "ee": ([0.06, 0.01, -0.1], [0, 0, 0.2])}
# How far features lie from the middle of the hand, and of the table.
REACH = {"world": (0.05, 0.05, 0.1), "ee": (0.3, 0.3, 0.05)}


def camera(mount: str, mirrored: bool) -> Camera:
    """A camera that stands a metre away, or one on the hand that looks along the fingers."""
    position, at = (np.array(place) for place in PLACES[mount])
    forward = (at - position) / np.linalg.norm(at - position)
    right = np.cross(forward, [0.1, 0.2, 1.0])
    right /= np.linalg.norm(right)
    T = se3.transform(np.stack([right, np.cross(forward, right), forward], axis=1), position)
    fx, middle = -FOCAL if mirrored else FOCAL, (SIZE - 1) / 2
    return Camera(SIZE, SIZE, fx, FOCAL, middle, middle, "world" if mount == "world" else "ee", T)


def hand_paths(rng: np.random.Generator, episodes: int, frames: int, *, turning: bool) -> list[np.ndarray]:
    """Hand poses of episodes: through the workspace, pointing down, turning about two axes if wanted."""
    paths, time = [], np.linspace(0, 1, frames)
    for episode in range(episodes):
        corners = rng.uniform([-0.2, -0.2, 0.1], [0.2, 0.2, 0.4], (5, 3))
        position = CubicSpline(np.linspace(0, 1, 5), corners)(time)
        axis = np.array([[0, 0, 1.0], [0, 1.0, 0]])[episode % 2]
        turn = np.deg2rad(80) * np.clip(5 * time - 2, 0, 1)[:, None] * axis * turning
        paths.append(se3.transform(se3.exp_so3([np.pi, 0, 0]) @ se3.exp_so3(turn), position))
    return paths


def follow(
    rng: np.random.Generator,
    truth: Camera,
    paths: list[np.ndarray],
    points: int,
    outliers: int,
    noise_px: float = 0.2,
) -> list[Track]:
    """Tracks of points fixed to the hand or, for its own camera, to the table; and of others."""
    tracks = []
    for episode, T_world_ee in enumerate(paths):
        T_world_cam = [truth.T_world_cam(T) for T in T_world_ee]
        for point in rng.uniform(-1, 1, (points, 3)) * REACH[truth.mount]:
            begin = int(rng.integers(0, len(T_world_ee) // 2))
            frames = range(begin, int(rng.integers(begin + 10, len(T_world_ee) + 1)))
            at = [
                se3.apply(T_world_ee[t], point[None])[0] if truth.mount == "world" else point for t in frames
            ]
            uv = np.array([project(truth, T_world_cam[t], p)[0] for t, p in zip(frames, at, strict=True)])
            if np.isfinite(uv).all():
                tracks.append(Track(episode, begin, uv + rng.normal(0, noise_px, uv.shape)))
        for start, end in rng.uniform(0, SIZE, (outliers, 2, 2)):
            part = np.linspace(0, 1, len(T_world_ee))[:, None] ** 2
            tracks.append(Track(episode, 0, start + part * (end - start)))
    return tracks


def held_in_the_hand(episode: int, frames: int) -> list[Track]:
    """Two things that stand nearly still in the hand's camera, however the hand moves."""
    drift = np.linspace(0, 11, frames)[:, None] * [1.0, 0.3]
    return [Track(episode, 0, start + drift) for start in ([120.0, 140.0], [135.0, 150.0])]
