"""Finding objects in an observation, as the experience's perception does it."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_openspm.experience import Experience
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.mining.mine import name_simulator_poses
from lerobot_openspm.observation import Observation
from lerobot_openspm.perception.localise import localise_all
from lerobot_openspm.perception.types import Segmenter


def find_objects(
    names: Sequence[str],
    observation: Observation,
    experience: Experience,
    min_confidence: float = 0.0,
    segmenter: Segmenter | None = None,
) -> dict[str, Array]:
    """Poses ``T_world_obj`` ``(4, 4)`` of those of the named objects that are found with this confidence.

    Args:
        names: The objects' phrases.
        observation: What the robot sees.
        experience: What is known of the objects.
        min_confidence: From 0 to 1; 1 is as clear as in the demonstrations.
        segmenter: Finds their masks, if they were learned from a segmenter's.
    """
    if experience.perception == "oracle":
        poses = observation.simulator_layout(experience.simulator_objects)
        return name_simulator_poses(poses, names, experience.objects)
    views = observation.views(experience.cameras)
    known = {name: experience.objects[name] for name in names if name in experience.objects}
    estimates = localise_all(views, known, segmenter)
    return {
        name: estimate.T_world_obj
        for name, estimate in estimates.items()
        if estimate.status == "found" and estimate.confidence >= min_confidence
    }
