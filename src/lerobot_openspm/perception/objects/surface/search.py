"""Where a surface explains the pictures best: candidates all over the table, refined in all views at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.surface.compare import (
    FINE_POINTS,
    Sight,
    Surface,
    agreement,
    rotations,
    samples_at,
    take_sample,
)
from lerobot_openspm.types import UNKNOWN_YAW_STD

COARSE_POINTS, QUICK_POINTS = 50, 100
CANDIDATES, CANDIDATES_PER_YAW, FINALISTS = 10, 2, 3
# Two candidates nearer than this are one, metres.
SAME_PLACE_M = 0.035
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


def search(
    surface: Surface,
    sights: Mapping[str, Sight],
    area: Array,
    height: float,
    yaws: Sequence[float],
    turns: bool,
) -> list[Place]:
    """The most likely places on the table, best first.

    Args:
        surface: What is sought.
        sights: The views.
        area: Least and largest x and y ``(2, 2)`` of the object's middle, metres.
        height: World z of the object's frame.
        yaws: Directions to begin from.
        turns: Whether they may change a little.
    """
    step = float(np.clip(0.25 * surface.radius, 0.012, 0.02))
    apart = max(SAME_PLACE_M, 0.3 * surface.radius)
    ground = np.stack(
        np.meshgrid(*(np.arange(low, high, step) for low, high in area.T), indexing="ij"), -1
    ).reshape(-1, 2)
    starts = np.concatenate([_over_table(surface, sights, area, ground, height, yaw) for yaw in yaws])
    places: list[Place] = []
    begun: list[Array] = []
    for i in np.argsort(-starts[:, 4])[:600]:
        pose = starts[i, :4]
        if all(_apart(pose, place, apart) for place in begun):
            begun.append(pose)
            places.append(refine(surface, sights, pose, turns, QUICK_POINTS, QUICK_STEPS))
        if len(places) >= CANDIDATES + CANDIDATES_PER_YAW * len(yaws):
            break
    places.sort(key=lambda place: -place.score)
    finest = [
        refine(surface, sights, place.pose, turns, FINE_POINTS, FINE_STEPS) for place in places[:FINALISTS]
    ]
    return sorted(finest, key=lambda place: -place.score)


def _over_table(
    surface: Surface, sights: Mapping[str, Sight], area: Array, ground: Array, height: float, yaw: float
) -> Array:
    """Poses and agreement ``(q, 5)`` all over the table, by the points that cameras see in its middle."""
    # The grid is of the object's middle, which is not its frame's origin.
    offset = rotations(np.array([yaw]))[0][:2, :2] @ surface.middle
    ground = ground - offset
    poses = np.column_stack([ground, np.full(len(ground), height), np.full(len(ground), yaw)])
    samples = {}
    for camera, sight in sights.items():
        T = sight.view.T_world_cam
        middle = T[:2, 3] + (height - T[2, 3]) / min(T[2, 2], -0.1) * T[:2, 2]
        middle = np.clip(middle, area[0] + 0.1, area[1] - 0.1) - offset
        sample = take_sample(surface, sight, np.array([*middle, height, yaw]), COARSE_POINTS)
        if sample is not None:
            samples[camera] = sample
    score = agreement(samples, sights, poses, is_coarse=True) if samples else np.zeros(len(poses))
    return np.column_stack([poses, score])


def _apart(pose: Array, other: Array, metres: float) -> bool:
    turn = abs((pose[3] - other[3] + np.pi) % (2 * np.pi) - np.pi)
    return bool(np.linalg.norm(pose[:2] - other[:2]) > metres or turn > 0.1)


def refine(
    surface: Surface,
    sights: Mapping[str, Sight],
    pose: Array,
    turns: bool,
    count: int,
    steps: Sequence[tuple[float, float]],
) -> Place:
    """Move a pose (x, y, z, yaw) in ever smaller steps to where all views agree best.

    Args:
        surface: What is sought.
        sights: The views.
        pose: Where to begin.
        turns: Whether the yaw may change.
        count: Points to compare in a view.
        steps: Metres and radians of each round.
    """
    pose, score = np.array(pose, float), 0.0
    beside = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b]
    for metres, radians in steps:
        samples = samples_at(surface, sights, pose, count)
        if not samples:
            return Place(pose, 0.0)
        moves = [np.zeros(4), *(np.array([a * metres, b * metres, 0.0, 0.0]) for a, b in beside)]
        if turns:
            moves += [np.array([0.0, 0.0, 0.0, sign * radians]) for sign in (-1, 1)]
        for _ in range(MOVES_PER_STEP):
            scores = agreement(samples, sights, pose + np.stack(moves))
            best = int(scores.argmax())
            score = float(scores[best])
            if best == 0:
                break
            pose = pose + moves[best]
    return Place(pose, score)


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
