"""One environment's eyes: which cameras can be believed, and where the objects are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.perception.objects.localise import localise_all
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.occlusion import hand_mask
from lerobot_openspm.perception.oracle import name_simulator_poses
from lerobot_openspm.perception.tracking.camera_health import CameraWatch
from lerobot_openspm.types import Detections, PoseEstimate, Segmenter, View

# How exact the simulator's poses are taken to be (oracle ablation only): metres and radians.
ORACLE_STD = 1e-4


@dataclass
class Perception:
    """What one environment looks through.

    Attributes:
        memory: What objects and cameras are known.
        hand_radius_m: Radius of the hand, which hides what is behind it.
        segmenter: Finds the masks of objects that were learned from a segmenter's; None if none were.
    """

    memory: Memory
    hand_radius_m: float
    segmenter: Segmenter | None = None
    _watch: CameraWatch = field(default_factory=CameraWatch)
    _has_looked: bool = False
    _labelled: set[str] = field(default_factory=set)

    def detect(
        self, observation: Observation, names: Sequence[str], expected: Mapping[str, Array], time_s: float
    ) -> Detections:
        """Look for objects.

        Args:
            observation: What there is to see.
            names: The objects.
            expected: Poses ``T_world_obj`` ``(4, 4)`` of those that were seen before; they are looked for
                there first.
            time_s: Seconds since the episode began.

        Raises:
            ObservationError: A camera is missing or broken at the very first look.
        """
        if self.memory.perception == "oracle":
            return Detections(self._simulator_poses(observation, names), {})
        if not self._has_looked:  # a camera that never worked is a mistake in the set-up
            observation.views(self.memory.cameras)
            self._has_looked = True
        views, absent = observation.usable_views(self.memory.cameras)
        for camera in [name for name in self._labelled if name in views and views[name].labels is None]:
            absent[camera] = "gave no masks, which it did before"
            del views[camera]
        if self.segmenter is not None:
            self._labelled |= {name for name, view in views.items() if view.labels is not None}
        T_world_ee = observation.hand.T_world_ee
        faults = self._watch.check(views, absent, T_world_ee, time_s)
        good = {camera: view for camera, view in views.items() if camera not in faults}
        return Detections(self._find(good, names, expected, T_world_ee) if good else {}, faults)

    def _find(
        self,
        views: Mapping[str, View],
        names: Sequence[str],
        expected: Mapping[str, Array],
        T_world_ee: Array,
    ) -> dict[str, PoseEstimate]:
        hidden = {camera: hand_mask(view, T_world_ee, self.hand_radius_m) for camera, view in views.items()}
        known = {n: self.memory.objects[n] for n in names if n in self.memory.objects}
        return localise_all(views, known, self.segmenter, hidden, expected)

    def _simulator_poses(self, observation: Observation, names: Sequence[str]) -> dict[str, PoseEstimate]:
        poses = observation.simulator_layout(self.memory.simulator_objects)
        named = name_simulator_poses(poses, names, self.memory.objects)
        covariance = ORACLE_STD**2 * np.eye(4)
        return {name: PoseEstimate("found", T, covariance, 1.0, {}) for name, T in named.items()}
