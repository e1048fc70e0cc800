"""Tracks of many episodes as flat arrays, the same for cameras in the world and on the hand.

A camera is fixed to its *mount*, and the features it follows are fixed to a *body*: the hand for a camera in
the world, things that lie still for a camera on the hand. Either way a feature at ``x`` in the body is at
``T_mount_body @ x`` in the mount, with a ``T_mount_body`` that the robot's state gives for every frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.calibration.tracks import Track
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

# Places in a long track err alike: more of them than this, evenly spaced, tell nothing new.
MAX_PER_TRACK = 20

Mount = Literal["world", "ee"]


@dataclass(frozen=True)
class Observations:
    """Where features were seen, `m` places of `n_tracks` tracks.

    Attributes:
        n_tracks: How many tracks there are.
        track: Track of each place ``(m,)``.
        T_mount_body: Pose ``(m, 4, 4)`` at that time of what the feature is fixed to.
        uv: Pixel coordinates ``(m, 2)``.
        episode: Episode of each track ``(n_tracks,)``.
    """

    n_tracks: int
    track: NDArray[Any]
    T_mount_body: Array
    uv: Array
    episode: NDArray[Any]

    def select(self, chosen: NDArray[Any]) -> Observations:
        """Only the tracks that a mask ``(n_tracks,)`` names, renumbered."""
        keep = chosen[self.track]
        number = np.cumsum(chosen) - 1
        return Observations(
            int(chosen.sum()), number[self.track[keep]], self.T_mount_body[keep], self.uv[keep],
            self.episode[chosen],
        )  # fmt: skip

    def per_track(self, values: Array) -> Array:
        """Sums over tracks of values ``(m, ...)``."""
        return sums(self.track, values, self.n_tracks)

    def rms(self, residuals: Array) -> Array:
        """Root mean square length ``(n_tracks,)`` of residuals ``(m, 2)``."""
        return np.sqrt(self.per_track((residuals**2).sum(axis=1)) / self.per_track(np.ones(len(self.track))))


def sums(index: NDArray[Any], values: NDArray[Any], count: int) -> Array:
    """Add up values ``(m, ...)`` that share an index ``(m,)``."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    added = np.stack([np.bincount(index, column, count) for column in flat.T], axis=-1).astype(float)
    return added.reshape(count, *values.shape[1:])


def observe(tracks: Sequence[Track], T_world_ee: Sequence[Array], mount: Mount) -> Observations:
    """Flatten tracks.

    Args:
        tracks: Features that were followed.
        T_world_ee: Hand poses ``(n, 4, 4)`` of each episode.
        mount: What carries the camera.
    """
    frames = [np.unique(np.linspace(0, len(t.uv) - 1, MAX_PER_TRACK).round().astype(int)) for t in tracks]
    T_mount_body = [T if mount == "world" else se3.inverse(T) for T in T_world_ee]
    none = np.zeros((0, 4, 4))
    return Observations(
        n_tracks=len(tracks),
        track=np.repeat(np.arange(len(tracks)), [len(f) for f in frames]).astype(int),
        T_mount_body=np.concatenate(
            [none, *(T_mount_body[t.episode][t.start + f] for t, f in zip(tracks, frames, strict=True))]
        ),
        uv=np.concatenate([np.zeros((0, 2)), *(t.uv[f] for t, f in zip(tracks, frames, strict=True))]),
        episode=np.array([t.episode for t in tracks], int),
    )
