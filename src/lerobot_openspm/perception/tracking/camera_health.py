"""Which cameras can be believed: frames that are missing, black or frozen are no evidence of anything."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import Fault, View

# A picture with less contrast than this, in levels of 255, shows nothing.
MIN_CONTRAST = 2.0
# A hand that has moved this far must have changed some pixel of a picture it is in.
MOVED_M = 0.02
# ... and one that moved less than this need not have.
STILL_M = 0.001


@dataclass
class _Frame:
    """The last sound picture of one camera: its checksum, where the hand was, and until when it was news."""

    checksum: int
    T_world_ee: Array
    time_s: float


@dataclass
class CameraWatch:
    """Watches the cameras of one environment."""

    _frames: dict[str, _Frame] = field(default_factory=dict)

    def check(
        self, views: Mapping[str, View], absent: Mapping[str, str], T_world_ee: Array, time_s: float
    ) -> dict[str, Fault]:
        """The cameras whose present frame is no evidence.

        Args:
            views: The frames that came, by camera.
            absent: What is wrong with those that did not.
            T_world_ee: The hand's pose ``(4, 4)``.
            time_s: Seconds since the episode began.
        """
        reasons = dict(absent)
        for camera, view in views.items():
            if reason := self._wrong(camera, view, T_world_ee, time_s):
                reasons[camera] = reason
        return {camera: Fault(reason, time_s - self._sound_s(camera)) for camera, reason in reasons.items()}

    def _sound_s(self, camera: str) -> float:
        """When a camera's last sound picture was taken; the start of the episode if there was none."""
        return self._frames[camera].time_s if camera in self._frames else 0.0

    def _wrong(self, camera: str, view: View, T_world_ee: Array, time_s: float) -> str | None:
        if float(view.image[::4, ::4].std()) < MIN_CONTRAST:
            return "is black or blank"
        checksum = zlib.crc32(np.ascontiguousarray(view.image))
        before = self._frames.get(camera)
        if before is None or before.checksum != checksum:
            self._frames[camera] = _Frame(checksum, T_world_ee, time_s)
            return None
        moved = float(se3.distance(before.T_world_ee, T_world_ee))
        if moved < STILL_M:  # nothing has happened that could be seen
            before.time_s = time_s
        if moved > MOVED_M and all(_shows(view, T) for T in (before.T_world_ee, T_world_ee)):
            return "is frozen: the hand moved, and no pixel changed"
        return None


def _shows(view: View, T_world_ee: Array) -> bool:
    """Whether the hand is in the picture; what a hand camera shows moves with every step of it."""
    if view.camera.mount == "ee":
        return True
    uv, depth = project(view.camera, view.T_world_cam, T_world_ee[:3, 3])
    size = np.array([view.camera.width, view.camera.height])
    return bool(depth > 0 and (uv > 0).all() and (uv < size - 1).all())
