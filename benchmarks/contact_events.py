"""The physical events that key poses at contacts stand for, read from a simulator's contacts and poses alone.

A key pose ends a phase (:class:`~lerobot_openspm.mining.key_poses.KeyPose`). Its true frame is therefore the
last one before the next phase physically begins:

======= ======================================================================================================
phase   true event
======= ======================================================================================================
grasp   The last frame in which a thing that the fingers have closed around still stands where they took it.
        Closing around nothing, or around what is then not moved, is no grasp.
place   The last frame in which both fingers squeeze a free thing that they moved. Whether it stands by then
        or falls the last millimetres is left open: people let go above a support as well as on it, and what a
        policy needs to know is where to open its fingers.
open    The same for a thing on a slide: its handle is let go of.
turn    The same for a thing on a hinge.
release The last frame before the hand leaves, after the fingers have opened.
push    The last frame before the hand leaves, after it last moved something along without holding it. What
        then tips back, rises or falls, or is only touched again, is not pushed any more.
======= ======================================================================================================

A phase that is going on when the demonstration ends, ends there. The other phases (approach, lift, pre-place,
retreat) end at corners in free space, where nothing is touched and no true event is: they are not judged.
That includes the approach before a push, which ends before the object is met, and the corners on the way of
a push, which goes on there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.contact_sensor import ThingKind, ThingTrack
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

# Contacts flicker: what is lost for this long, a quarter of a second, and found again was not lost.
GAP_STEPS = 5
# What was moved by less than this while the hand had it was not manipulated (a radian counts as 0.1 m), and a
# hand that stays this near to what it touched, trembling or recoiling, has not gone away from it.
MOVED_M = 0.03
# What leaves gets further away by this much in every step (1 cm/s); slower than that it stands.
LEAVING_M = 0.0005
# A thing that moves by this much in a step (2 cm/s), and the hand with it, is being pushed, though contact
# may be lost at the moment that is looked at.
PUSHED_M = 0.001
# Fingers have opened when they have gone this share of how far they open within this time.
OPENED_SHARE, OPENING_STEPS = 0.8, 40
ENDS: dict[ThingKind, str] = {"free": "place", "slide": "open", "hinge": "turn"}
PHASES = ("grasp", "place", "open", "turn", "release", "push")


@dataclass(frozen=True)
class ContactEvent:
    """The true end of a phase: which phase, at which frame, and when what makes it up was complete.

    Attributes:
        phase: One of `PHASES`.
        frame: The last frame before the next phase begins.
        since: The frame from which on the hand stood there with all done: the fingers hold the thing, or have
            let go of it. Between the two the operator dawdles.
    """

    phase: str
    frame: int
    since: int


def contact_events(tracks: Sequence[ThingTrack], T_world_ee: Array, opening: Array) -> list[ContactEvent]:
    """All true events of an episode of `n` frames, by frame.

    Args:
        tracks: What the hand touched.
        T_world_ee: Where the hand truly was, ``(n, 4, 4)``.
        opening: True distance of the fingers, ``(n,)`` in metres.
    """
    events: list[ContactEvent] = []
    for track in tracks:
        holds = list(_holds(track))
        for first, last in holds:
            events += _of_hold(track, first, last, T_world_ee, opening)
        events += _pushes(track, holds, T_world_ee)
    return sorted(events, key=lambda event: event.frame)


def _holds(track: ThingTrack) -> Iterator[tuple[int, int]]:
    """First and last frame of every time that the fingers had the thing and moved it.

    What moves freely is held by two fingers that press on it at once. A handle or a knob is held by its
    joint, and has play between fingers that tremble: it is theirs from when one presses on it until none
    does.
    """
    fingers = track.squeezed.sum(axis=1)
    for first, last in runs(fingers >= (2 if track.kind == "free" else 1), GAP_STEPS):
        if _farthest(track.T_world_thing[first : last + 1]) > MOVED_M:
            yield first, last


def _of_hold(
    track: ThingTrack, first: int, last: int, T_world_ee: Array, opening: Array
) -> list[ContactEvent]:
    """Grasp, end and release of one hold."""
    held = slice(first, last + 1)
    grasp = ContactEvent(
        "grasp", first + stands([track.T_world_thing[held], T_world_ee[held]], MOVED_M), first
    )
    end = ContactEvent(ENDS[track.kind], last, last)
    if last == len(opening) - 1:
        return [grasp, end]
    sweep = opening[last : last + OPENING_STEPS] - opening[last]
    opened = last + int(np.argmax(sweep >= OPENED_SHARE * sweep.max()))
    return [grasp, end, ContactEvent("release", opened + stands([T_world_ee[opened:]], MOVED_M), last + 1)]


def _pushes(track: ThingTrack, holds: Sequence[tuple[int, int]], T_world_ee: Array) -> Iterator[ContactEvent]:
    """Ends of pushes: contact that moved the thing and was no hold."""
    from_thing = T_world_ee[:, :3, 3] - track.T_world_thing[:, :3, 3]
    stretches: list[tuple[int, int]] = []
    along = _along(track, T_world_ee)
    for first, last in runs(np.logical_or(track.touched, along), GAP_STEPS):
        if not track.touched[first : last + 1].any() or any(first <= b and last >= a for a, b in holds):
            continue
        if stretches and not _went_away(from_thing[stretches[-1][1] : first + 1]):
            stretches[-1] = (stretches[-1][0], last)
        else:
            stretches.append((first, last))
    for first, last in stretches:
        # What was pushed slides on for a moment.
        poses = track.T_world_thing[max(first - 1, 0) : last + GAP_STEPS + 1]
        pushed = first + np.flatnonzero(along[first : last + 1] & ~_hangs(track, T_world_ee, first, last))
        # What a hand brushes in passing may swing out and back.
        if len(pushed) and se3.distance(poses[0], poses[-1]) > MOVED_M:
            end = int(pushed[-1])
            yield ContactEvent("push", end + stands([T_world_ee[end:]], MOVED_M), end)


def _along(track: ThingTrack, T_world_ee: Array) -> NDArray[np.bool_]:
    """Whether the thing moved in the step to each frame, where the hand is, and the hand along with it."""
    moves = track.T_world_thing[1:] @ se3.inverse(track.T_world_thing[:-1])
    hand = T_world_ee[:, :3, 3]
    thing_step = se3.apply(moves, hand[:-1, None])[:, 0] - hand[:-1]
    length = np.linalg.norm(thing_step, axis=-1)
    along = (length > PUSHED_M) & (np.linalg.norm(np.diff(hand, axis=0) - thing_step, axis=-1) < length)
    if track.kind == "free":  # it is pushed over what it lies on; otherwise it tips, rises or falls
        along &= np.linalg.norm(thing_step[:, :2], axis=-1) > np.abs(thing_step[:, 2])
    return np.append(False, along)


def _went_away(from_thing: Array) -> bool:
    """Whether a hand, at ``(n, 3)`` from a thing's middle, left it: what it slides over it stays with."""
    away, height = np.linalg.norm(from_thing, axis=-1), from_thing[:, 2]
    return bool(max(away.max() - away[0], height.max() - height[0]) > MOVED_M)


