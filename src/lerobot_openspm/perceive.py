"""Finding objects in an observation, as the experience's perception does it."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_openspm.experience import Experience
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.mining.mine import name_simulator_poses
from lerobot_openspm.observation import Observation
from lerobot_openspm.perception.localise import localise, prepare


def find_objects(
    names: Sequence[str], observation: Observation, experience: Experience, min_confidence: float = 0.0
) -> dict[str, Array]:
    """Poses ``T_world_obj`` ``(4, 4)`` of those of the named objects that are found with this confidence."""
    if experience.perception == "oracle":
        poses = observation.simulator_layout(experience.simulator_objects)
        return name_simulator_poses(poses, names, experience.objects)
    views = observation.views(experience.cameras)
    prepared = {key: prepare(view) for key, view in views.items()}
    known = [name for name in names if name in experience.objects]
    estimates = {name: localise(prepared, experience.objects[name]) for name in known}
    return {
        name: estimate.T_world_obj
        for name, estimate in estimates.items()
        if estimate.status == "found" and estimate.confidence >= min_confidence
    }
