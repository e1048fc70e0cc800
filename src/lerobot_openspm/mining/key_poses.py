"""Key poses of one episode: from gripper transitions and from changes of velocity and orientation.

The gripper's transitions cut an episode into spans of motion. Within a span the hand's path is simplified,
finely near the contacts and coarsely far from them. Human pauses, detours and noise then leave no trace, and
the corners that matter (above the object, after lifting it, above the target) remain.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.corners import corner_confidence, path_coordinates, spaced_corners
from lerobot_openspm.mining.gripper import (
    LIFTED_M,
    MAX_SETTLING_STEPS,
    closed_frames,
    is_empty_closure,
    parting,
    settled,
)
from lerobot_openspm.mining.signals import Episode

# A corner at a contact must stand out by this much, in metres ...
CONTACT_TOLERANCE_M = 0.010
# ... and by this fraction of the distance from the nearest contact, where that is more.
FREE_SPACE_TOLERANCE = 0.35
# A hand slower than this fraction of its usual speed stands still.
STILL_FRACTION = 0.12
# An episode in which the hand never moves faster than this, per step, holds no motion.
MOTIONLESS_M = 1e-5
# Closed fingers that turn by this much, without rising, turn a knob; otherwise they pull.
TURNED_RAD = np.deg2rad(35)
# A push begins and ends within this height of its lowest point. In between the hand may rise further, on what
# it pushes or as it turns, but does not lift off.
PUSH_BAND_M = 0.015
# A corner of the way of a push must stand out by this much.
PUSH_TOLERANCE_M = 0.02
# A hand that trembles stays within this height.
STANDING_M = 0.003
# A hand that sinks or rises by less than this in two steps travels level.
LEVEL_M = 0.001


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
    """A key pose before it is measured.

    `command` is the frame of the gripper command that the fingers answer to on the way here, or None.
    """

    frame: int
    phase: str
    confidence: float
    closed: bool
    contact: int
    command: int | None = None


@dataclass(frozen=True)
class _Span:
    """Motion between two gripper transitions.

    Attributes:
        start: First frame.
        end: Last frame, at which the transition after it begins.
        settled: Frame at which that transition has settled; None if the episode ends before.
        closed: Whether the gripper is closed.
        is_empty: Whether it is closed and holds nothing.
        contact: Ordinal of the span.
    """

    start: int
    end: int
    settled: int | None
    closed: bool
    is_empty: bool
    contact: int


def find_key_poses(episode: Episode, robot: RobotModel) -> list[KeyPose]:
    """Find the key poses of an episode, in order. An empty list means that nothing was touched or pushed."""
    speed = _speed(episode) if len(episode) > 1 else np.zeros(len(episode))
    if speed.max(initial=0.0) < MOTIONLESS_M:
        return []
    moving = speed > STILL_FRACTION * np.median(speed[speed > 0.1 * speed.max()])
    spans = _spans(episode, closed_frames(episode, robot))
    marks: list[_Mark] = []
    for span, after in zip(spans, [*spans[1:], None], strict=True):
        marks += _span_marks(episode, span, grasps=not (after and after.is_empty))
    if all(mark.phase in ("approach", "retreat") for mark in marks):
        return []
    return _measure(episode, marks, moving)


def _speed(episode: Episode) -> Array:
    """Hand speed ``(n,)`` in metres per step, rotation included, averaged over three steps."""
    step = se3.distance(episode.T_world_ee[:-1], episode.T_world_ee[1:])
    return np.convolve(np.append(step, step[-1:]), np.ones(3) / 3, mode="same").astype(np.float64)


def _spans(episode: Episode, closed: NDArray[np.bool_]) -> list[_Span]:
    last = len(episode) - 1
    transitions = [*(np.flatnonzero(np.diff(closed)) + 1).tolist(), last]
    rests = [settled(episode, frame, until) for frame, until in pairwise(transitions)]
    spans: list[_Span] = []
    for start, end, rest in zip([0, *rests], transitions, [*rests, None], strict=True):
        is_empty = bool(closed[start]) and is_empty_closure(episode, start, end)
        spans.append(_Span(start, end, rest, bool(closed[start]), is_empty, contact=len(spans)))
    return spans


def _span_marks(episode: Episode, span: _Span, grasps: bool) -> list[_Mark]:
    """The key poses of a span, and of the transition after it, at which an open gripper grasps or not."""
    end, rest, contact = span.end, span.settled, span.contact
    if span.closed and not span.is_empty:
        if rest is None:
            return _carry_marks(episode, span, end)
        let_go = end + parting(episode.opening[end : rest + 1])
        return [*_carry_marks(episode, span, let_go), _Mark(rest, "release", 1.0, False, contact, end)]
    if span.closed or (rest is None and contact == 0):
        return _push_marks(episode, span)
    if rest is None:  # the hand leaves after the last release
        turns = _corner_marks(episode, span.start, end, "retreat", span, [span.start])
        return [*turns, _Mark(end, "retreat", 0.8, False, contact)]
    contacts = [span.start, end] if contact > 0 else [end]
    turns = _corner_marks(episode, span.start, end, "approach", span, contacts)
    if turns and contact > 0:
        turns[0] = _Mark(turns[0].frame, "retreat", turns[0].confidence, False, contact)
    if not grasps:
        return turns
    arrival = _Mark(end, "approach", 1.0, False, contact)
    return [*turns, arrival, _Mark(rest, "grasp", 1.0, True, contact, end)]


def _carry_marks(episode: Episode, span: _Span, let_go: int) -> list[_Mark]:
    """Lift, pre-place and place of a carried object, or the end of a pull or of a turn; that at `let_go`."""
    poses = episode.T_world_ee[span.start : span.end + 1]
    if poses[:, 2, 3].max() - poses[0, 2, 3] < LIFTED_M:
        metres, radians = se3.distances(poses[0], poses[-1])
        phase = "turn" if radians > TURNED_RAD and metres < 0.06 else "open"
        return [_Mark(let_go, phase, 1.0, True, span.contact)]
    turns = _corner_marks(episode, span.start, span.end, "pre-place", span, [span.start, span.end])
    if turns:
        turns[0] = _Mark(turns[0].frame, "lift", turns[0].confidence, True, span.contact)
    return [*turns, _Mark(let_go, "place", 1.0, True, span.contact)]


def _push_marks(episode: Episode, span: _Span) -> list[_Mark]:
    """Approach, push and retreat of a hand that holds nothing but travels low; a push may turn on its way."""
    start, end = span.start, span.end
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
    return [
        *_corner_marks(episode, start, first, "approach", span, [first]),
        _Mark(first, "approach", 1.0, span.closed, span.contact),
        *_push_turn_marks(episode, first, last, span),
        _Mark(last, "push", 1.0, span.closed, span.contact),
        *_corner_marks(episode, last, end, "retreat", span, [last]),
        _Mark(end, "retreat", 0.8, span.closed, span.contact),
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
    episode: Episode, start: int, end: int, phase: str, span: _Span, contacts: list[int]
) -> list[_Mark]:
    """Corners of the path between two frames; the tolerance grows with the distance from the contacts."""
    points = path_coordinates(episode.T_world_ee[start : end + 1])
    touch = episode.T_world_ee[contacts][:, :3, 3]
    away = np.linalg.norm(points[:, None, :3] - touch[None], axis=-1).min(axis=1)
    tolerance = np.maximum(CONTACT_TOLERANCE_M, FREE_SPACE_TOLERANCE * away)
    return _marks_at(points, tolerance, start, phase, span)


def _push_turn_marks(episode: Episode, start: int, end: int, span: _Span) -> list[_Mark]:
    """Where a push turns. Riding up and down on the way is no turn."""
    points = path_coordinates(episode.T_world_ee[start : end + 1])
    points[:, 2] = 0.0
    return _marks_at(points, np.full(len(points), PUSH_TOLERANCE_M), start, "push", span)


def _marks_at(points: Array, tolerance: Array, start: int, phase: str, span: _Span) -> list[_Mark]:
    return [
        _Mark(start + corner, phase, corner_confidence(points, corner), span.closed, span.contact)
        for corner in spaced_corners(points, tolerance)
    ]


def _measure(episode: Episode, marks: list[_Mark], moving: NDArray[np.bool_]) -> list[KeyPose]:
    key_poses: list[KeyPose] = []
    before = -1
    for mark in sorted(marks, key=lambda mark: mark.frame):
        if mark.frame <= before:
            continue  # the episode ended with the mark before
        if mark.command is None:
            n_steps = int(moving[max(before, 0) : mark.frame].sum())
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
