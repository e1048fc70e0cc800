"""How far the poses that a policy follows are from the simulator's, all through an episode.

Perception's frame of an object stands in a fixed place on it, told by the demonstrations
(:mod:`lerobot_openspm.bench.object_frames`). From the start of an episode the truth is carried along by the
object's own motion in the simulator, tilting included.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lerobot_openspm.bench.object_frames import upright
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.oracle import name_simulator_poses

# What truly turns into itself, by a word of its name; what was learned may differ.
ROUND, HALF_TURN = ("bowl", "plate", "bottle"), ("box", "cheese")


def true_period(name: str, env_type: str) -> float:
    """Angle that truly turns a simulator's object into itself, radians; 0 for a round one."""
    words = name.split()
    if any(word in ROUND for word in words):
        return 0.0
    # The tabletop's rack looks the same from both sides, LIBERO's does not.
    half_turn = (*HALF_TURN, "rack") if env_type == "openspm_tabletop" else HALF_TURN
    return np.pi if any(word in half_turn for word in words) else 2 * np.pi


class Truth:
    """Where the objects of one episode truly are, in perception's frames.

    Args:
        start: The simulator's poses ``T_world_obj`` at the start of the episode, by its names.
        offsets: Perception's frame in the simulator's upright one, ``T_sim_obj``, by the policy's names.
    """

    def __init__(self, start: Mapping[str, Array], offsets: Mapping[str, Array]) -> None:
        self._offsets = offsets
        self._start = name_simulator_poses(start, list(offsets), {})
        self._begun = {name: upright(T) @ offsets[name] for name, T in self._start.items()}

    def now(self, poses: Mapping[str, Array]) -> dict[str, Array]:
        """True ``T_world_obj`` by the policy's names, given the simulator's present poses."""
        named = name_simulator_poses(poses, list(self._offsets), {})
        return {name: T @ se3.inverse(self._start[name]) @ self._begun[name] for name, T in named.items()}


def pose_error(T_true: Array, T: Array, period: float) -> tuple[float, float]:
    """Distance in metres, and angle in radians up to the object's symmetry, between two poses."""
    metres = float(np.linalg.norm(T_true[:3, 3] - T[:3, 3]))
    if period == 0:  # the angle between the axes of revolution
        cosine = float(np.clip(T_true[:3, 2] @ T[:3, 2], -1, 1))
        return metres, float(np.arccos(cosine))
    radians = min(float(se3.distances(T_true, one)[1]) for one in se3.yaw_equivalents(T, period))
    return metres, radians
