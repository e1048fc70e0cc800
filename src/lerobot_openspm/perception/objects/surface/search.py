"""Where a surface explains the pictures best: candidates all over the table, refined in all views at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.compare import (
    ENOUGH_SHOWN,
    FINE_POINTS,
    Sample,
    agreement,
    palette_likeness,
    rotations,
    samples_at,
    shown_at,
    spaced,
    take_sample,
)
from lerobot_openspm.perception.objects.surface.sight import Sight, Surface
from lerobot_openspm.types import UNKNOWN_YAW_STD

CORE_POINTS, QUICK_POINTS = 12, 100
# Points this near to the middle, as a share of the radius, are on the object however it is turned.
CORE_SHARE = 0.7
# What has the object's colours this far around, as a share of the radius, speaks this much against a place.
AROUND_SHARE, AROUND_COST = 1.8, 0.5
# Of all places these, where most looks like the object, are compared in every direction.
KEPT_PLACES, MIN_PLACES, MAX_PLACES = 0.3, 600, 2000
# Places that are refined for the demonstrated direction and for each other one, how many of them are refined
# finely, and how many for each direction where several of a kind are sought.
STARTS_PER_YAW, BEST_PER_YAW, FINALISTS, MANY = 6, 2, 3, 12
# All demonstrations show an object turned alike. Turned otherwise by more than this many radians, its
# agreement counts this share; that of a large object this one, since what is seen of it is only a part.
TURNED_RAD, TURNED_SHARE, LARGE_TURNED_SHARE = 0.4, 0.95, 0.88
NUDGE_M = 0.006
# Of a large object a camera sees other sides in each area of this width, metres.
SEEN_ALIKE_M = 0.25
# Heights at which something may stand on other things are so far apart, metres.
RISE_STEP_M = 0.025
# Two candidates nearer than this are one, metres.
SAME_PLACE_M = 0.035
# Two places nearer than this share of the radius cannot both hold one.
OVERLAP_SHARE = 0.8
# Steps of the refinement: metres and radians.
QUICK_STEPS = ((0.008, 0.10), (0.004, 0.05))
FINE_STEPS = ((0.002, 0.025), (0.001, 0.0125))
MOVES_PER_STEP = 5
# How much agreement varies without any meaning, and how far from a pose it is probed how steeply it falls.
AGREEMENT_NOISE, PROBE_M, PROBE_RAD = 0.02, 0.008, 0.1
SMALLEST_STD_M, LARGEST_STD_M, HEIGHT_STD_M, SMALLEST_STD_RAD = 0.001, 0.05, 0.002, 0.01


@dataclass(frozen=True)
class Place:
    """A pose (x, y, z, yaw) ``(4,)`` and how well all views agree with it; 1 is perfect."""

    pose: Array
    score: float

    @property
    def T_world_obj(self) -> Array:
        """The pose as a transform ``(4, 4)``."""
        return se3.from_yaw(self.pose[:3], float(self.pose[3]))


@dataclass(frozen=True)
class Freedom:
    """What of a pose may change in a refinement, beside the horizontal place.

    Attributes:
        turns: Whether its direction may change.
        lifts: Whether its height may, where two views tell it.
    """

    turns: bool
    lifts: bool = False


def search(
    surface: Surface,
    sights: Mapping[str, Sight],
    ground: Array,
    yaws: Sequence[float],
    freedom: Freedom,
    several: bool = False,
) -> list[Place]:
    """The most likely places, best first.

    Args:
        surface: What is sought.
        sights: The views.
        ground: Where it may be ``(q, 3)``: x and y of its middle, z of its frame, world, metres.
        yaws: Directions to begin from, radians.
        freedom: What may change in the refinement.
        several: Whether places beside the best one are sought as well, for others of its kind.
    """
    apart = max(SAME_PLACE_M, 0.3 * surface.radius)
    likely = _likely(surface, sights, ground)
    # Few points tell directions and places badly, so that the best places for each direction are looked at
    # more closely; most of them for the demonstrated one.
    usual = MANY if surface.is_large else STARTS_PER_YAW
    starts = []
    for yaw in yaws:
        count = MANY if several else BEST_PER_YAW if _is_turned(yaw) else usual
        starts.append(
            _distinct(_turned(surface, sights, likely, yaw, apart, max(count, usual)), apart, count)
        )
    places = [
        refine(surface, sights, start[:4], freedom, QUICK_POINTS, QUICK_STEPS)
        for start in np.concatenate(starts)
    ]
    places = _ranked(surface, places)
    # Most of the best places are one; what differs from it in place or direction may be meant.
    finalists = list[Place]()
    for place in places:
        elsewhere = all(middles_apart(surface, place, one) > apart for one in finalists)
        turned = all(_apart(place.pose, one.pose, apart) for one in finalists)
        if (elsewhere and several) or (turned and len(finalists) < FINALISTS):
            finalists.append(place)
    finest = [refine(surface, sights, place.pose, freedom, FINE_POINTS, FINE_STEPS) for place in finalists]
    return _ranked(surface, finest)


def likelihood(surface: Surface, place: Place) -> float:
    """Its agreement, which counts less where the object is turned otherwise than it was shown."""
    turned = LARGE_TURNED_SHARE if surface.is_large else TURNED_SHARE
    return place.score * (turned if _is_turned(float(place.pose[3])) else 1.0)


def middles_apart(surface: Surface, place: Place, other: Place) -> float:
    """How far apart a surface's middle is at two places, metres; its frame may lie far from that."""
    return float(np.linalg.norm(surface.middle_at(place.pose) - surface.middle_at(other.pose)))


