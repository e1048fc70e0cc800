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
# The fingers have come to rest when they are slower than this fraction of their fastest.
SWEEP_FRACTION = 0.25
MIN_SETTLING_STEPS = 3
# Fingers that open have parted when they have gone this fraction of the way.
PARTING_FRACTION = 0.02
# A hand slower than this fraction of its usual speed stands still.
STILL_FRACTION = 0.12
# Fingers take no longer than this to settle.
MAX_SETTLING_STEPS = 30
# A hand that leaves a contact gets this much further away with every step.
LEAVING_M = 0.0008
# An episode in which the hand never moves faster than this, per step, holds no motion at all.
MOTIONLESS_M = 1e-5
# Closed fingers that hold something and rise by this much carry it; otherwise they pull or turn it.
LIFTED_M = 0.03
TURNED_RAD = np.deg2rad(35)
# A push begins and ends within this height of its lowest point. In between the hand may ride up further, on
# what it pushes or as it turns, but does not lift off.
PUSH_BAND_M = 0.015
# A corner of the way of a push must stand out by this much.
PUSH_TOLERANCE_M = 0.02
# A hand that trembles stays within this height.
STANDING_M = 0.003
# A hand that sinks or rises by less than this in two steps travels level.
LEVEL_M = 0.001
# However sharp a corner is, it is less sure than a gripper transition: a judge may name it otherwise.
MAX_CORNER_CONFIDENCE = 0.9
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
    """A key pose before it is measured: where, what, and how sure.

    `command` is the frame of the gripper command that the fingers answer to on the way here, or None.
    """

    frame: int
    phase: str
    confidence: float
    closed: bool
    command: int | None
    contact: int


def find_key_poses(episode: Episode, robot: RobotModel) -> list[KeyPose]:
    """Find the key poses of an episode, in order. An empty list means that nothing was touched or pushed."""
    speed = _speed(episode) if len(episode) > 1 else np.zeros(len(episode))
    if speed.max(initial=0.0) < MOTIONLESS_M:
        return []
    closed = _without_false_starts(_debounced(robot.closed(episode.actions[:, 6])), episode.T_world_ee)
    moving = speed > STILL_FRACTION * np.median(speed[speed > 0.1 * speed.max()])
    transitions = [*(np.flatnonzero(np.diff(closed)) + 1).tolist(), len(episode) - 1]
    events = [(f, _settled(episode, f, until)) for f, until in pairwise(transitions)]
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
        if event_end is None:
            return _carry_marks(episode, start, end, end, contact)
        let_go = end + _parting(episode.opening[end : event_end + 1])
        release = _Mark(event_end, "release", 1.0, False, end, contact)
        return [*_carry_marks(episode, start, end, let_go, contact), release]
    if closed or (event_end is None and contact == 0):
        return _push_marks(episode, start, end, closed, contact)
    if event_end is None:  # the hand leaves after the last release
        turns = _corner_marks(episode, start, end, "retreat", False, contact, contacts=[start])
        return [*turns, _Mark(end, "retreat", 0.8, False, None, contact)]
    contacts = [start, end] if contact > 0 else [end]
    turns = _corner_marks(episode, start, end, "approach", False, contact, contacts)
    if turns and contact > 0:
        turns[0] = _Mark(turns[0].frame, "retreat", turns[0].confidence, False, None, contact)
    if next_end is not None and _fist(episode, event_end, next_end):
        return turns
    arrival = _Mark(end, "approach", 1.0, False, None, contact)
    return [*turns, arrival, _Mark(event_end, "grasp", 1.0, True, end, contact)]


def _carry_marks(episode: Episode, start: int, end: int, let_go: int, contact: int) -> list[_Mark]:
    """Lift, pre-place and place of a carried object, or the end of a pull or of a turn; that at `let_go`."""
    poses = episode.T_world_ee[start : end + 1]
    if poses[:, 2, 3].max() - poses[0, 2, 3] < LIFTED_M:
        metres, radians = se3.distances(poses[0], poses[-1])
        phase = "turn" if radians > TURNED_RAD and metres < 0.06 else "open"
        return [_Mark(let_go, phase, 1.0, True, None, contact)]
    turns = _corner_marks(episode, start, end, "pre-place", True, contact, [start, end])
    if turns:
        turns[0] = _Mark(turns[0].frame, "lift", turns[0].confidence, True, None, contact)
    return [*turns, _Mark(let_go, "place", 1.0, True, None, contact)]


