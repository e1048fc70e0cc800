"""The way that a demonstration takes with something in the hand, for another thing to take.

What the other thing stands on takes the way that what the first one stands on took.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import ARRIVING, MemoryEntry, MemoryKeyPose

# Where something was only pushed to, another one is let down from this height, and let go of at that, metres.
LOWERED_M, RELEASED_M = 0.10, 0.003


def grasped(entry: MemoryEntry) -> tuple[int, Array]:
    """Which key pose takes hold of the target, and where the hand is then, ``T_world_ee`` ``(4, 4)``."""
    index = next(i for i, pose in enumerate(entry.key_poses) if pose.phase == "grasp")
    return index, entry.demonstrated(entry.key_poses[index])


@dataclass(frozen=True)
class Way:
    """The way that what something stands on takes to its place, in the world of its demonstration.

    Attributes:
        poses: The key poses on it.
        points: Where the middle of the underside is at each ``(3,)``, metres.
        rise_m: How high the hand lifts the thing at first.
    """

    poses: tuple[MemoryKeyPose, ...]
    points: tuple[Array, ...]
    rise_m: float

    def higher(self, metres: float) -> Way:
        """The same way with more room below, but for the place itself."""
        up = [metres if pose.phase == "pre-place" else 0.0 for pose in self.poses]
        points = [point + np.array([0.0, 0.0, z]) for point, z in zip(self.points, up, strict=True)]
        return replace(self, points=tuple(points), rise_m=self.rise_m + metres)


def way_of(place: MemoryEntry, stood: Array) -> Way:
    """The way to the place that an entry shows, for something that stood at a point ``(3,)``."""
    if any(pose.phase == "push" for pose in place.key_poses):
        return _way_down(place, stood)
    index, T_grasp = grasped(place)
    T_ee_world = se3.inverse(T_grasp)
    arriving = tuple(pose for pose in place.key_poses[index + 1 :] if pose.phase in ARRIVING)
    arrived = [place.demonstrated(pose) for pose in arriving]
    points = [se3.apply(T @ T_ee_world, stood[None])[0] for T in arrived]
    at_place = max(i for i, pose in enumerate(arriving) if pose.phase == "place")
    # While the fingers open, the hand leaves the thing behind.
    points = [
        points[at_place] if pose.phase == "release" else p for pose, p in zip(arriving, points, strict=True)
    ]
    lifted = [place.demonstrated(pose)[2, 3] for pose in place.key_poses[index + 1 :] if pose.phase == "lift"]
    return Way(arriving, tuple(points), max((float(z - T_grasp[2, 3]) for z in lifted), default=0.0))


def _way_down(place: MemoryEntry, stood: Array) -> Way:
    """The way straight down to where something was pushed to."""
    outcome, poses = place.outcomes[0], place.object_poses
    end = stood + outcome.place_shown(poses) - outcome.target_at(poses) + [0.0, 0.0, RELEASED_M]
    last = next(pose for pose in reversed(place.key_poses) if pose.phase == "push")
    arriving = tuple(
        replace(last, phase=phase, closed=True, dwell=False, axis=None) for phase in ("pre-place", "place")
    )
    above = end + np.array([0.0, 0.0, LOWERED_M])
    return Way(arriving, (above, end), LOWERED_M)
