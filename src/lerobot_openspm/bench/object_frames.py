"""How far the poses that perception finds are from the simulator's.

A learned object's frame stands in a fixed but arbitrary place on the object. That one rigid offset is fitted
on the demonstrations, against the simulator; errors are what remains on scenes that no demonstration showed.
"""

from __future__ import annotations

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.perception.oracle import name_simulator_poses


def offset(memory: Memory, name: str, demonstrations: Demonstrations) -> np.ndarray:
    """The model's frame in the simulator's, ``T_sim_obj``, as the median over the demonstrations."""
    period, relative = memory.objects[name].yaw_period, []
    for entry in memory.entries:
        if name in entry.layout:
            episode = demonstrations.episodes([int(entry.source.rsplit("#", 1)[1])])[0]
            poses = demonstrations.simulator_poses(episode, 0)
            truth = upright(name_simulator_poses(poses, [name], memory.objects)[name])
            equivalents = [se3.inverse(truth) @ T for T in se3.yaw_equivalents(entry.layout[name], period)]
            relative.append(min(equivalents, key=lambda T: abs(float(se3.yaw_of(T)))))
    relative = np.stack(relative)
    return se3.from_yaw(np.median(relative[:, :3, 3], axis=0), np.median(se3.yaw_of(relative)))


def error(
    T_sim: np.ndarray, T_world_obj: np.ndarray, T_sim_obj: np.ndarray, period: float
) -> tuple[float, float]:
    """Distance in metres, and yaw in radians up to the object's true symmetry (NaN for round ones).

    Args:
        T_sim: The simulator's pose.
        T_world_obj: The pose that was found.
        T_sim_obj: The model's :func:`offset`.
        period: Angle that truly turns the object into itself, radians; 0 for a body of revolution.
    """
    T_error = se3.inverse(upright(T_sim)) @ T_world_obj @ se3.inverse(T_sim_obj)
    yaw = float(abs(se3.wrap_angle(se3.yaw_of(T_error), period))) if period > 0 else np.nan
    return float(np.linalg.norm(T_error[:3, 3])), yaw


def upright(T: np.ndarray) -> np.ndarray:
    """A pose with its tilt left out, as perception's are: a simulator's body may be modelled lying down."""
    return se3.from_yaw(T[:3, 3], float(se3.yaw_of(T)))


def summary(errors: np.ndarray, period: float) -> dict:
    """Mean and 95th percentile of errors ``(n, 2)``, NaN where an object was not found."""
    metres, radians = errors.T
    return {
        "n": len(errors),
        "not_found": int(np.isnan(metres).sum()),
        "position_mm_mean": round(1000 * float(np.nanmean(metres)), 2),
        "position_mm_p95": round(1000 * float(np.nanpercentile(metres, 95)), 2),
        "yaw_deg_mean": round(float(np.rad2deg(np.nanmean(radians))), 2) if period > 0 else None,
    }
