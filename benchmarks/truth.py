"""How far the poses that a policy follows are from the simulator's.

A learned object's frame stands in a fixed but arbitrary place on the object. That one rigid offset is fitted
on the demonstrations, against the simulator; errors are what remains on scenes that no demonstration showed.
From the start of an episode the truth is carried along by the object's own motion, tilting included.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.episodes import load
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import episode_of
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.mining.dataset import Demonstrations, dataset_metadata
from lerobot_openspm.perception.objects.base import KnownObject
from lerobot_openspm.perception.oracle import name_simulator_poses
from lerobot_openspm.training import open_demonstrations

# Objects that truly turn into themselves, by a word of their name; what was learned may differ.
ROUND, HALF_TURN = ("bowl", "plate", "bottle"), ("box", "cheese", "basket")
# Metres and radians off; None where the object was not found, or its yaw says nothing.
type Error = tuple[float | None, float | None]


@functools.lru_cache(1)
def offsets(checkpoint: Path, dataset: Path) -> dict[str, Array]:
    """Every model's frame in the simulator's upright one, ``T_sim_obj``, by the policy's names.

    Raises:
        DatasetError: There are no demonstrations in the folder.
    """
    policy = load(str(checkpoint))
    memory = policy.require_memory()
    demonstrations = open_demonstrations(
        dataset_metadata("local/demonstrations", str(dataset)), policy.config
    )
    return offsets_in(memory, demonstrations)


def offsets_in(memory: Memory, demonstrations: Demonstrations) -> dict[str, Array]:
    """As :func:`offsets`, of the objects that were found in the demonstrations they were learned from."""
    found = {name for entry in memory.entries for name in entry.object_poses}
    return {name: _offset(memory, name, demonstrations) for name in memory.objects if name in found}


def _offset(memory: Memory, name: str, demonstrations: Demonstrations) -> Array:
    """One model's frame as the median over the demonstrations; what is round by its middle."""
    period, found = memory.objects[name].yaw_period, []
    for entry in memory.entries:
        if name in entry.object_poses:
            episode = demonstrations.episodes([episode_of(entry.source)])[0]
            poses = demonstrations.simulator_poses(episode, 0)
            truth = upright(name_simulator_poses(poses, [name], memory.objects)[name])
            equivalents = [
                se3.inverse(truth) @ T for T in se3.yaw_equivalents(entry.object_poses[name], period)
            ]
            found.append(min(equivalents, key=lambda T: abs(float(se3.yaw_of(T)))))
    T_obj_middle = middle(memory.objects[name])
    relative = np.stack(found) @ T_obj_middle
    T = se3.from_yaw(np.median(relative[:, :3, 3], axis=0), np.median(se3.yaw_of(relative)))
    return T @ se3.inverse(T_obj_middle)


def middle(model: KnownObject) -> Array:
    """A model's middle in its frame, ``T_obj_middle`` ``(4, 4)``: where it is however it is found turned."""
    symmetry = model.symmetry
    return np.eye(4) if symmetry is None else se3.from_yaw([*symmetry.middle, 0.0], 0.0)


def upright(T: Array) -> Array:
    """A pose with its tilt left out, as perception's are: a simulator's body may be modelled lying down."""
    return se3.from_yaw(T[:3, 3], float(se3.yaw_of(T)))


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


def summary(errors: Sequence[Error]) -> dict[str, Any]:
    """Mean and 95th percentile of position errors, mean of orientation errors, and what was not known."""
    metres, radians = np.array(errors, float).reshape(-1, 2).T
    metres, radians = metres[np.isfinite(metres)], radians[np.isfinite(radians)]
    return {
        "poses": len(errors),
        "unknown": len(errors) - len(metres),
        "position_mm_mean": round(1000 * float(metres.mean()), 2) if len(metres) else None,
        "position_mm_p95": round(1000 * float(np.percentile(metres, 95)), 2) if len(metres) else None,
        "orientation_deg_mean": round(float(np.rad2deg(radians.mean())), 2) if len(radians) else None,
    }