def are_apart(surface: Surface, place: Place, other: Place) -> bool:
    """Whether two places can hold one each."""
    return middles_apart(surface, place, other) > max(SAME_PLACE_M, OVERLAP_SHARE * surface.radius)


def distinct(surface: Surface, places: Sequence[Place]) -> list[Place]:
    """Those places that are apart from all better ones; the best come first."""
    chosen = list[Place]()
    for place in places:
        if all(are_apart(surface, place, one) for one in chosen):
            chosen.append(place)
    return chosen


def _ranked(surface: Surface, places: Sequence[Place]) -> list[Place]:
    """Places, the most likely first."""
    return sorted(places, key=lambda place: -likelihood(surface, place))


def _is_turned(yaw: float) -> bool:
    """Whether a direction, radians, is another than the demonstrated one."""
    return abs((yaw + np.pi) % (2 * np.pi) - np.pi) > TURNED_RAD


def _distinct(scored: Array, metres: float, count: int) -> Array:
    """The best of poses and agreement ``(q, 5)`` that are apart by so much, at most so many of them."""
    chosen: list[Array] = []
    for row in scored[np.argsort(-scored[:, 4])]:
        if all(_apart(row, other, metres) for other in chosen):
            chosen.append(row)
        if len(chosen) >= count:
            break
    return np.array(chosen)


def over_table(surface: Surface, area: Array, height: float) -> Array:
    """Places ``(q, 3)`` at a height all over an area, least and largest x and y ``(2, 2)``, for a search."""
    axes = [*(np.arange(low, high, _step(surface)) for low, high in area.T), np.array([height])]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def over_supports(surface: Surface, points: Array, table_height: float, frame_height: float) -> Array:
    """Places ``(q, 3)`` on top of other things or in them, to be searched.

    Args:
        surface: What is sought.
        points: Of the other things' surfaces ``(n, 3)``, world, metres.
        table_height: World z of the table, metres.
        frame_height: How high the sought object's frame is above what it stands on, metres.
    """
    step = _step(surface)
    cells, index = np.unique(np.floor(points[:, :2] / step).astype(int), axis=0, return_inverse=True)
    top = np.full(len(cells), -np.inf)
    np.maximum.at(top, index.ravel(), points[:, 2])
    # What can be seen from above may be hollow, or lower than it was taken to be.
    rises = np.arange(RISE_STEP_M / 2, max(0.0, float(top.max() - table_height)) + RISE_STEP_M, RISE_STEP_M)
    ground = np.column_stack([np.repeat((cells + 0.5) * step, len(rises), 0), np.tile(rises, len(cells))])
    ground = ground[ground[:, 2] < np.repeat(top - table_height, len(rises)) + RISE_STEP_M / 2]
    ground[:, 2] += table_height + frame_height
    return np.asarray(ground, float)