def _push_marks(episode: Episode, start: int, end: int, closed: bool, contact: int) -> list[_Mark]:
    """Approach, push and retreat of a hand that holds nothing but travels low; a push may turn on its way."""
    height = episode.T_world_ee[start : end + 1, 2, 3]
    # The lowest stretch: a hand that dips twice and lifts off in between has pushed nothing on the way.
    lowest = int(np.argmin(height))
    high = np.flatnonzero(height >= height[lowest] + LIFTED_M)
    between = slice(high[high < lowest].max(initial=-1) + 1, high[high > lowest].min(initial=len(height)))
    low = between.start + np.flatnonzero(height[between] < height[lowest] + PUSH_BAND_M)
    first, level = start + _bottom(height, int(low[0]), 1), start + _bottom(height, int(low[-1]), -1)
    metres, _ = se3.distances(episode.T_world_ee[first], episode.T_world_ee[level])
    if metres < 0.04:  # a hand that only passes a low point pushes nothing
        return []
    way = episode.T_world_ee[first : start + between.stop, :3, 3]
    last = first + _push_end(way, start + int(low[-1]) - first)
    approach = _corner_marks(episode, start, first, "approach", closed, contact, [first])
    turns = _push_turn_marks(episode, first, last, closed, contact)
    retreat = _corner_marks(episode, last, end, "retreat", closed, contact, [last])
    return [
        *approach,
        _Mark(first, "approach", 1.0, closed, None, contact),
        *turns,
        _Mark(last, "push", 1.0, closed, None, contact),
        *retreat,
        _Mark(end, "retreat", 0.8, closed, None, contact),
    ]


def _bottom(height: Array, index: int, step: int) -> int:
    """Walk from an index, forwards or backwards, to where the hand stops going down."""
    ahead = index + 2 * step
    while 0 <= ahead < len(height) and height[ahead] < height[index] - LEVEL_M:
        index, ahead = index + step, ahead + step
    return index


def _push_end(positions: Array, low: int) -> int:
    """Index at which a hand begins to leave what it pushes.

    Args:
        positions: The hand's way ``(n, 3)`` from the first touch until it has lifted off.
        low: The last index at which it is in the band of a push: it may stay on at the edge of it.
    """
    height, on = positions[:, 2], np.linalg.norm(positions[:, :2] - positions[low, :2], axis=-1)
    index = int(np.flatnonzero(height - on <= height[low] + STANDING_M)[-1])
    pushed = np.linalg.norm(positions[:, :2] - positions[0, :2], axis=-1)
    # Back to where it began to rise by more than it pushed on, in one step or in two.
    while index >= 2 and any(
        height[index] - height[i] > max(LEVEL_M, pushed[index] - pushed[i]) for i in (index - 1, index - 2)
    ):
        index -= 1
    return index


def _corner_marks(
    episode: Episode, start: int, end: int, phase: str, closed: bool, contact: int, contacts: list[int]
) -> list[_Mark]:
    """Corners of the path between two frames, judged more finely the nearer they are to a contact."""
    points = path_coordinates(episode.T_world_ee[start : end + 1])
    touch = episode.T_world_ee[contacts][:, :3, 3]
    away = np.linalg.norm(points[:, None, :3] - touch[None], axis=-1).min(axis=1)
    tolerance = np.maximum(CONTACT_TOLERANCE_M, FREE_SPACE_TOLERANCE * away)
    return [
        _Mark(start + corner, phase, _corner_confidence(points, corner), closed, None, contact)
        for corner in _spaced_corners(points, tolerance)
    ]


def _push_turn_marks(episode: Episode, start: int, end: int, closed: bool, contact: int) -> list[_Mark]:
    """Where a push turns. A hand that rides up and down on the way goes straight on."""
    points = path_coordinates(episode.T_world_ee[start : end + 1])
    points[:, 2] = 0.0
    return [
        _Mark(start + corner, "push", _corner_confidence(points, corner), closed, None, contact)
        for corner in _spaced_corners(points, np.full(len(points), PUSH_TOLERANCE_M))
    ]


