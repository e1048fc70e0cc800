"""A controller, and a world that it looks at, for tests that go through an episode."""

import numpy as np
from tests.memory.builders import OPEN_WIDTH, entry, hand_pose, robot

from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.control.feasibility import TransferLimits
from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.control.scene import LOOK_AGAIN_S
from lerobot_openspm.geometry import se3
from lerobot_openspm.types import Detections, Hand, PoseEstimate

HAND = Hand(hand_pose(0.0, 0.0, 0.3), OPEN_WIDTH)
INSTRUCTION = "put the bowl on the plate"
COVARIANCE = np.diag([1e-6, 1e-6, 1e-6, 1e-4])
STEP_S = 0.05
LOOK_AGAIN_STEPS = round(LOOK_AGAIN_S / STEP_S)


def planning_context(*entries, limits=None, execution="closed_loop_trc", **options):
    return PlanningContext(
        entries or (entry(),), {}, robot(), limits or TransferLimits(), execution, **options
    )


class Perception:
    """Sees the objects where it is told, and remembers what it was asked for."""

    def __init__(self, object_poses):
        self.object_poses, self.asked, self.faults = dict(object_poses), [], {}
        self.confidence = self.visible = 1.0

    def __call__(self, names, expected, time_s):
        self.asked.append(list(names))
        return Detections({name: self._estimate(name) for name in names}, self.faults)

    def _estimate(self, name):
        if name not in self.object_poses:
            return PoseEstimate("not_found", np.eye(4), COVARIANCE, 0.0, self.visible)
        return PoseEstimate("found", self.object_poses[name], COVARIANCE, self.confidence, self.visible)


def controller(*entries, instruction=INSTRUCTION, seed=0, shown=7, **options):
    return EpisodeController(planning_context(*entries, **options), instruction, shown, seed)


def observe(one, hand, perception):
    """One control step without its action, as the policy does it."""
    look = one.advance(hand)
    while look is not None:
        look = one.take_in(look, perception(look.names, look.expected, look.time_s), hand)


def watch(one, perception, hand, steps):
    """Let time pass, the hand standing still and nothing but chunks of zeros to do."""
    for _ in range(steps):
        if one.executor.next_action(hand) is None:
            one.executor.query(hand)
            one.executor.push_chunk(np.zeros((5, 7)))
        observe(one, hand, perception)


def shifted(T, x):
    return se3.transform(T[:3, :3], T[:3, 3] + [x, 0.0, 0.0])
