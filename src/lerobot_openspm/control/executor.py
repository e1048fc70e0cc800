"""Follows one plan in one environment: which key pose is next, and what to do until the hand is there."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lerobot_openspm.control.reasons import why_given_up
from lerobot_openspm.control.state import EpisodeState, Status
from lerobot_openspm.control.strategies import LIFT_STEPS, STRATEGIES, Approach
from lerobot_openspm.control.transfer import Target
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.flow.condition import Query, progress
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import CONTACT_PHASES, PHASES
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.types import Execution, Hand

logger = logging.getLogger(__name__)

# Corrections per key pose, and attempts beyond the first in a part of the instruction.
MAX_CORRECTIONS, MAX_ATTEMPTS = 8, 3
# A hand that is so far from where it takes hold of something can come down to it, metres.
CLEAR_M = 0.04
# An opening below this share of the demonstrated one, or this much less, metres, means that the fingers hold
# nothing, or something else.
HELD_SHARE, OTHER_OPENING_M = 0.4, 0.012
# Where the demonstration's fingers stood further apart than this share of open, they held something.
HOLDING_SHARE = 0.03
# A hand that more corrections than so many brought no closer is kept off. What is carried is held up from
# below where the hand is so far above its place, from and to, at most so far beside it, metres, and turned
# by at most so much, radians.
BLOCKED_CORRECTIONS = 3
RISEN_M, DROP_M, BESIDE_M, LEANING_RAD = 0.012, 0.06, 0.02, 0.3
# A handle that has come along for less than this share of its way was not in the fingers.
LEAST_TRAVEL = 0.05


class Executor:
    """Follows one plan in one environment.

    Attributes:
        state: What is being done; the controller's.
        strategy: How key poses are followed.
        targets: The key poses in the scene; of the present one, the target as it is approached.
        approach: The way to the present key pose.
    """

    def __init__(self, execution: Execution, robot: RobotModel, state: EpisodeState):
        self._robot, self.state = robot, state
        self.strategy = STRATEGIES[execution](robot)
        self.targets: tuple[Target, ...] = ()
        self.approach = Approach(np.eye(4))
        self._believed = np.eye(4)  # where the hand should be, by the actions given out so far
        self._queue: deque[Array] = deque()

    # The plan.

    def begin(self, targets: Sequence[Target], hand: Hand, index: int = 0) -> None:
        """Start following key poses, or better versions of the same ones, from one on."""
        self.targets = tuple(targets)
        self.state.go(Status.RUNNING)
        self._believed = hand.T_world_ee
        self._enter(index, hand)

    def change(self, targets: Sequence[Target]) -> None:
        """Follow better versions of the same key poses from here on."""
        present = self.present
        self.targets = tuple(targets)
        # A drawer or a knob goes on from where the hand took hold of it.
        self._approach_target(present if present.axis is not None else self.present)
        self._queue.clear()

    def stop(self, status: Status) -> None:
        """Hold still for a reason; what is left of the chunk is dropped."""
        self.state.go(status)
        self._queue.clear()

    @property
    def target(self) -> Target | None:
        """The key pose that is being approached, or None."""
        is_approached = self.state.status in (Status.RUNNING, Status.PAUSED)
        return self.present if is_approached else None

    @property
    def present(self) -> Target:
        """The present key pose, be it approached or not."""
        return self.targets[self.state.index]

    def _here(self, hand: Hand) -> Array:
        """Where the hand is taken to be, ``T_world_ee`` ``(4, 4)``."""
        return hand.T_world_ee if self.strategy.measures else self._believed

    def _enter(self, index: int, hand: Hand) -> None:
        """Turn to a key pose."""
        if index > 0:
            self._believed = self.targets[index - 1].T_world_ee
        self.state.index, start = index, self._here(hand)
        target = self.targets[index]
        if target.axis is not None:
            # What slides or turns does so from where the hand took hold of it, be that a little off.
            target = replace(target, T_world_ee=target.axis.follow(start))
        before = self.targets[index - 1].key_pose.phase if index and self.strategy.feels_fingers else ""
        is_lifting = before == "grasp" and target.key_pose.phase in ("lift", "pre-place")
        last = self.approach
        self.approach = Approach(start, before=last.before, lifted=0 if is_lifting else last.lifted_so_far)
        self._approach_target(target)
        self._queue.clear()

    def _approach_target(self, target: Target) -> None:
        """Approach a target at the present index, from where the way began."""
        index, approach = self.state.index, self.approach
        self.targets = (*self.targets[:index], target, *self.targets[index + 1 :])
        approach.nominal_steps = target.key_pose.n_steps
        if not target.key_pose.dwell:
            steps = se3.distance(approach.start, target.T_world_ee) / self._robot.metres_per_step
            approach.nominal_steps = max(approach.nominal_steps, int(np.ceil(steps)))
            approach.nominal_steps += (LIFT_STEPS - approach.lifted) // 2

    # Following it.

    def advance(self, hand: Hand) -> bool:
        """Look at the hand and move on to the next key pose where one is reached.

        Returns:
            True when the objects have to be found again: a grasp missed, a held object was lost, or a key
            pose could not be met, and an attempt is left.
        """
        while self.state.status is Status.RUNNING:
            if self.has_lost_grip(hand):
                return self.try_again("the fingers hold nothing")
            approach = self.approach
            if (axis := self.present.axis) is not None:
                approach.travelled = max(approach.travelled, axis.travel(approach.start, hand.T_world_ee))
            if not self._is_met(hand):
                return self._is_given_up(hand)
            self._go_on(hand)
        return False

    def _go_on(self, hand: Hand) -> None:
        """Turn to the next key pose; after the last one all is done."""
        if self.state.index + 1 == len(self.targets):
            self.stop(Status.DONE)
        else:
            self._enter(self.state.index + 1, hand)

    def _is_met(self, hand: Hand) -> bool:
        if self.present.key_pose.dwell:
            return self.approach.is_time_up
        return self.strategy.is_met(self.present, self.approach, hand)

    def _is_given_up(self, hand: Hand) -> bool:
        """Whether the present key pose is tried again because its corrections are used up."""
        approach = self.approach
        is_used_up = approach.corrections > MAX_CORRECTIONS
        is_passed_by = not (self.present.precise or self.present.until_stopped)
        if is_passed_by and (is_used_up or approach.is_blocked):
            # A hand that is held up short of a key pose it only passes by goes on to the next one.
            self._go_on(hand)
            return False
        if self._is_held_up_from_below(hand):
            logger.info("letting go here: what is carried is held up from below")
            self._go_on(hand)
            self._approach_target(replace(self.present, T_world_ee=hand.T_world_ee))
            return False
        is_kept_off = approach.is_blocked and approach.corrections > BLOCKED_CORRECTIONS
        if not (is_used_up or (is_kept_off and self.was_kept_from_grasping(hand))):
            return False
        m, rad = se3.distances(hand.T_world_ee, self.present.T_world_ee)
        return self.try_again(f"it stays {1000 * m:.1f} mm and {rad:.3f} rad away")

    def _is_held_up_from_below(self, hand: Hand) -> bool:
        """Whether what the hand carries to its place does not get lower, a little above that place."""
        approach, present = self.approach, self.present
        if present.key_pose.phase != "place" or not approach.is_blocked or self.has_lost_grip(hand):
            return False
        if approach.corrections <= BLOCKED_CORRECTIONS or self.state.index + 1 == len(self.targets):
            return False
        if float(se3.distances(hand.T_world_ee, present.T_world_ee)[1]) > LEANING_RAD:
            return False
        above = hand.T_world_ee[:3, 3] - present.T_world_ee[:3, 3]
        is_letting_go = self.targets[self.state.index + 1].key_pose.phase == "release"
        return is_letting_go and bool(RISEN_M < above[2] < DROP_M and np.hypot(*above[:2]) < BESIDE_M)

    def next_action(self, hand: Hand) -> Array | None:
        """The next canonical action ``(7,)``, or None when a chunk is needed (:meth:`query`)."""
        if self.state.status is not Status.RUNNING:
            self.approach.before = None
            return self.hold()
        target, approach = self.present, self.approach
        if target.key_pose.dwell:
            action = self.strategy.grip(target, self._here(hand))
        elif self._queue:
            action = self.strategy.from_chunk(self._queue.popleft(), target, approach, hand)
        elif (action := self.strategy.direct(target, approach, hand)) is None:
            return None
        approach.steps += 1
        approach.before = hand.T_world_ee
        self._believed = self._robot.moved(self._believed, action)
        return action

    def hold(self) -> Array:
        """The action that stays where it is, fingers as they are."""
        closed = self.present.key_pose.closed if self.targets else False
        return np.array([0.0] * 6 + [self._robot.command(closed)])

    def query(self, hand: Hand) -> Query:
        """The condition of the next chunk, which is counted."""
        target, here = self.present, self._here(hand)
        self.state.replans += 1
        return Query(
            T_world_ee=here,
            T_world_target=target.T_world_ee,
            progress=progress(self.approach.start, here, target.T_world_ee),
            closed=np.asarray(float(target.key_pose.closed)),
            opening=np.asarray(hand.opening / max(self._robot.open_width, 1e-9)),
            phase=np.asarray(PHASES.index(target.key_pose.phase)),
        )

    def push_chunk(self, actions: Array) -> None:
        """Queue a chunk of canonical actions ``(H, 7)``; non-finite numbers never reach the robot.

        The fingers do what the key pose says; the flow model's last number only says it less surely.
        """
        if not np.isfinite(actions).all():
            raise OpenSPMError(
                f"the flow model gave actions that are not finite: {actions}; its weights are "
                "damaged, train again"
            )
        fingers = self._robot.command(self.present.key_pose.closed)
        self._queue.extend(np.append(action[:6], fingers) for action in actions)

    # Contact.

    def has_lost_grip(self, hand: Hand) -> bool:
        """Whether the fingers closed further than the demonstration's did around the object."""
        felt = self._felt_opening()
        return felt is not None and hand.opening < max(HELD_SHARE * felt, felt - OTHER_OPENING_M)

    def feels_grip(self, hand: Hand) -> bool:
        """Whether the fingers are as far apart as the demonstration's were around the object."""
        return self._felt_opening() is not None and not self.has_lost_grip(hand)

    def _felt_opening(self) -> float | None:
        """How far apart the demonstration's fingers were around what is held now, metres.

        None where nothing is, or where it is too thin to be felt.
        """
        if not self.strategy.feels_fingers or self.state.index == 0:
            return None
        before, now = self.targets[self.state.index - 1].key_pose, self.present.key_pose
        passed = [one.key_pose for one in self.targets[: self.state.index]]
        grasped = next((p for p in reversed(passed) if p.phase in ("grasp", "release", "push")), None)
        is_closed = before.closed and now.closed and now.phase != "push"
        if not is_closed or grasped is None or grasped.phase != "grasp":  # an empty hand, closed to push
            return None
        return None if grasped.opening < HOLDING_SHARE * self._robot.open_width else grasped.opening

    def was_kept_from_grasping(self, hand: Hand) -> bool:
        """Whether the present key pose leads to a grasp and the hand does not get there."""
        present = self.present.key_pose
        ahead = (one.key_pose for one in self.targets[self.state.index :])
        is_to_grasp = any(one.phase == "grasp" and one.sub_task == present.sub_task for one in ahead)
        return is_to_grasp and present.phase == "approach" and not self.has_lost_grip(hand)

    def pushed_aside(self, hand: Hand) -> float:
        """How far the hand is from the present key pose along its y axis, metres; the fingers open so."""
        return float((se3.inverse(self.present.T_world_ee) @ hand.T_world_ee)[1, 3])

    def followed_sub_tasks(self) -> set[int]:
        """The sub-tasks whose drawer or knob went all the way, once the plan is done.

        The hand met the end of the way, and fingers that can feel the handle would have noticed its loss.
        """
        ends = [i for i, one in enumerate(self.targets) if one.axis and self.strategy.feels_fingers]
        return {self.targets[i].key_pose.sub_task for i in ends if self.feels_handle(i)}

    def feels_handle(self, index: int) -> bool:
        """Whether the fingers hold something before a key pose, so that a loss would show in the opening."""
        held = HOLDING_SHARE * self._robot.open_width
        return index > 0 and self.targets[index - 1].key_pose.opening >= held

    # Trying again.

    def try_again(self, why: str) -> bool:
        """Count another attempt at the present part; without one left there is no progress."""
        key_pose, is_at_end = self.present.key_pose, self.state.status is Status.DONE
        phase = "close" if self.present.until_stopped else key_pose.phase
        if self.state.attempts == MAX_ATTEMPTS:
            self.stop(Status.NO_PROGRESS)
            entry = self.state.plan.entry
            self.state.refusal = why if is_at_end else why_given_up(phase, key_pose, entry, why)
            logger.info("giving up at key pose %d: %s", self.state.index, self.state.refusal)
            return False
        self.state.attempts += 1
        logger.info("trying key pose %d (%s) again: %s", self.state.index, phase, why)
        return True

    def way_index(self, hand: Hand) -> int:
        """Where the way to the present key pose begins, at its anchor and after the last contact."""
        if self.present.key_pose.phase == "approach":
            return self.contact_index(hand)
        index, place = self.state.index, self.present.key_pose.anchor.place
        while index > 0:
            before = self.targets[index - 1].key_pose
            if before.anchor.place != place or (before.phase in CONTACT_PHASES and before.phase != "place"):
                break
            index -= 1
        return index

    def contact_index(self, hand: Hand) -> int:
        """The key pose of the approach that the present one depends on from which it is taken up again.

        That is the first one; of the approach to a grasp the one that is nearest to the hand, of those that
        leave the hand room to come down from.
        """
        contact = self.state.index
        while contact > 0 and self.targets[contact].key_pose.phase != "approach":
            contact -= 1
        first = contact
        while first > 0 and self.targets[first - 1].key_pose.phase == "approach":
            first -= 1
        grasp = self.targets[min(contact + 1, len(self.targets) - 1)]
        if grasp.key_pose.phase != "grasp":
            return first

        def apart(i: int, T: Array) -> float:
            return float(se3.distances(self.targets[i].T_world_ee, T)[0])

        clear = [i for i in range(first, contact + 1) if apart(i, grasp.T_world_ee) > CLEAR_M]
        return min(clear, key=lambda i: apart(i, hand.T_world_ee), default=first)

    def note_travel(self, hand: Hand) -> None:
        """Take in how far a drawer or a knob has moved that has to be taken hold of again."""
        key_pose, gone = self.present.key_pose, self.state.gone
        shown = key_pose.axis  # the whole way, of which the target's own axis is what is left
        if shown is None or not self.feels_handle(self.state.index):
            return
        so_far, further = gone.get(key_pose.sub_task, 0.0), max(self.approach.travelled, 0.0)
        # Fingers that close on nothing where a handle slipped out: it went back when they let go.
        is_empty = self.has_lost_grip(hand) and further < LEAST_TRAVEL * shown.amount
        # At the end of its way too little would be left to feel whether it is held.
        furthest = (1 - LEAST_TRAVEL) * shown.amount
        gone[key_pose.sub_task] = 0.5 * so_far if is_empty else min(so_far + further, furthest)
