"""The state of one environment: which key pose is next, and what to do until the hand is there."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np

from lerobot_openspm.control.transfer import Target
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.flow.condition import Query, progress
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.memory.robot import RobotModel

logger = logging.getLogger(__name__)

Execution = Literal["open_loop", "closed_loop", "closed_loop_trc"]

# Phases that end with the hand on an object.
CONTACTS = ("grasp", "release", "push", "open", "turn")
# An opening below this share of the demonstrated one means that the fingers hold nothing.
HELD_SHARE = 0.4
# Where the demonstration's fingers stood further apart than this share of open, they held something.
HOLDING_SHARE = 0.03
# A correction that leaves this share of the residual has met something solid ...
STUCK_SHARE = 0.9
# ... and the key pose counts as met within this multiple of the tolerance: what is touched is in the way.
BLOCKED_SHARE = 3.0
# Each step of a correction makes good this share of the residual, and this many steps are one correction.
# Every further one pushes harder by as much: friction holds a hand that asks for millimetres.
CORRECTION_SHARE, CORRECTION_STEPS = 0.2, 5


class Status(StrEnum):
    """What one environment's execution is up to. Only the world causes these; bad input raises."""

    WAITING = "waiting"  # no plan yet
    RUNNING = "running"
    DONE = "done"  # every key pose was reached; the hand holds still
    OBJECT_NOT_FOUND = "object_not_found"
    INFEASIBLE = "infeasible"  # no entry passes the transfer checks here
    NO_PROGRESS = "no_progress"  # retries are used up
    OBJECT_LOST = "object_lost"  # what is needed now was seen before and is gone; looked for until it is back
    NOT_UNDERSTOOD = "not_understood"  # nothing in the memory is about the instruction
    CAMERA_FAULT = "camera_fault"  # a camera gave no sound picture for too long


@dataclass(frozen=True)
class ControlSettings:
    """How key poses are followed.

    Attributes:
        execution: ``open_loop`` plans every chunk from where the hand should be; ``closed_loop`` from where
            it is; ``closed_loop_trc`` adds terminal residual correction.
        residual_m: The paper's epsilon_r: a precise key pose is met within this distance ...
        residual_rad: ... and this angle.
        passing_m: A key pose that is only passed by is met within this distance ...
        passing_rad: ... and this angle.
        max_corrections: Corrections of five steps per key pose.
        max_attempts: How often a grasp that missed, or a key pose that was not met, is tried again.
    """

    execution: Execution = "closed_loop_trc"
    residual_m: float = 0.004
    residual_rad: float = 0.06
    passing_m: float = 0.015
    passing_rad: float = 0.15
    max_corrections: int = 8
    max_attempts: int = 3


@dataclass(frozen=True)
class Hand:
    """What proprioception says: pose ``T_world_ee`` ``(4, 4)``, and opening in the state's units."""

    T_world_ee: Array
    opening: float


