"""Which cameras can be believed.

Frames that are missing, black or frozen are no evidence of anything. A camera that shows objects elsewhere
than the other cameras do was moved, or its calibration is wrong.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Mapping, Sequence
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
# Two cameras disagree if even the objects that they agree on best, this share of all, lie further apart than
# this: by one view alone some objects are seen badly, but a camera that is off shifts all of them. Of fewer
# than so many objects only the best one counts.
BEST_SHARE, FEW, DISAGREE_M = 0.35, 5, 0.007
# A camera that is off shifts and turns objects as one: for most of them that leaves at most this share of how
# far they are apart. Errors of single objects are left as they are.
AS_ONE_SHARE = 0.5
# So many objects, seen by both, tell of two cameras: whether they agree, and by any shift and turn that they
# do not. Fewer, but at least so many, tell only that they do not: each must be shifted by this much, metres,
# and alike, by vectors that differ by this share of their length at most.
ENOUGH_COMMON, MIN_COMMON = 3, 2
TWO_SHIFTED_M, ALIKE_SHARE = 0.014, 0.25


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


def disagreements(places: Mapping[str, Mapping[str, Sequence[Array]]]) -> dict[str, str]:
    """The cameras that show objects elsewhere than others do, and by how much, in words.

    Where it cannot be told which of two is off, both are named.

    Args:
        places: By camera and object: where it stands ``(2,)``, metres, as this camera alone shows it; several
            places where several objects look like it.
    """
    pairs: dict[tuple[str, str], tuple[Array, Array]] = {}
    for pair in itertools.combinations(places, 2):
        own, other = _nearest(*(places[camera] for camera in pair))
        if len(own) >= MIN_COMMON:
            pairs[pair] = own, other
    apart = {pair: np.linalg.norm(a - b, axis=1) for pair, (a, b) in pairs.items()}
    differing = {pair for pair, one in apart.items() if _agreed(one) > DISAGREE_M}
    off = {pair: pair in differing and _moved_as_one(*places) for pair, places in pairs.items()}
    agreeing = {
        camera for pair in apart.keys() - differing if len(apart[pair]) >= ENOUGH_COMMON for camera in pair
    }
    suspects = {camera for pair, is_off in off.items() if is_off for camera in pair}
    found: dict[str, str] = {}
    for camera in sorted(suspects - agreeing):
        others = [pair for pair, is_off in off.items() if is_off and camera in pair]
        median_mm = 1000 * float(np.median(np.concatenate([apart[pair] for pair in others])))
        names = sorted({name for pair in others for name in pair} - {camera})
        found[camera] = (
            f"views disagree: it shows objects {median_mm:.0f} mm from where {' and '.join(names)} do; "
            "check where it is mounted, and calibrate it again"
        )
    return found


def _nearest(a: Mapping[str, Sequence[Array]], b: Mapping[str, Sequence[Array]]) -> tuple[Array, Array]:
    """Where two cameras show the objects that both of them show, ``(n, 2)`` each, metres."""
    both = [name for name in a if a[name] and b.get(name)]
    near = [
        min(itertools.product(a[name], b[name]), key=lambda two: float(np.linalg.norm(two[0] - two[1])))
        for name in both
    ]
    one, other = np.array(near).reshape(-1, 2, 2).swapaxes(0, 1)
    return one, other


def _moved_as_one(a: Array, b: Array) -> bool:
    """Whether some shift and turn in the plane lead from most of the places ``(n, 2)`` to the others."""
    if len(a) < ENOUGH_COMMON:
        shifts = np.linalg.norm(b - a, axis=1)
        differ = np.linalg.norm((b - a)[1] - (b - a)[0])
        return bool(shifts.min() > TWO_SHIFTED_M and differ <= ALIKE_SHARE * shifts.min())
    for i, j in itertools.combinations(range(len(a)), 2):
        turn = np.arctan2(*(b[j] - b[i])[::-1]) - np.arctan2(*(a[j] - a[i])[::-1])
        R = se3.from_yaw(np.zeros(3), turn)[:2, :2]
        left = (a - (a[i] + a[j]) / 2) @ R.T + (b[i] + b[j]) / 2 - b
        explained = np.linalg.norm(left, axis=1) <= AS_ONE_SHARE * np.linalg.norm(a - b, axis=1)
        if explained.sum() >= max(ENOUGH_COMMON, len(a) // 2 + 1):
            return True
    return False


def _agreed(distances: Array) -> float:
    """How far apart at most the objects lie, metres, that two cameras agree on best."""
    count = 1 if len(distances) < FEW else int(np.ceil(BEST_SHARE * len(distances)))
    return float(np.sort(distances)[count - 1])