def _step(surface: Surface) -> float:
    """Distance between places to be searched, metres."""
    return float(np.clip(0.25 * surface.radius, 0.012, 0.03))


def _likely(surface: Surface, sights: Mapping[str, Sight], places: Array) -> Array:
    """Those of places ``(q, 3)`` where pictures show colours of the object, and others around it."""
    offset = surface.coloured - np.append(surface.middle, 0.0)
    core = offset[np.linalg.norm(offset[:, :2], axis=1) < CORE_SHARE * surface.radius]
    core = core[spaced(np.argsort(core[:, 2]), CORE_POINTS)] if len(core) else offset[:CORE_POINTS]
    angles = np.linspace(0, 2 * np.pi, CORE_POINTS, endpoint=False)
    ring = np.zeros((CORE_POINTS, 3))
    ring[:, :2] = AROUND_SHARE * surface.radius * np.stack([np.cos(angles), np.sin(angles)], -1)
    ring[:, 2] = np.median(core[:, 2])
    like, told = np.zeros(len(places)), np.zeros(len(places))
    for sight in sights.values():
        colours = palette_likeness(surface, sight)
        inside, seen = shown_at(colours, sight, core, places)
        around, _ = shown_at(colours, sight, ring, places)
        like += inside - AROUND_COST * around
        told += seen
    like /= np.maximum(told, ENOUGH_SHOWN)
    kept = int(np.clip(KEPT_PLACES * len(places), MIN_PLACES, MAX_PLACES))
    return places[np.argsort(-like)[:kept]]


def _turned(
    surface: Surface, sights: Mapping[str, Sight], places: Array, yaw: float, apart: float, count: int
) -> Array:
    """Poses and their agreement ``(k, 5)`` around the best places of ``(q, 3)``, for one direction."""
    # The places are of the object's middle, which is not its frame's origin.
    offset = np.append(rotations(np.array([yaw]))[0][:2, :2] @ surface.middle, 0.0)
    poses = np.column_stack([places - offset, np.full(len(places), yaw)])
    areas = _areas(surface, places)
    samples = [_seen_in(surface, sights, poses[areas == i]) for i in range(areas.max() + 1)]
    scores = np.zeros(len(poses))
    for i, seen in enumerate(samples):
        coarse = {camera: sample.thinned(2) for camera, sample in seen.items()}
        scores[areas == i] = agreement(coarse, sights, poses[areas == i], is_coarse=True)
    around = np.stack([[a * NUDGE_M, b * NUDGE_M, 0, 0] for a in (-1, 0, 1) for b in (-1, 0, 1)])
    found: list[Array] = []
    for row in _distinct(np.column_stack([poses, scores, areas.astype(float)]), apart, count):
        nudged = row[:4] + around
        found.append(np.column_stack([nudged, agreement(samples[int(row[5])], sights, nudged)]))
    return np.concatenate(found)


def _areas(surface: Surface, places: Array) -> NDArray[np.int64]:
    """Numbers ``(q,)`` of the areas of places ``(q, 3)`` in which a camera sees an object from one side."""
    if not surface.is_large:
        return np.zeros(len(places), np.int64)
    cells = np.floor(places[:, :2] / SEEN_ALIKE_M)
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1], np.int64).ravel()


def _seen_in(surface: Surface, sights: Mapping[str, Sight], poses: Array) -> dict[str, Sample]:
    """The points that each camera sees of an object at poses ``(q, 4)``, where it sees best."""
    height, yaw = float(np.median(poses[:, 2])), float(poses[0, 3])
    seen: dict[str, Sample] = {}
    for camera, sight in sights.items():
        T = sight.view.T_world_cam
        middle = T[:2, 3] + (height - T[2, 3]) / min(T[2, 2], -0.1) * T[:2, 2]
        middle = np.clip(middle, poses[:, :2].min(0), poses[:, :2].max(0))
        sample = take_sample(surface, sight, np.array([*middle, height, yaw]), QUICK_POINTS)
        if sample is not None:
            seen[camera] = sample
    return seen