def _hangs(track: ThingTrack, T_world_ee: Array, first: int, last: int) -> NDArray[np.bool_]:
    """Whether a free thing has been lifted by the hand, at each frame of a stretch, or earlier in it.

    What tips up against a hand that stays low is still pushed.
    """
    heights = np.stack([T[first : last + 1, 2, 3] for T in (track.T_world_thing, T_world_ee)])
    lifted = (heights > heights[:, :1] + MOVED_M).all(axis=0)
    return np.logical_or.accumulate(lifted & (track.kind == "free"))


def runs(flags: NDArray[np.bool_], gap: int) -> list[tuple[int, int]]:
    """First and last index of every stretch of true flags; gaps of up to `gap` false ones are bridged."""
    found: list[tuple[int, int]] = []
    for index in np.flatnonzero(flags).tolist():
        if found and index - found[-1][1] <= gap + 1:
            found[-1] = (found[-1][0], index)
        else:
            found.append((index, index))
    return found


def stands(paths: Sequence[Array], away: float) -> int:
    """Index of the last poses at which what stood at the first ones had not begun to leave together.

    A thing that shifts between closing fingers has not left, nor has a hand that trembles around it.

    Args:
        paths: Poses ``(n, 4, 4)`` of each.
        away: What is further than this from where it stood has left, in metres.
    """
    distance = np.min([se3.distance(T[:1], T) for T in paths], axis=0)
    left = np.flatnonzero(distance > away)
    if not len(left):
        return len(distance) - 1
    lingers = np.flatnonzero(np.diff(distance[: left[0] + 1]) < LEAVING_M)
    return int(lingers[-1]) + 1 if len(lingers) else 0


def _farthest(T: Array) -> float:
    return float(np.max(se3.distance(T[:1], T)))
