"""Where the objects of one episode are, as far as its pictures tell."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from lerobot_openspm.control.grounding import Grounding
from lerobot_openspm.control.planning_context import PlanningContext
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.tracking.camera_health import Fault
from lerobot_openspm.perception.tracking.tracker import Tracker, TrackStatus
from lerobot_openspm.types import Detections, Hand

# An object that is not found is looked for again after this long; while things go well, all are.
LOOK_AGAIN_S = 0.25
# What looks wrong is looked at again after this long.
SECOND_LOOK_S = 0.15
# Without a sound picture of every camera the hand goes on for so long, then holds still, then gives up.
BLIND_S, GIVE_UP_S = 0.5, 2.0

# Names of objects, poses T_world_obj at which some are expected, seconds since the start -> what is detected.
Detect = Callable[[Sequence[str], Mapping[str, Array], float], Detections]


class SceneState:
    """What one episode knows of its scene. The tracker alone says where an object is.

    Attributes:
        tracker: Follows every object that was looked for.
        grounding: Which of several like objects is meant.
        detections: What the last look brought; None before the first.
        altered: Objects that were opened or turned: they look different now, and stand still.
    """

    def __init__(self, context: PlanningContext):
        self._context = context
        self.tracker = Tracker(context.yaw_periods, context.tracker)
        self.grounding = Grounding()
        self.detections: Detections | None = None
        self.altered: set[str] = set()
        self._step = -1
        # Both at least one step; four looks a second whatever the robot's rate.
        self._look_again_steps = max(1, round(LOOK_AGAIN_S / context.step_s))
        self._second_look_steps = max(1, round(SECOND_LOOK_S / context.step_s))
        self._looked_at_step = -self._look_again_steps

    def predict(self) -> None:
        """Go one control step on."""
        self._step += 1
        self.tracker.predict(self._context.step_s)

    def look(self, names: Sequence[str], hand: Hand, detect: Detect) -> frozenset[str]:
        """Look for objects; the names of those that are somewhere else than before."""
        step_s = self._context.step_s
        waited_s = min(self._waited_steps, self._look_again_steps) * step_s
        expected = {k: T for k, T in self.tracker.poses(hand.T_world_ee).items() if k in names}
        self.detections = detect(names, expected, self._step * step_s)
        self._looked_at_step = self._step
        known = {**self._context.surfaces, **self.tracker.poses(hand.T_world_ee)}
        meant = self.grounding.sort_out(self.detections.estimates, known)
        return self.tracker.look(meant, hand.T_world_ee, waited_s)

    # When to look.

    @property
    def has_just_looked(self) -> bool:
        """Whether the last observation was looked at."""
        return self._looked_at_step == self._step

    @property
    def is_time_for_another_look(self) -> bool:
        """Whether what was not found may be looked for again."""
        return self._waited_steps >= self._look_again_steps

    @property
    def is_time_for_a_second_look(self) -> bool:
        """Whether what looked wrong may be looked at again."""
        return self._waited_steps >= self._second_look_steps

    @property
    def _waited_steps(self) -> int:
        return self._step - self._looked_at_step

    # What was seen.

    @property
    def faults(self) -> Mapping[str, Fault]:
        """Cameras that were no use at the last look."""
        return {} if self.detections is None else self.detections.faults

    @property
    def is_blind(self) -> bool:
        """Whether a camera gave no sound picture for long enough to hold still."""
        return any(fault.seconds >= BLIND_S for fault in self.faults.values())

    def recognised(self) -> set[str]:
        """The objects that the last look recognised."""
        if self.detections is None:
            return set()
        return {name for name in self.detections.estimates if self.tracker.is_seen(name)}

    def lost(self, names: Sequence[str]) -> list[str]:
        """Those of the objects that were seen before and are gone."""
        return [name for name in names if self.tracker.status(name) is TrackStatus.LOST]

    def is_any_stale(self, names: Sequence[str]) -> bool:
        """Whether one of the objects was not seen for a while."""
        return any(self.tracker.status(name) is TrackStatus.STALE for name in names)
