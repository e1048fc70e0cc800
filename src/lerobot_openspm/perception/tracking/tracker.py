"""Following objects through an episode: filtered, smoothed, carried by the hand, noticed when they move.

One tracker belongs to one environment. An object's pose is filtered in the frame that carries it: the world,
or the hand that holds it. What is seen near the prediction updates the filter. What is seen elsewhere is
believed when a second look agrees; then the object has moved, and its filter begins anew.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.tracking import kalman
from lerobot_openspm.perception.tracking.measurement import measurement_covariance
from lerobot_openspm.types import PoseEstimate

# What the hand lost this much higher or lower than it took it from, metres, may lie anywhere so much later.
FALLEN_M, FALLING_S = 0.05, 0.4


class TrackStatus(StrEnum):
    """What is known of an object now."""

    TRACKED = "tracked"
    HELD = "held"  # moves with the hand
    HIDDEN = "hidden"  # something is in the way, most often the hand; it is taken to be where it was
    AMBIGUOUS = "ambiguous"  # two places explain the images, or it was seen elsewhere than expected
    STALE = "stale"  # it should have been seen for a while, and was not
    LOST = "lost"  # ... for so long that it is not believed to be there any more


@dataclass(frozen=True)
class TrackerSettings:
    """When a pose is believed.

    Attributes:
        linear: How much objects move by themselves: spectral density of their acceleration, m / s^1.5.
        angular: ... rad / s^1.5.
        smoothing: The paper's alpha: weight of the filter's position in the output.
        smoothing_rotation: The paper's alpha_q: ... of its orientation.
        sure: Least confidence of an estimate that may update a filter.
        visible: Least share of an object that must be in sight for it to count as seen, or as gone.
        near_m: An estimate this far from the prediction is another place ...
        near_held_m: ... where the hand holds the object.
        agree_m: Two looks that differ less than this see the same place.
        stale_s: After being looked for in vain for so long an object is stale ...
        lost_s: ... and lost.
        hand_m: What is this near the hand may be hidden by it, so it is not missed ...
        carrying_m: ... and this near while the hand carries something, which hides more.
    """

    linear: float = 0.0035
    angular: float = 0.02
    smoothing: float = 0.8
    smoothing_rotation: float = 0.8
    sure: float = 0.90
    visible: float = 0.5
    near_m: float = 0.010
    near_held_m: float = 0.030
    agree_m: float = 0.030
    stale_s: float = 0.5
    lost_s: float = 2.0
    hand_m: float = 0.20
    carrying_m: float = 0.30


@dataclass
class _Track:
    """One object.

    Attributes:
        belief: Its pose in the frame that carries it.
        smoothed: The output ``(4, 4)``, in the same frame.
        held: Whether the hand carries it.
        rival: Where it was seen last, if that was not where it was expected; ``T_world_obj``.
        missed_s: For how long it has been looked for in vain.
        hidden: Whether the last look could not tell.
        rivalled: Whether two places explained the last look's pictures.
        doubted: Whether the next sure sight is believed wherever it is.
        covered: Whether something may hide it since it was last seen: the hand has let go of it there, or has
            opened something.
        fallen: Whether the hand lost it at another height, and it was not seen since; see :data:`FALLEN_M`.
        falling_s: For how long it may still be falling.
        stood_m: Height in the world from which the hand took it; infinity before.
    """

    belief: kalman.Belief
    smoothed: Array
    held: bool = False
    rival: Array | None = None
    missed_s: float = 0.0
    hidden: bool = False
    rivalled: bool = False
    doubted: bool = False
    covered: bool = False
    fallen: bool = False
    falling_s: float = 0.0
    stood_m: float = np.inf


@dataclass
class Tracker:
    """What one environment knows of its objects.

    Attributes:
        yaw_periods: Angle by object that turns it into itself, radians; 0 for a body of revolution.
        settings: When a pose is believed.
        displaced: Objects that were in the hand, or were seen elsewhere than before, at some time.
    """

    yaw_periods: Mapping[str, float]
    settings: TrackerSettings
    displaced: set[str] = field(default_factory=set[str])
    _tracks: dict[str, _Track] = field(default_factory=dict)

    def poses(self, T_world_ee: Array) -> dict[str, Array]:
        """Smoothed poses ``T_world_obj`` ``(4, 4)`` of all objects ever seen, the hand being there."""
        return {name: _in_world(one.smoothed, one, T_world_ee) for name, one in self._tracks.items()}

    def status(self, name: str) -> TrackStatus:
        """What is known of an object; LOST for one that was never seen."""
        track = self._tracks.get(name)
        if track is None or track.missed_s >= self.settings.lost_s:
            return TrackStatus.LOST
        if track.missed_s >= self.settings.stale_s:
            return TrackStatus.STALE
        if track.rival is not None or track.rivalled:
            return TrackStatus.AMBIGUOUS
        if track.held:
            return TrackStatus.HELD
        return TrackStatus.HIDDEN if track.hidden else TrackStatus.TRACKED

    def is_seen(self, name: str) -> bool:
        """Whether the last look recognised an object where it is taken to be."""
        track = self._tracks.get(name)
        return track is not None and not track.hidden and track.rival is None and track.missed_s == 0

    @property
    def doubtful(self) -> bool:
        """Whether some object was last seen where it was not expected, and wants a second look."""
        return any(track.rival is not None or track.rivalled for track in self._tracks.values())

    def predict(self, dt_s: float) -> None:
        """Let time pass."""
        step = kalman.motion(dt_s, self.settings.linear, self.settings.angular)
        for track in self._tracks.values():
            track.belief = kalman.predict(track.belief, step)
            track.falling_s = max(0.0, track.falling_s - dt_s)

    def look(
        self,
        estimates: Mapping[str, PoseEstimate],
        T_world_ee: Array,
        waited_s: float,
        is_felt: bool = False,
    ) -> frozenset[str]:
        """Take in what was seen of the objects that were looked for.

        Args:
            estimates: One per object that was looked for.
            T_world_ee: The hand's pose ``(4, 4)``.
            waited_s: Seconds since the last look.
            is_felt: Whether the fingers feel what they hold; then it is not elsewhere, whatever was seen.

        Returns:
            The objects that turned out to be somewhere else, those seen for the first time among them.
        """
        moved = set()
        for name, estimate in estimates.items():
            track = self._tracks.get(name)
            if track is None:
                if estimate.status == "found" and estimate.visible >= self.settings.visible:
                    self._begin(name, estimate.T_world_obj, estimate)
                    moved.add(name)
            elif self._is_seen(estimate):
                if self._take(name, track, estimate, T_world_ee, waited_s, is_felt):
                    moved.add(name)
            else:
                self._miss(track, estimate, T_world_ee, waited_s)
        return frozenset(moved)

    def hold(self, name: str, T_world_ee: Array) -> None:
        """The hand carries an object from now on."""
        track = self._tracks.get(name)
        if track is not None and not track.held:
            self.displaced.add(name)
            track.stood_m, track.fallen, track.falling_s = float(track.smoothed[2, 3]), False, 0.0
            self._carry(track, se3.inverse(T_world_ee), held=True)

    def release(self, names: Iterable[str], T_world_ee: Array) -> None:
        """The hand lets go of objects, which stay where they are now, be they recognised there or not."""
        for name in names:
            if name in self.held:
                self._carry(self._tracks[name], T_world_ee, held=False)
                self._tracks[name].covered = True

    def drop(self, names: Iterable[str], T_world_ee: Array) -> None:
        """The hand has lost objects: they lie below it, no higher than where it took them from."""
        for name in [name for name in names if name in self.held]:
            track = self._tracks[name]
            self.release([name], T_world_ee)
            lower = track.stood_m - float(track.smoothed[2, 3])
            fallen = np.array([0.0, 0.0, min(0.0, lower)])
            track.fallen = abs(lower) > FALLEN_M
            track.falling_s = FALLING_S * track.fallen
            track.smoothed = se3.transform(track.smoothed[:3, :3], track.smoothed[:3, 3] + fallen)
            track.belief = track.belief._replace(position=track.belief.position + fallen)

    def cover(self) -> None:
        """Something was opened: what stands behind it is hidden from now on, until it is seen again."""
        for track in self._tracks.values():
            track.covered = track.covered or not track.held

    def doubt(self, names: Collection[str], T_world_ee: Array) -> None:
        """Objects need not be where they are taken to be; the next sure sight of them is believed at once."""
        self.drop(names, T_world_ee)
        for name in self._tracks.keys() & set(names):
            self._tracks[name].doubted = True

    def forget(self, names: Iterable[str]) -> None:
        """These names stand for other objects from now on."""
        for name in names:
            self._tracks.pop(name, None)
            self.displaced.add(name)

    @property
    def fallen(self) -> frozenset[str]:
        """Objects lost at another height than they were taken from, not seen since: they may lie anywhere."""
        return frozenset(name for name, track in self._tracks.items() if track.fallen)

    @property
    def falling(self) -> frozenset[str]:
        """Those of them that may not have come to rest yet."""
        return frozenset(name for name, track in self._tracks.items() if track.falling_s > 0)

    @property
    def held(self) -> frozenset[str]:
        """Objects that the hand carries."""
        return frozenset(name for name, track in self._tracks.items() if track.held)

    def _begin(self, name: str, T_world_obj: Array, estimate: PoseEstimate) -> None:
        R = measurement_covariance(estimate)
        self._tracks[name] = _Track(kalman.begin(T_world_obj[None], R[None]), T_world_obj)

    def _is_seen(self, estimate: PoseEstimate) -> bool:
        is_sure = estimate.status == "found" and estimate.confidence >= self.settings.sure
        return is_sure and estimate.visible >= self.settings.visible

    def _take(
        self,
        name: str,
        track: _Track,
        estimate: PoseEstimate,
        T_world_ee: Array,
        waited_s: float,
        is_felt: bool,
    ) -> bool:
        """Update a track with a sure estimate; whether the object turned out to be elsewhere."""
        expected = _in_world(track.belief.T[0], track, T_world_ee)
        period = self.yaw_periods.get(name, 2 * np.pi)
        T_world_obj = nearest_equivalent(estimate.T_world_obj, expected, period)
        R = measurement_covariance(estimate)
        apart = float(np.linalg.norm(T_world_obj[:3, 3] - expected[:3, 3]))
        near_m = self.settings.near_held_m if track.held else self.settings.near_m
        if apart <= near_m:
            T_mount_world = se3.inverse(T_world_ee) if track.held else np.eye(4)
            T, R_mount = T_mount_world @ T_world_obj, _rotated(R, T_mount_world)
            belief, innovation = kalman.update(track.belief, T[None], R_mount[None])
            if innovation.accepted[0]:
                track.belief, track.rival, track.missed_s = belief, None, 0.0
                track.hidden = track.rivalled = track.doubted = track.covered = track.fallen = False
                track.smoothed = self._smoothed(track.smoothed, belief.T[0])
                return False
        if track.held and is_felt:
            track.rival = None
            return False
        rival, track.rival = T_world_obj if track.doubted else track.rival, T_world_obj
        if rival is None or np.linalg.norm(rival[:3, 3] - T_world_obj[:3, 3]) > self.settings.agree_m:
            track.missed_s += waited_s  # seen here and there, and not where it is taken to be
            return False
        self._begin(name, T_world_obj, estimate)
        self.displaced.add(name)
        return True

    def _miss(self, track: _Track, estimate: PoseEstimate, T_world_ee: Array, waited_s: float) -> None:
        """An object that is in sight but not recognised is on its way to being lost; a hidden one is not.

        Nor is one that the hand has put where it looks different, as in a drawer, or has opened a drawer
        before.
        """
        near = self.settings.carrying_m if self.held else self.settings.hand_m
        track.rival, expected = None, _in_world(track.belief.T[0], track, T_world_ee)
        track.hidden = (
            estimate.visible < self.settings.visible
            or estimate.status == "found"
            or (track.covered and not track.doubted)
            or track.fallen
            or float(np.linalg.norm(expected[:3, 3] - T_world_ee[:3, 3])) < near
        )
        track.rivalled = estimate.status == "ambiguous" and not track.hidden
        track.missed_s = 0.0 if track.hidden or track.held else track.missed_s + waited_s
        # What is not seen is taken to stand still: a velocity of noise would carry it off in seconds.
        still = np.zeros((1, 3))
        track.belief = track.belief._replace(velocity=still, angular_velocity=still)

    def _carry(self, track: _Track, T_new_old: Array, held: bool) -> None:
        """Express a track in the frame of what carries it from now on."""
        R = T_new_old[:3, :3]
        turn = np.kron(np.eye(4), R)
        belief = track.belief
        T = T_new_old @ belief.T[0]
        track.belief = kalman.Belief(
            T[None, :3, 3], T[None, :3, :3], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)),
            turn @ belief.covariance @ turn.T,
        )  # fmt: skip
        track.smoothed, track.held, track.rival, track.missed_s = T_new_old @ track.smoothed, held, None, 0.0

    def _smoothed(self, T_before: Array, T_filtered: Array) -> Array:
        """The paper's smoothing of the output: a mean of positions, and slerp of orientations."""
        alpha = self.settings.smoothing
        position = alpha * T_filtered[:3, 3] + (1 - alpha) * T_before[:3, 3]
        pair = Rotation.from_matrix([T_before[:3, :3], T_filtered[:3, :3]])
        turned = Slerp([0.0, 1.0], pair)(self.settings.smoothing_rotation)
        return se3.transform(turned.as_matrix(), position)


def nearest_equivalent(T_world_obj: Array, expected: Array, period: float) -> Array:
    """Of the poses in which an object looks the same, the one turned least from another pose."""
    yaw, want = float(se3.yaw_of(T_world_obj)), float(se3.yaw_of(expected))
    if period == 0:
        return se3.transform(expected[:3, :3], T_world_obj[:3, 3])
    turn = want + se3.wrap_angle(yaw - want, period) - yaw
    return T_world_obj @ se3.from_yaw(np.zeros(3), turn)


def _in_world(T_mount_obj: Array, track: _Track, T_world_ee: Array) -> Array:
    """``T_world_obj`` ``(4, 4)`` of a pose in the frame that carries a track."""
    return T_world_ee @ T_mount_obj if track.held else T_mount_obj


def _rotated(R: Array, T: Array) -> Array:
    """A covariance ``(6, 6)`` in the axes of the frame that ``T`` ``(4, 4)`` leads to."""
    turn = np.kron(np.eye(2), T[:3, :3])
    return turn @ R @ turn.T
