"""Three ways to follow key poses: open loop, closed loop, and closed loop with residual correction."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.control.joint_room import way_to_turn_back
from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import CONSTRAINED_PHASES
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.types import Execution, Hand

logger = logging.getLogger(__name__)

# The numbers here were set by hand on the tabletop, and serve LIBERO as well.
# The paper's epsilon_r: a precise key pose is met within this distance and angle.
RESIDUAL_M, RESIDUAL_RAD = 0.004, 0.06
# Where a correction leaves more than this share of the residual, something solid is in the hand's way.
STUCK_SHARE = 0.9
# A hand that gets no closer but has moved by more than this swings, metres with radians weighed in.
SWINGS_M = 0.003
# A blocked key pose is met within this multiple of the tolerance, because what is touched is in the way.
BLOCKED_SHARE = 3.0
# What stops a closing hand this near to where it goes is shut; what stops it earlier is in the way, metres.
SHUT_LEFT_M = 0.05
# Each step of a correction makes good twice this share of the residual, and five steps are one correction.
# Every further one adds the share once more, because friction stops a hand that asks for millimetres.
CORRECTION_SHARE, CORRECTION_STEPS = 0.2, 5
# Near a key pose a straight way makes good this share of what is left in every step.
ARRIVING_SHARE = 0.5
# This share of a motion that was not meant is countered. From 1 on an arm without lag would swing.
LEAD = 0.5
# An elbow that is turned over turns back within so many steps of a push outwards.
OUTWARD_STEPS = 14
# A lift comes up to speed within so many steps: a jerk pulls what is held by its rim out of the fingers.
LIFT_STEPS = 16


@dataclass
class Approach:
    """The way to one key pose.

    Attributes:
        start: The hand's pose ``T_world_ee`` ``(4, 4)`` where the way begins.
        nominal_steps: How long the way should take, by the demonstration and by its length here.
        steps: Control steps taken so far.
        corrections: Corrections begun so far.
        late_steps: Steps of corrections taken so far.
        left: Distance from the key pose at the last correction, metres with radians weighed in.
        corrected_at: Where the hand was then, ``T_world_ee`` ``(4, 4)``.
        is_blocked: Whether that correction brought the hand no closer, and it stands still.
        outward: Unit vector ``(3,)`` of the push outwards for an elbow that is turned over, while it lasts.
        outward_steps: Steps of it taken so far.
        before: Where the hand was a step ago, ``T_world_ee`` ``(4, 4)``; None after it held still.
        travelled: How far a drawer or a knob has followed the hand, metres or radians.
        lifted: Steps that the hand was on its way with what it has just taken hold of as this way began.
    """

    start: Array
    nominal_steps: int = 0
    steps: int = 0
    corrections: int = 0
    late_steps: int = 0
    left: float = np.inf
    corrected_at: Array | None = None
    is_blocked: bool = False
    outward: Array | None = None
    outward_steps: int = 0
    before: Array | None = None
    travelled: float = 0.0
    lifted: int = LIFT_STEPS

    @property
    def lifted_so_far(self) -> int:
        """The steps by now that :attr:`lifted` counts; from LIFT_STEPS on they make no difference."""
        return min(self.lifted + self.steps, LIFT_STEPS)

    @property
    def speed(self) -> float:
        """The share of its speed that the hand goes at: a lift comes up to it slowly."""
        return min(1.0, (self.lifted_so_far + 1) / LIFT_STEPS)

    @property
    def is_time_up(self) -> bool:
        """Whether the way took as long as it should."""
        return self.steps >= self.nominal_steps


class ClosedLoop:
    """Every chunk is planned from where the hand is; a key pose is met when it is near or its time is up."""

    measures = True  # whether the hand and the scene are looked at once there is a plan
    feels_fingers = False  # whether a grip that was lost is noticed, and a lift begins slowly

    def __init__(self, robot: RobotModel):
        self._robot = robot

    def is_met(self, target: Target, approach: Approach, hand: Hand) -> bool:
        """Whether a key pose in motion is met."""
        return approach.is_time_up or self._is_near(target, approach, hand)

    def from_chunk(self, action: Array, target: Target, approach: Approach, hand: Hand) -> Array:
        """The action ``(7,)`` that is taken for one of the flow model's."""
        return action

    def direct(self, target: Target, approach: Approach, hand: Hand) -> Array | None:
        """An action ``(7,)`` instead of the next chunk's; None where a chunk is wanted."""
        return None

    def toward(self, target: Target, here: Array, share: float = CORRECTION_SHARE) -> Array:
        """An action ``(7,)`` straight from a hand pose ``(4, 4)`` to the key pose, fingers as it says.

        While the fingers open or close it keeps the hand in place. The flow model's condition does not tell
        how far a grasp has come, and a hand that drifts by a centimetre loses the object.
        """
        return self._action(share * se3.increment(here, target.T_world_ee), target)

    def _action(self, increment: Array, target: Target) -> Array:
        """The action ``(7,)`` that moves the hand by an increment ``(6,)``, or that way as far as it goes."""
        gains = self._robot.gains
        motion: Array = np.where(gains > 0, increment / np.maximum(gains, 1e-9), 0.0)
        motion = motion / max(1.0, float(np.abs(motion).max()))
        return np.append(motion, self._robot.command(target.key_pose.closed))

    def grip(self, target: Target, here: Array) -> Array:
        """An action ``(7,)`` while the fingers open or close.

        Sideways the hand yields to what the fingers meet. Along its approach axis it does not: fingers that
        close on a slope push it back, and off what they hold.
        """
        if not target.key_pose.closed:
            return self.toward(target, here)
        along = here[:3, 2]
        back = float(along @ (here[:3, 3] - target.T_world_ee[:3, 3]))
        firm = here.copy()
        firm[:3, 3] += (1 / CORRECTION_SHARE - 1) * back * along
        return self.toward(target, firm)

    def _is_near(self, target: Target, approach: Approach, hand: Hand) -> bool:
        metres, radians = se3.distances(hand.T_world_ee, target.T_world_ee)
        if target.until_stopped and approach.is_blocked and metres <= SHUT_LEFT_M:
            return True
        if target.precise:
            share = max(float(metres) / RESIDUAL_M, float(radians) / RESIDUAL_RAD)
            return share <= 1 or (approach.is_blocked and share <= BLOCKED_SHARE)
        return bool(metres <= target.passing_m and radians <= target.passing_rad)


