"""Near-duplicates become one entry: the mean of their key poses, and the spread around it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import Axis, MemoryEntry, MemoryKeyPose
from lerobot_openspm.memory.quality import pooled_quality, prior_quality

# Between the sources of a merged entry.
SOURCES = ", "
# Steps of the mean on SE(3); it has converged to rounding after three for poses less than a radian apart.
MEAN_STEPS = 10


class Merged(NamedTuple):
    """What merging makes of entries.

    Attributes:
        entries: All that there are afterwards, a merged one in the place of the first it was made of.
        superseded: Those that went into merged ones.
    """

    entries: tuple[MemoryEntry, ...]
    superseded: tuple[MemoryEntry, ...]


def merge_near_duplicates(
    entries: Sequence[MemoryEntry], distance_m: float, angle_rad: float, language: str | None = None
) -> Merged:
    """Merge entries of one key and the same anchors, all of whose key poses lie close together.

    Args:
        entries: The entries.
        distance_m: Every two of what is merged have each key pose within this distance ...
        angle_rad: ... and this angle of one another.
        language: The instruction whose entries are merged; all if not given.
    """
    alike: dict[Hashable, list[int]] = defaultdict(list)
    for i, entry in enumerate(entries):
        if language in (None, entry.language):
            alike[_structure(entry)].append(i)
    groups = [
        [members[j] for j in cluster]
        for members in alike.values()
        for cluster in _clusters([entries[i] for i in members], distance_m, angle_rad)
    ]
    merged = {group[0]: merge([entries[i] for i in group]) for group in groups if len(group) > 1}
    gone = {i for group in groups if len(group) > 1 for i in group}
    kept = [merged.get(i, entry) for i, entry in enumerate(entries) if i in merged or i not in gone]
    return Merged(tuple(kept), tuple(entries[i] for i in sorted(gone)))


def _structure(entry: MemoryEntry) -> Hashable:
    """What has to be the same for entries to be merged."""
    poses = tuple(
        (p.anchor, p.phase, p.closed, p.dwell, p.sub_task, p.axis and p.axis.kind) for p in entry.key_poses
    )
    return entry.key, poses


def _clusters(entries: Sequence[MemoryEntry], distance_m: float, angle_rad: float) -> list[list[int]]:
    """Indices of entries that are close to all others of their cluster, in order of the first."""
    poses = np.stack([[pose.T_obj_ee for pose in entry.key_poses] for entry in entries])
    clusters: list[list[int]] = []
    for i in range(len(entries)):
        for cluster in clusters:
            metres, radians = se3.distances(poses[cluster], poses[i])
            if metres.max() <= distance_m and radians.max() <= angle_rad:
                cluster.append(i)
                break
        else:
            clusters.append([i])
    return clusters


def demonstration_of(source: str) -> str:
    """The demonstration of one source; what is done a second time in it has a number of its own behind it."""
    name, _, number = source.rpartition("#")
    return f"{name}#{number.partition('.')[0]}"


def merge(entries: Sequence[MemoryEntry]) -> MemoryEntry:
    """One entry in the place of several of the same structure; the first says where its objects stood."""
    counts = np.array([len(entry.source.split(SOURCES)) for entry in entries], float)
    first = entries[0]
    key_poses = tuple(
        _merged_pose(poses, counts) for poses in zip(*(e.key_poses for e in entries), strict=True)
    )
    trials, successes = sum(e.trials for e in entries), sum(e.successes for e in entries)
    prior = float(np.average([prior_quality(e) for e in entries], weights=counts))
    return replace(
        first,
        key_poses=key_poses,
        quality=pooled_quality(prior, trials, successes),
        version=max(e.version for e in entries) + 1,
        source=SOURCES.join(e.source for e in entries),
        trials=trials,
        successes=successes,
    )


def _merged_pose(poses: Sequence[MemoryKeyPose], counts: NDArray[np.float64]) -> MemoryKeyPose:
    T = np.stack([pose.T_obj_ee for pose in poses])
    mean = mean_pose(T, counts)
    return replace(
        poses[0],
        T_obj_ee=mean,
        confidence=float(np.average([pose.confidence for pose in poses], weights=counts)),
        opening=float(np.average([pose.opening for pose in poses], weights=counts)),
        n_steps=round(float(np.average([pose.n_steps for pose in poses], weights=counts))),
        axis=_merged_axis([pose.axis for pose in poses if pose.axis is not None], counts),
        covariance=_pooled_covariance(se3.increment(mean, T), [p.covariance for p in poses], counts),
    )


def mean_pose(T: Array, weights: Array) -> Array:
    """The pose ``(4, 4)`` from which the weighted increments to poses ``(n, 4, 4)`` add up to nothing."""
    mean = T[0]
    for _ in range(MEAN_STEPS):
        mean = se3.apply_increment(mean, np.average(se3.increment(mean, T), axis=0, weights=weights))
    return mean


def _pooled_covariance(
    increments: Array, covariances: Sequence[Array | None], counts: NDArray[np.float64]
) -> Array:
    """Sample covariance ``(6, 6)`` of all demonstrations, of those merged before by their own."""
    scatter = (counts[:, None] * increments).T @ increments
    for covariance, count in zip(covariances, counts, strict=True):
        if covariance is not None:
            scatter = scatter + (count - 1) * covariance
    return (scatter + scatter.T) / 2 / (counts.sum() - 1)


def _merged_axis(axes: Sequence[Axis], counts: NDArray[np.float64]) -> Axis | None:
    if not axes:
        return None
    direction = np.average([axis.direction for axis in axes], axis=0, weights=counts)
    amount = float(np.average([axis.amount for axis in axes], weights=counts))
    return replace(axes[0], direction=direction / np.linalg.norm(direction), amount=amount)