class Executor:
    """Follows one plan in one environment. Holds everything that must be forgotten at a reset."""

    def __init__(self, settings: ControlSettings, robot: RobotModel):
        self._settings, self._robot = settings, robot
        self.status = Status.WAITING
        self.plan: tuple[Target, ...] = ()
        self.index = 0
        self.attempts = 0
        self.corrections = 0
        self.travelled = 0.0  # how far a drawer or a knob has followed the hand, metres or radians
        self.replans = 0  # chunks asked for so far; seeds the noise of each
        self._steps = 0
        self._late_steps = 0
        self._left = np.inf  # distance from the key pose at the last correction
        self._blocked = False  # whether that correction brought the hand no closer
        self._start = np.eye(4)
        self._believed = np.eye(4)  # open loop: where the hand should be
        self._queue: deque[Array] = deque()

    def begin(self, plan: Sequence[Target], hand: Hand, index: int = 0) -> None:
        """Start following a plan, or a better version of the same one, from a key pose on."""
        self.plan, self.status = tuple(plan), Status.RUNNING
        self._believed = hand.T_world_ee
        self._enter(index, hand)

    def change(self, plan: Sequence[Target]) -> None:
        """Follow a better version of the same plan from here on."""
        present = self.plan[self.index]
        self.plan = tuple(plan)
        if present.axis is not None:  # it goes on from where the hand took hold
            self._replace_target(present)
        self._queue.clear()

    def finish_part(self) -> None:
        """Wait for the plan of the next part, which gets attempts of its own."""
        self.stop(Status.WAITING)
        self.attempts = 0

    @property
    def target(self) -> Target | None:
        """The key pose that is being approached, or None."""
        return self.plan[self.index] if self.status is Status.RUNNING else None

    def advance(self, hand: Hand) -> bool:
        """Look at the hand and move on to the next key pose where one is reached.

        Returns:
            True when the objects have to be found again: a grasp missed, a held object was lost, or a key
            pose could not be met, and an attempt is left.
        """
        while self.status is Status.RUNNING:
            if self.has_lost_grip(hand):
                return self.try_again("the fingers hold nothing")
            if (axis := self.plan[self.index].axis) is not None:
                self.travelled = max(self.travelled, axis.travel(self._start, hand.T_world_ee))
            if not self._finished(hand):
                break
            if self.index + 1 == len(self.plan):
                self.status = Status.DONE
                self._queue.clear()
            else:
                self._enter(self.index + 1, hand)
        given_up = self.corrections > self._settings.max_corrections
        passing = not self.plan[self.index].precise and self.index + 1 < len(self.plan)
        if self.status is Status.RUNNING and passing and (given_up or self._blocked):
            # A hand that is held up short of a key pose it only passes by goes on to the next one.
            self._enter(self.index + 1, hand)
        elif self.status is Status.RUNNING and given_up:
            metres, radians = se3.distances(hand.T_world_ee, self.plan[self.index].T_world_ee)
            return self.try_again(f"it stays {1000 * metres:.1f} mm and {radians:.3f} rad away")
        return False

    def next_action(self, hand: Hand) -> Array | None:
        """The next canonical action ``(7,)``, or None when a chunk is needed (:meth:`query`)."""
        if self.status is not Status.RUNNING:
            return self.hold()
        if self.plan[self.index].key_pose.dwell:
            action = self._toward(hand)
        elif self._queue:
            action = self._queue.popleft()
            is_corrected = self._settings.execution == "closed_loop_trc"
            if is_corrected and self.plan[self.index].key_pose.phase == "push":
                action = self._kept_on_way(action, hand)
        elif self._settings.execution == "closed_loop_trc" and self._steps >= self._nominal_steps():
            action = self._correct(hand)
        else:
            return None
        self._steps += 1
        if self._settings.execution == "open_loop":
            self._believed = se3.apply_increment(self._believed, action[:6] * self._gains())
        return action

    def hold(self) -> Array:
        """The action that stays where it is, fingers as they are."""
        closed = self.plan[self.index].key_pose.closed if self.plan else False
        return np.array([0.0] * 6 + [self._robot.command(closed)])

    def _correct(self, hand: Hand) -> Array:
        """Terminal residual correction: make good what the flow model has left of the way to the key pose.

        The correction is the residual itself, so that the error contracts whatever the model has learned.
        """
        if self._late_steps % CORRECTION_STEPS == 0:
            self.corrections += 1
            left = _distance(hand, self.plan[self.index])
            self._blocked = left > STUCK_SHARE * self._left
            self._left = left
        self._late_steps += 1
        return self._toward(hand, min(1.0, CORRECTION_SHARE * self.corrections))

    def _toward(self, hand: Hand, share: float = CORRECTION_SHARE) -> Array:
        """An action straight towards the key pose, and the fingers as it says.

        A hand that waits for its fingers is kept there by it: nothing in the flow model's condition says how
        far a grasp has come, and drifting a centimetre under closing fingers loses it.
        """
        target, gains = self.plan[self.index], self._gains()
        residual = se3.increment(self._here(hand), target.T_world_ee)
        motion: Array = np.where(gains > 0, share * residual / np.maximum(gains, 1e-9), 0.0)
        motion = motion / max(1.0, float(np.abs(motion).max()))
        return np.append(motion, self._robot.command(target.key_pose.closed))

    def _kept_on_way(self, action: Array, hand: Hand) -> Array:
        """An action whose motion across the straight way to the key pose leads back to it.

        Nothing holds what is pushed: a hand that strays by millimetres slips over or past it.
        """
        here, target = self._here(hand)[:3, 3], self.plan[self.index].T_world_ee[:3, 3]
        way = target - self._start[:3, 3]
        length = float(np.linalg.norm(way))
        if length < 1e-9 or self._robot.metres_per_action <= 0:
            return action
        way = way / length
        left = target - here
        across = left - (left @ way) * way
        back = CORRECTION_SHARE * across / self._robot.metres_per_action
        motion = (action[:3] @ way) * way + back
        return np.concatenate([motion / max(1.0, float(np.abs(motion).max())), action[3:]])

    def _gains(self) -> Array:
        """How far the hand moves per unit of each of the six numbers of an action."""
        return np.array([self._robot.metres_per_action] * 3 + [self._robot.radians_per_action] * 3)

    def _here(self, hand: Hand) -> Array:
        """Where the hand is taken to be."""
        return self._believed if self._settings.execution == "open_loop" else hand.T_world_ee

    def query(self, hand: Hand) -> Query:
        """The condition of the next chunk, which is counted."""
        target = self.plan[self.index]
        self.replans += 1
        here = self._here(hand)
        return Query(
            T_world_ee=here,
            T_world_target=target.T_world_ee,
            progress=progress(self._start, here, target.T_world_ee),
            closed=np.asarray(float(target.key_pose.closed)),
            opening=np.asarray(hand.opening / max(self._robot.open_width, 1e-9)),
            phase=np.asarray(PHASES.index(target.key_pose.phase)),
        )

    def push_chunk(self, actions: Array) -> None:
        """Queue a chunk of canonical actions ``(H, 7)``; non-finite numbers never reach the robot."""
        if not np.isfinite(actions).all():
            raise OpenSPMError(
                f"the flow model gave actions that are not finite: {actions}; its weights are "
                "damaged, train again"
            )
        self._queue.extend(actions)

    def _enter(self, index: int, hand: Hand) -> None:
        if self._settings.execution == "open_loop" and index > 0:
            self._believed = self.plan[index - 1].T_world_ee
        self._start = self._here(hand)
        self.index, self._steps, self._late_steps, self.corrections = index, 0, 0, 0
        self._left, self._blocked = np.inf, False
        self.travelled = 0.0
        self._queue.clear()
        target = self.plan[index]
        if target.axis is not None:
            # What slides or turns does so from where the hand took hold of it, be that a little off.
            self._replace_target(replace(target, T_world_ee=target.axis.follow(self._start)))

    def _replace_target(self, target: Target) -> None:
        self.plan = (*self.plan[: self.index], target, *self.plan[self.index + 1 :])

    def _nominal_steps(self) -> int:
        """How long the way to the key pose should take, by the demonstration and by its length here."""
        target = self.plan[self.index]
        if target.key_pose.dwell:
            return target.key_pose.n_steps
        length = float(se3.distance(self._start, target.T_world_ee))
        return max(target.key_pose.n_steps, int(np.ceil(length / self._robot.metres_per_step)))

    def _finished(self, hand: Hand) -> bool:
        target, settings = self.plan[self.index], self._settings
        time_is_up = self._steps >= self._nominal_steps()
        if target.key_pose.dwell or settings.execution == "open_loop":
            return time_is_up
        if settings.execution == "closed_loop" and time_is_up:
            return True
        metres, radians = se3.distances(hand.T_world_ee, target.T_world_ee)
        if target.precise:
            share = max(float(metres) / settings.residual_m, float(radians) / settings.residual_rad)
            return share <= 1 or (self._blocked and share <= BLOCKED_SHARE)
        return bool(metres <= settings.passing_m and radians <= settings.passing_rad)

    def has_lost_grip(self, hand: Hand) -> bool:
        """Whether the fingers closed further than the demonstration's did around the object."""
        if self._settings.execution != "closed_loop_trc" or self.index == 0:
            return False
        before, now = self.plan[self.index - 1].key_pose, self.plan[self.index].key_pose
        passed = [one.key_pose for one in self.plan[: self.index]]
        grasped = next((p for p in reversed(passed) if p.phase in ("grasp", "release", "push")), None)
        if not (before.closed and now.closed) or now.phase == "push":
            return False
        if grasped is None or grasped.phase != "grasp":  # an empty hand, closed to push
            return False
        if grasped.opening < HOLDING_SHARE * self._robot.open_width:
            return False
        return hand.opening < HELD_SHARE * grasped.opening

    def followed_sub_tasks(self) -> set[int]:
        """The sub-tasks whose drawer or knob went all the way, once the plan is done.

        The hand met the end of the way, and fingers that lose a handle are noticed. So where the fingers can
        feel the handle, it came along. Only ``closed_loop_trc`` checks either.
        """
        if self._settings.execution != "closed_loop_trc":
            return set()
        ends = [i for i, target in enumerate(self.plan) if target.axis is not None]
        return {self.plan[i].key_pose.sub_task for i in ends if self.feels_handle(i)}

    def feels_handle(self, index: int) -> bool:
        """Whether the fingers hold something before a key pose, so that a loss would show in the opening."""
        held = self._robot.open_width * HOLDING_SHARE
        return index > 0 and self.plan[index - 1].key_pose.opening >= held

    def try_again(self, why: str) -> bool:
        """Count another attempt at the present key pose; without one left there is no progress."""
        self.attempts += 1
        phase = self.plan[self.index].key_pose.phase
        if self.attempts > self._settings.max_attempts:
            self.status = Status.NO_PROGRESS
            self._queue.clear()
            logger.info("giving up at key pose %d (%s): %s", self.index, phase, why)
            return False
        logger.info("trying key pose %d (%s) again: %s", self.index, phase, why)
        return True

    def stop(self, status: Status) -> None:
        """Hold still for a reason."""
        self.status = status
        self._queue.clear()

    def entry_index(self) -> int:
        """The first key pose of the way to the present one, at the same anchor and after the last contact."""
        index, place = self.index, self.plan[self.index].key_pose.anchor.place
        while index > 0:
            before = self.plan[index - 1].key_pose
            if before.anchor.place != place or before.phase in CONTACTS:
                break
            index -= 1
        return index

    def retry_index(self) -> int:
        """The first key pose of the approach that the present one depends on."""
        index = self.index
        while index > 0 and self.plan[index].key_pose.phase != "approach":
            index -= 1
        while index > 0 and self.plan[index - 1].key_pose.phase == "approach":
            index -= 1
        return index


def _distance(hand: Hand, target: Target) -> float:
    return float(se3.distance(hand.T_world_ee, target.T_world_ee))
