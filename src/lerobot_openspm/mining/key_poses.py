"""Key poses of one episode: from gripper transitions and from changes of velocity and orientation.

The gripper's transitions cut an episode into spans of motion. Within a span the hand's path is simplified,
finely near the contacts and coarsely far from them, so that human pauses, detours and noise leave no trace
and the corners that matter (above the object, after lifting it, above the target) remain.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.path import corners, path_coordinates
from lerobot_openspm.mining.signals import Episode

# A corner at a contact must stand out by this much, in metres ...
CONTACT_TOLERANCE_M = 0.010
# ... and by this fraction of the distance from the nearest contact, where that is more.
FREE_SPACE_TOLERANCE = 0.35
# A gripper command must last this long to count: shorter flickers are noise.
MIN_COMMAND_STEPS = 4
# The fingers have settled when the opening changes by less than this fraction of its range in a step.
SETTLED_FRACTION = 0.01
# A hand slower than this fraction of its usual speed stands still.
STILL_FRACTION = 0.12
MAX_DWELL_STEPS = 30
# An episode in which the hand never moves faster than this, per step, holds no motion at all.
MOTIONLESS_M = 1e-5
# Closed fingers that hold something and rise by this much carry it; otherwise they pull or turn it.
LIFTED_M = 0.03
TURNED_RAD = np.deg2rad(35)
# A hand that pushes stays within this height of its lowest point.
PUSH_BAND_M = 0.015
# A hand that sinks by less than this in two steps travels level.
LEVEL_M = 0.001
# Corners this close to a contact pose are the contact pose.
MIN_SPACING_M = 0.02


@dataclass(frozen=True)
class KeyPose:
    """A phase boundary in one episode.

    Attributes:
        frame: Frame within the episode at which the pose is reached.
        T_world_ee: Hand pose ``(4, 4)``.
        phase: The phase that ends here.
        confidence: The paper's ``gamma``.
        closed: Whether the gripper is commanded closed on the way here.
        opening: Gripper opening here.
        n_steps: Steps from the key pose before, pauses left out.
        dwell: Whether the way here is a wait for the fingers.
        contact: Ordinal of the gripper transition this pose belongs to; counts up over the episode.
    """

    frame: int
    T_world_ee: Array
    phase: str
    confidence: float
    closed: bool
    opening: float
    n_steps: int
    dwell: bool
    contact: int


@dataclass(frozen=True)
class _Mark:
    """A key pose before it is measured: where, what, and how sure."""

    frame: int
    phase: str
    confidence: float
    closed: bool
    dwell: bool
    contact: int


def find_key_poses(episode: Episode, robot: RobotModel) -> list[KeyPose]:
    """Find the key poses of an episode, in order. An empty list means that nothing was touched or pushed."""
    speed = _speed(episode) if len(episode) > 1 else np.zeros(len(episode))
    if speed.max(initial=0.0) < MOTIONLESS_M:
        return []
    closed = _debounced(robot.closed(episode.actions[:, 6]))
    moving = speed > STILL_FRACTION * np.median(speed[speed > 0.1 * speed.max()])
    events = [(f, _settled(episode, robot, f, moving)) for f in np.flatnonzero(np.diff(closed)) + 1]
    starts = [0] + [end for _, end in events]
    ends = [start for start, _ in events] + [len(episode) - 1]

    marks: list[_Mark] = []
    for contact, (start, end) in enumerate(zip(starts, ends, strict=True)):
        event_end = events[contact][1] if contact < len(events) else None
        after = ends[contact + 1] if contact < len(events) else None
        marks += _span_marks(episode, start, end, event_end, after, bool(closed[start]), contact)
    if all(mark.phase in ("approach", "retreat") for mark in marks):
        return []
    return _measure(episode, marks, moving)


def _span_marks(
    episode: Episode,
    start: int,
    end: int,
    event_end: int | None,
    next_end: int | None,
    closed: bool,
    contact: int,
) -> list[_Mark]:
    """The key poses of one span of motion between two gripper transitions, and of the transition after it.

    Args:
        episode: The demonstration.
        start: First frame of the span.
        end: Last frame, at which the transition after it begins.
        event_end: Frame at which that transition has settled; None if the episode ends before.
        next_end: Last frame of the span after it, or None.
        closed: Whether the gripper is closed during the span.
        contact: Ordinal of the span.
    """
    if closed and not _fist(episode, start, end):
        release = [] if event_end is None else [_Mark(event_end, "release", 1.0, False, True, contact)]
        return _carry_marks(episode, start, end, contact) + release
    if closed or (event_end is None and contact == 0):
        return _push_marks(episode, start, end, closed, contact)
    if event_end is None:  # the hand leaves after the last release
        turns = _corner_marks(episode, start, end, "retreat", False, contact, contacts=[start])
        return [*turns, _Mark(end, "retreat", 0.8, False, False, contact)]
    contacts = [start, end] if contact > 0 else [end]
    turns = _corner_marks(episode, start, end, "approach", False, contact, contacts)
    if turns and contact > 0:
        turns[0] = _Mark(turns[0].frame, "retreat", turns[0].confidence, False, False, contact)
    if next_end is not None and _fist(episode, event_end, next_end):
        return turns
    arrival = _Mark(end, "approach", 1.0, False, False, contact)
    return [*turns, arrival, _Mark(event_end, "grasp", 1.0, True, True, contact)]


def _carry_marks(episode: Episode, start: int, end: int, contact: int) -> list[_Mark]:
    """Lift, pre-place and place of a carried object; or the end of a pull or of a turn."""
    poses = episode.T_world_ee[start : end + 1]
    if poses[:, 2, 3].max() - poses[0, 2, 3] < LIFTED_M:
        metres, radians = se3.distances(poses[0], poses[-1])
        phase = "turn" if radians > TURNED_RAD and metres < 0.06 else "open"
        return [_Mark(end, phase, 1.0, True, False, contact)]
    turns = _corner_marks(episode, start, end, "pre-place", True, contact, [start, end])
    if turns:
        turns[0] = _Mark(turns[0].frame, "lift", turns[0].confidence, True, False, contact)
    return [*turns, _Mark(end, "place", 1.0, True, False, contact)]


def _push_marks(episode: Episode, start: int, end: int, closed: bool, contact: int) -> list[_Mark]:
    """Approach, push and retreat of a hand that holds nothing but travels low."""
    height = episode.T_world_ee[start : end + 1, 2, 3]
    # The lowest stretch: a hand that dips twice and rises in between has pushed nothing on the way.
    lowest = int(np.argmin(height))
    high = np.flatnonzero(height >= height[lowest] + PUSH_BAND_M)
    low = np.arange(high[high < lowest].max(initial=-1) + 1, high[high > lowest].min(initial=len(height)))
    first, last = start + _bottom(height, int(low[0]), 1), start + _bottom(height, int(low[-1]), -1)
    metres, _ = se3.distances(episode.T_world_ee[first], episode.T_world_ee[last])
    if metres < 0.04:  # a hand that only passes a low point pushes nothing
        return []
    approach = _corner_marks(episode, start, first, "approach", closed, contact, [first])
    retreat = _corner_marks(episode, last, end, "retreat", closed, contact, [last])
    return [
        *approach,
        _Mark(first, "approach", 1.0, closed, False, contact),
        _Mark(last, "push", 1.0, closed, False, contact),
        *retreat,
        _Mark(end, "retreat", 0.8, closed, False, contact),
    ]


def _bottom(height: Array, index: int, step: int) -> int:
    """Walk from an index, forwards or backwards, to where the hand stops going down."""
    ahead = index + 2 * step
    while 0 <= ahead < len(height) and height[ahead] < height[index] - LEVEL_M:
        index, ahead = index + step, ahead + step
    return index


def _corner_marks(
    episode: Episode, start: int, end: int, phase: str, closed: bool, contact: int, contacts: list[int]
) -> list[_Mark]:
    """Corners of the path between two frames, judged more finely the nearer they are to a contact."""
    points = path_coordinates(episode.T_world_ee[start : end + 1])
    touch = episode.T_world_ee[contacts][:, :3, 3]
    away = np.linalg.norm(points[:, None, :3] - touch[None], axis=-1).min(axis=1)
    tolerance = np.maximum(CONTACT_TOLERANCE_M, FREE_SPACE_TOLERANCE * away)
    found = []
    for corner in corners(points, tolerance):
        spacing = np.linalg.norm(points[corner] - points[[0, -1]], axis=-1).min()
        if spacing < MIN_SPACING_M:
            continue
        if found and np.linalg.norm(points[corner] - points[found[-1].frame - start]) < MIN_SPACING_M:
            continue
        confidence = _corner_confidence(points, int(corner))
        found.append(_Mark(start + int(corner), phase, confidence, closed, False, contact))
    return found


def _corner_confidence(points: Array, corner: int, reach: int = 4) -> float:
    """How sharply the path turns or slows at a corner: 0.5 for a straight fast pass, 1 for a full stop."""
    before = points[corner] - points[max(corner - reach, 0)]
    after = points[min(corner + reach, len(points) - 1)] - points[corner]
    norms = np.linalg.norm(before) * np.linalg.norm(after)
    turning = 0.5 * (1 - float(before @ after) / norms) if norms > 1e-9 else 1.0
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    usual = float(np.median(steps))
    slowing = 1 - float(steps[max(corner - 1, 0) : corner + 1].mean()) / usual if usual > 1e-9 else 0.0
    return float(np.clip(0.5 + max(turning, 0.5 * slowing), 0.5, 1.0))


def _measure(episode: Episode, marks: list[_Mark], moving: NDArray[np.bool_]) -> list[KeyPose]:
    key_poses: list[KeyPose] = []
    before = -1
    for mark in sorted(marks, key=lambda mark: mark.frame):
        if mark.frame <= before:
            continue  # the episode ended with the mark before
        frames = slice(max(before, 0), mark.frame)
        n_steps = mark.frame - before if mark.dwell else int(moving[frames].sum())
        key_poses.append(
            KeyPose(
                int(mark.frame), episode.T_world_ee[mark.frame], mark.phase, mark.confidence, mark.closed,
                float(episode.opening[mark.frame]), int(max(n_steps, 1)), mark.dwell, mark.contact,
            )
        )  # fmt: skip
        before = mark.frame
    return key_poses


def _debounced(closed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Drop runs of a gripper command that are too short to be meant."""
    closed = closed.copy()
    edges = np.flatnonzero(np.diff(closed)) + 1
    bounds = [0, *edges.tolist(), len(closed)]
    for first, last in pairwise(bounds):
        if first > 0 and last - first < MIN_COMMAND_STEPS:
            closed[first:last] = closed[first - 1]
    return closed