def _apart(pose: Array, other: Array, metres: float) -> bool:
    turn = abs((pose[3] - other[3] + np.pi) % (2 * np.pi) - np.pi)
    return bool(np.linalg.norm(pose[:3] - other[:3]) > metres or turn > 0.1)


def refine(
    surface: Surface,
    sights: Mapping[str, Sight],
    pose: Array,
    freedom: Freedom,
    count: int,
    steps: Sequence[tuple[float, float]],
) -> Place:
    """Move a pose (x, y, z, yaw) in ever smaller steps to where all views agree best.

    Args:
        surface: What is sought.
        sights: The views.
        pose: Where to begin.
        freedom: What may change beside the horizontal place.
        count: Points to compare in a view.
        steps: Metres and radians of each round.
    """
    pose, score = np.array(pose, float), 0.0
    beside = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b]
    samples, sampled_at = dict[str, Sample](), np.full(4, np.nan)
    for metres, radians in steps:
        if (pose != sampled_at).any():  # what has not moved looks as before
            samples, sampled_at = samples_at(surface, sights, pose, count), pose
        if not samples:
            return Place(pose, 0.0)
        moves = [np.zeros(4), *(np.array([a * metres, b * metres, 0.0, 0.0]) for a, b in beside)]
        if freedom.turns:
            moves += [np.array([0.0, 0.0, 0.0, sign * radians]) for sign in (-1, 1)]
        if freedom.lifts and len(samples) > 1:
            moves += [np.array([0.0, 0.0, sign * metres, 0.0]) for sign in (-1, 1)]
        for _ in range(MOVES_PER_STEP):
            scores = agreement(samples, sights, pose + np.stack(moves))
            best = int(scores.argmax())
            score = float(scores[best])
            if best == 0:
                break
            pose = pose + moves[best]
    return Place(pose, score)


def settle(surface: Surface, sights: Mapping[str, Sight], pose: Array, freedom: Freedom) -> Place:
    """The best place around a pose (x, y, z, yaw) ``(4,)``, sought coarsely and then finely."""
    quick = refine(surface, sights, pose, freedom, QUICK_POINTS, QUICK_STEPS)
    return refine(surface, sights, quick.pose, freedom, FINE_POINTS, FINE_STEPS)


def covariance_at(surface: Surface, sights: Mapping[str, Sight], pose: Array, turns: bool) -> Array:
    """How well the pictures tell a pose: covariance ``(4, 4)`` over x, y, z and yaw, m and rad.

    It is small where agreement falls steeply around the pose. The height is not sought and taken for known.
    """
    variances = np.array([LARGEST_STD_M**2, LARGEST_STD_M**2, HEIGHT_STD_M**2, UNKNOWN_YAW_STD**2])
    samples = samples_at(surface, sights, pose, FINE_POINTS)
    if not samples:
        return np.diag(variances)
    steps = np.diag([PROBE_M, PROBE_M, 0.0, PROBE_RAD])[[0, 1, 3]]
    scores = agreement(samples, sights, pose + np.concatenate([np.zeros((1, 4)), steps, -steps]))
    falls = np.maximum(scores[0] - (scores[1:4] + scores[4:]) / 2, 1e-6)
    told = AGREEMENT_NOISE * np.array([PROBE_M, PROBE_M, PROBE_RAD]) ** 2 / (2 * falls)
    smallest = np.array([SMALLEST_STD_M, SMALLEST_STD_M, SMALLEST_STD_RAD]) ** 2
    variances[[0, 1, 3]] = np.clip(told, smallest, variances[[0, 1, 3]])
    if not turns:
        variances[3] = UNKNOWN_YAW_STD**2
    return np.diag(variances)
