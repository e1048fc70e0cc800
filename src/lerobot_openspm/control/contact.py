"""What the hand holds and pushes: told by the key poses that it passes, and checked by what is seen."""

from __future__ import annotations

import numpy as np

from lerobot_openspm.control.executor import Executor
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.pushes import PushWays
from lerobot_openspm.control.scene import SceneState
from lerobot_openspm.control.status import Status
from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import Hand

# A hand that has gone this far beyond where it meets what it pushes has lost it; or, where it is not known
# where they meet, this much further than what it pushes, and this much further away from it than at first.
LEFT_BEHIND_M, OUTRUN_M = 0.025, 0.06


class Contact:
    """Keeps the tracker told of what goes along with the hand."""

    def __init__(self, executor: Executor, scene: SceneState):
        self._executor, self._scene = executor, scene

    def update(self, plan: Plan, index_before: int, hand: Hand) -> None:
        """Take in what the hand took hold of, pushes or let go on the key poses just passed."""
        tracker, executor = self._scene.tracker, self._executor
        for i in range(index_before, executor.index):
            self._pass(plan, i, hand)
        target = executor.target
        if target and target.push and self._beyond(target, target.push, hand) >= 0:
            tracker.hold(target.push.target, hand.T_world_ee)
        if executor.status is Status.DONE:
            tracker.release(tracker.held, hand.T_world_ee)

    def _pass(self, plan: Plan, i: int, hand: Hand) -> None:
        """Take in what reaching one key pose means."""
        tracker, targets = self._scene.tracker, self._executor.plan
        passed, after = targets[i].key_pose, targets[i + 1].key_pose
        is_carried = passed.phase == "grasp" and after.phase not in ("open", "turn")
        # Where the way of a push is known, the target is held once the hand has met it; see update().
        is_pushed = after.phase == "push" != passed.phase and targets[i + 1].push is None
        if is_carried:
            tracker.hold(passed.anchor.place, hand.T_world_ee)
        elif is_pushed:
            tracker.hold(plan.sub_task(after).target, hand.T_world_ee)
        elif passed.phase == "release" or passed.phase == "push" != after.phase:
            tracker.release(tracker.held, hand.T_world_ee)
        elif passed.phase in ("open", "turn"):
            self._scene.altered.add(passed.anchor.place)
            if passed.phase == "open" and plan.sub_task(passed).operation != "close":
                tracker.cover()

    @property
    def is_pushing(self) -> bool:
        """Whether the hand is on its way through a push."""
        target = self._executor.target
        return target is not None and target.key_pose.phase == "push"

    def is_left_behind(self, plan: Plan, name: str, hand: Hand) -> bool:
        """Whether an object that turned out to be elsewhere than in the hand does not go along with it."""
        target = self._executor.target
        if target is None or target.key_pose.phase != "push":
            return True
        if target.push is None:
            return self._outrun_by(plan, name, hand) > OUTRUN_M
        return target.push.target != name or self._beyond(target, target.push, hand) > LEFT_BEHIND_M

    def _beyond(self, target: Target, push: PushWays, hand: Hand) -> float:
        """Metres by which the hand has gone beyond where it meets what it pushes."""
        place = self._scene.tracker.poses(hand.T_world_ee)[push.target][:3, 3]
        return push.beyond(hand.T_world_ee, target.T_world_ee, place)

    def _outrun_by(self, plan: Plan, name: str, hand: Hand) -> float:
        """Metres by which the hand has gone further than an object and away from it since the push began."""
        targets, first = self._executor.plan, self._executor.index
        while first > 0 and targets[first - 1].key_pose.phase == "push":
            first -= 1
        began = targets[first - 1].T_world_ee if first > 0 else plan.T_world_ee
        place = self._scene.tracker.poses(hand.T_world_ee)[name][:3, 3]
        was, start, here = plan.object_poses[name][:3, 3], began[:3, 3], hand.T_world_ee[:3, 3]
        further = _beside(here, start) - _beside(place, was)
        # On its way to the object the hand has not outrun it, however far that is.
        return min(further, _beside(here, place) - _beside(start, was))


def _beside(a: Array, b: Array) -> float:
    """Horizontal distance of two points, metres."""
    return float(np.linalg.norm(a[:2] - b[:2]))