class OpenLoop(ClosedLoop):
    """Every chunk is planned from where the hand should be; a key pose is met when its time is up."""

    measures = False

    def is_met(self, target: Target, approach: Approach, hand: Hand) -> bool:
        """Whether the time for a key pose is up."""
        return approach.is_time_up


class ClosedLoopTRC(ClosedLoop):
    """Closed loop with the paper's terminal residual correction, and fingers that notice a lost grip.

    In free space the hand goes straight from key pose to key pose, since mining has cut the demonstrated
    path there at its corners. The flow model is asked for the ways of a push, a drawer and a knob.

    The correction is the residual itself, so that the error contracts whatever the model has learned.
    """

    feels_fingers = True

    def is_met(self, target: Target, approach: Approach, hand: Hand) -> bool:
        """Whether the hand is within the key pose's tolerance."""
        return self._is_near(target, approach, hand)

    def from_chunk(self, action: Array, target: Target, approach: Approach, hand: Hand) -> Array:
        """The flow model's action, kept on the way of a push."""
        if target.key_pose.phase == "push":
            return self._kept_on_way(action, target, approach, hand)
        return action

    def direct(self, target: Target, approach: Approach, hand: Hand) -> Array | None:
        """The next step of a straight way; once its time is up, what makes good what is left of the way."""
        if not approach.is_time_up:
            is_free = target.key_pose.phase not in CONSTRAINED_PHASES
            return self._straight(target, approach, hand) if is_free else None
        if approach.outward is not None:
            return self._push_outward(approach.outward, target, approach, hand)
        if approach.late_steps % CORRECTION_STEPS == 0:
            approach.corrections += 1
            left = float(se3.distance(hand.T_world_ee, target.T_world_ee))
            at = approach.corrected_at
            is_still = at is None or float(se3.distance(hand.T_world_ee, at)) < SWINGS_M
            approach.is_blocked = is_still and left > STUCK_SHARE * approach.left
            approach.left, approach.corrected_at = left, hand.T_world_ee
            if approach.is_blocked and not approach.outward_steps:
                approach.outward = self._way_to_turn_back(target, approach, hand)
            if approach.outward is not None:
                logger.info("the arm is stretched out and does not come in: pushing the hand outwards")
                approach.is_blocked = False
                return self._push_outward(approach.outward, target, approach, hand)
        approach.late_steps += 1
        share = approach.speed * min(1.0, CORRECTION_SHARE * (approach.corrections + 1))
        return self._led(target, approach, hand, share)

    def _straight(self, target: Target, approach: Approach, hand: Hand) -> Array:
        """An action straight to the key pose at the demonstrated pace, slower where it is near."""
        left = max(float(se3.distance(hand.T_world_ee, target.T_world_ee)), 1e-9)
        share = approach.speed * min(ARRIVING_SHARE, self._robot.metres_per_step / left)
        return self._led(target, approach, hand, share)

    def _led(self, target: Target, approach: Approach, hand: Hand, share: float) -> Array:
        """An action straight to the key pose, ahead of an arm that lags.

        An arm goes on for some steps as it was told before, and swings past corners. So what the hand did in
        the last step, and was not meant to, is countered.
        """
        here = hand.T_world_ee
        wanted = share * se3.increment(here, target.T_world_ee)
        moved = wanted if approach.before is None else se3.increment(approach.before, here)
        return self._action(wanted + LEAD * (wanted - moved), target)

    def _way_to_turn_back(self, target: Target, approach: Approach, hand: Hand) -> Array | None:
        """See :func:`way_to_turn_back`; None where the hand is near enough, or moves what it touches."""
        is_moving = target.key_pose.phase in CONSTRAINED_PHASES
        if self._robot.arm is None or is_moving or self.is_met(target, approach, hand):
            return None
        return way_to_turn_back(hand.T_world_ee, target.T_world_ee, self._robot.arm)

    def _push_outward(self, outward: Array, target: Target, approach: Approach, hand: Hand) -> Array:
        """An action along a level unit vector ``(3,)`` and up; after the last one corrections begin anew.

        Up, because the arm straightens that way too, and what is carried keeps clear.
        """
        approach.outward_steps += 1
        if approach.outward_steps == OUTWARD_STEPS:
            approach.outward, approach.left, approach.corrected_at = None, np.inf, None
            approach.corrections = approach.late_steps = 0
        action = self.toward(target, hand.T_world_ee, share=1.0)
        action[:3] = outward / np.abs(outward).max() + [0.0, 0.0, 1.0]
        return action

    def _kept_on_way(self, action: Array, target: Target, approach: Approach, hand: Hand) -> Array:
        """An action whose motion across the straight way to the key pose leads back to that way.

        Nothing holds what is pushed. A hand that strays by millimetres slips over or past it.
        """
        here, end = hand.T_world_ee[:3, 3], target.T_world_ee[:3, 3]
        way = end - approach.start[:3, 3]
        length = float(np.linalg.norm(way))
        if length < 1e-9 or self._robot.metres_per_action <= 0:
            return action
        way = way / length
        left = end - here
        across = left - (left @ way) * way
        back = CORRECTION_SHARE * across / self._robot.metres_per_action
        motion = (action[:3] @ way) * way + back
        return np.concatenate([motion / max(1.0, float(np.abs(motion).max())), action[3:]])


STRATEGIES: dict[Execution, type[ClosedLoop]] = {
    "open_loop": OpenLoop,
    "closed_loop": ClosedLoop,
    "closed_loop_trc": ClosedLoopTRC,
}
