"""Ways that are clear of what stands about: the hand is lifted over it.

Key poses say where the hand has to be, not how it gets there; on the way it goes straight. Where other
objects stand elsewhere than in the demonstration, one may be in the way. Then the hand first rises, crosses
above it and comes down: two more key poses, of the same objects as those before and after. This is the
paper's check of the minimum distance, for objects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose

# Phases that cross free space.
CROSSING = ("approach", "pre-place")
# The hand comes down where it points down, by the cosine of its lean; otherwise it goes as it was shown.
UPRIGHT = 0.9
# A way shorter than this, horizontally, crosses nothing, metres.
SHORTEST_M = 0.03
# The hand stays this far above what it crosses, metres, ...
CLEARANCE_M = 0.03
# ... and passes beside it at this many times its radius: a hand is wider across its fingers than on average.
BESIDE = 1.5
# So many places of a way are compared with what stands about.
STEPS = 24


@dataclass(frozen=True)
class Way:
    """The straight way of the hand to a key pose.

    Attributes:
        start: Where the fingertips are ``(3,)``, world.
        goal: Where they go ``(3,)``.
        below: How far what is in the hand reaches below them, metres.
    """

    start: Array
    goal: Array
    below: float

    def height_over(self, points: Array, radius: float) -> float | None:
        """How high the fingertips have to cross points ``(n, 3)``, world z; None if the way is clear.

        Args:
            points: What stands about.
            radius: Of the hand, and what it carries, metres.
        """
        share = np.linspace(0, 1, STEPS)[:, None]
        places = self.start + share * (self.goal - self.start)
        apart = np.linalg.norm(points[None, :, :2] - places[:, None, :2], axis=-1)
        is_under = apart < radius
        lowest = places[:, None, 2] - self.below - CLEARANCE_M
        if not (is_under & (points[None, :, 2] > lowest)).any():
            return None
        return float(points[is_under.any(0), 2].max()) + self.below + CLEARANCE_M


def lifted(
    entry: MemoryEntry,
    targets: Sequence[Target],
    T_world_ee: Array,
    points: Mapping[str, Array],
    radius: float,
) -> MemoryEntry:
    """An entry with further key poses where its ways run into what stands about.

    Args:
        entry: What is to be executed.
        targets: Its key poses in the scene, at least as many as it has.
        T_world_ee: Where the hand is ``(4, 4)``.
        points: Points ``(n, 3)`` in the world of the objects that were found, by name.
        radius: Of the hand, metres.
    """
    poses: list[MemoryKeyPose] = []
    before, held, below = T_world_ee, "", 0.0
    for i, (pose, target) in enumerate(zip(entry.key_poses, targets, strict=False)):
        way = Way(before[:3, 3], target.T_world_ee[:3, 3], below)
        is_upright = -target.T_world_ee[2, 2] > UPRIGHT
        if is_upright and pose.phase in CROSSING and np.linalg.norm((way.goal - way.start)[:2]) > SHORTEST_M:
            near = {held, *pose.anchor.objects, *(entry.key_poses[i - 1].anchor.objects if i else ())}
            others = [own for name, own in points.items() if name not in near]
            height = way.height_over(np.concatenate(others), BESIDE * radius) if others else None
            if height is not None:
                over = (
                    [(pose, way.goal)] if i == 0 else [(entry.key_poses[i - 1], way.start), (pose, way.goal)]
                )
                poses += [_raised(one, height - place[2], pose) for one, place in over if height > place[2]]
        poses.append(pose)
        if pose.phase == "grasp":
            held = pose.anchor.place
            below = _below(target.T_world_ee, points.get(held))
        elif pose.phase == "release":
            held, below = "", 0.0
        before = target.T_world_ee
    return replace(entry, key_poses=tuple(poses))


def _raised(pose: MemoryKeyPose, rise: float, towards: MemoryKeyPose) -> MemoryKeyPose:
    """A key pose that is passed by, above another one, on the way to a third."""
    T = se3.transform(pose.T_obj_ee[:3, :3], pose.T_obj_ee[:3, 3] + [0.0, 0.0, rise])
    return replace(
        towards, anchor=pose.anchor, T_obj_ee=T, n_steps=1, dwell=False, axis=None, covariance=None
    )


def _below(T_world_ee: Array, points: Array | None) -> float:
    """How far an object that is grasped here reaches below the fingertips, metres."""
    return 0.0 if points is None else max(0.0, float(T_world_ee[2, 3] - points[:, 2].min()))