def _settled(episode: Episode, robot: RobotModel, start: int, moving: NDArray[np.bool_]) -> int:
    """Frame at which the fingers rest after a transition, or the hand moves on, whichever is later."""
    last = min(start + MAX_DWELL_STEPS, len(episode) - 1)
    change = np.abs(np.diff(episode.opening[start : last + 1]))
    still = change < SETTLED_FRACTION * robot.open_width
    rest = next((t for t in range(3, len(still) - 1) if still[t] and still[t + 1]), len(still))
    leave = next((t for t in range(rest, last - start) if moving[start + t]), last - start)
    return min(start + max(rest, leave), last)


def _fist(episode: Episode, start: int, end: int) -> bool:
    """Whether fingers that closed before a span hold nothing, by where they go.

    What is held was taken where it stood: the hand first rises with it, or stays level to pull or turn it. A
    hand that first goes down was closed in the air, to push.
    """
    height = episode.T_world_ee[start : end + 1, 2, 3] - episode.T_world_ee[start, 2, 3]
    away = np.flatnonzero(np.abs(height) > LIFTED_M)
    return bool(len(away) and height[away[0]] < 0)


def _speed(episode: Episode) -> Array:
    """Hand speed ``(n,)`` in metres per step, rotation included, averaged over three steps."""
    step = se3.distance(episode.T_world_ee[:-1], episode.T_world_ee[1:])
    return np.convolve(np.append(step, step[-1:]), np.ones(3) / 3, mode="same").astype(np.float64)