def _spaced_corners(points: Array, tolerance: Array) -> list[int]:
    """Corners of a path that lie apart from its ends and from one another."""
    found: list[int] = []
    for corner in corners(points, tolerance).tolist():
        ends = [0, len(points) - 1, *found[-1:]]
        if np.linalg.norm(points[corner] - points[ends], axis=-1).min() >= MIN_SPACING_M:
            found.append(corner)
    return found


def _corner_confidence(points: Array, corner: int, reach: int = 4) -> float:
    """How sharply the path turns or slows at a corner, from 0.5 for a straight fast pass."""
    before = points[corner] - points[max(corner - reach, 0)]
    after = points[min(corner + reach, len(points) - 1)] - points[corner]
    norms = np.linalg.norm(before) * np.linalg.norm(after)
    turning = 0.5 * (1 - float(before @ after) / norms) if norms > 1e-9 else 1.0
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    usual = float(np.median(steps))
    slowing = 1 - float(steps[max(corner - 1, 0) : corner + 1].mean()) / usual if usual > 1e-9 else 0.0
    return float(np.clip(0.5 + max(turning, 0.5 * slowing), 0.5, MAX_CORNER_CONFIDENCE))


def _measure(episode: Episode, marks: list[_Mark], moving: NDArray[np.bool_]) -> list[KeyPose]:
    key_poses: list[KeyPose] = []
    before = -1
    for mark in sorted(marks, key=lambda mark: mark.frame):
        if mark.frame <= before:
            continue  # the episode ended with the mark before
        frames = slice(max(before, 0), mark.frame)
        if mark.command is None:
            n_steps = int(moving[frames].sum())
        else:  # an operator may dawdle for longer than any fingers take
            n_steps = min(mark.frame - mark.command, MAX_SETTLING_STEPS)
        key_poses.append(
            KeyPose(
                int(mark.frame), episode.T_world_ee[mark.frame], mark.phase, mark.confidence, mark.closed,
                float(episode.opening[mark.frame]), int(max(n_steps, 1)),
                mark.command is not None, mark.contact,
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


def _without_false_starts(closed: NDArray[np.bool_], T_world_ee: Array) -> NDArray[np.bool_]:
    """Drop closings after which the hand stayed where it was until it opened again: it took nothing."""
    closed = closed.copy()
    bounds = [0, *(np.flatnonzero(np.diff(closed)) + 1).tolist(), len(closed)]
    for first, last in list(pairwise(bounds))[1:-1]:
        stayed = se3.distance(T_world_ee[first], T_world_ee[first : last + 1]).max() < MIN_SPACING_M
        if closed[first] and stayed:
            closed[first:last] = False
    return closed


def _settled(episode: Episode, start: int, until: int) -> int:
    """Frame at which the fingers rest after a transition, or the hand leaves, whichever is later.

    A hand that trembles or drifts while its operator waits has not left.
    """
    rest = _fingers_rest(episode.opening[start : min(start + MAX_SETTLING_STEPS, until) + 1])
    away = se3.distance(episode.T_world_ee[start + rest], episode.T_world_ee[start + rest : until + 1])
    left = np.flatnonzero(away > MIN_SPACING_M)
    if not len(left):
        return until
    leaving = int(left[0])
    while leaving > 0 and away[leaving] > away[leaving - 1] + LEAVING_M:
        leaving -= 1
    return start + rest + leaving


def _parting(opening: Array) -> int:
    """Index of the last frame before fingers that were told to open part: a tight grip eases first."""
    sweep = opening - opening[0]
    return max(int(np.argmax(sweep >= PARTING_FRACTION * sweep.max())) - 1, 0) if sweep.max() > 0 else 0


def _fingers_rest(opening: Array) -> int:
    """Index at which a sweep of the fingers ends; afterwards they may still rattle around what they hold."""
    speed = np.abs(np.diff(opening))
    fastest = int(np.argmax(speed, axis=0)) if len(speed) else 0
    slow = np.flatnonzero(speed[fastest:] <= SWEEP_FRACTION * speed[fastest]) if len(speed) else []
    return max(fastest + int(slow[0]), min(MIN_SETTLING_STEPS, len(speed))) if len(slow) else len(speed)


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
