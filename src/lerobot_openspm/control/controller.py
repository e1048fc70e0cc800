"""One episode from instruction to actions: look, retrieve, transfer, follow, look again.

An instruction that no demonstration shows as a whole is carried out part by part: each is planned when it is
reached, from a fresh look, because what the parts before it moved is elsewhere now.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Sequence

import numpy as np

from lerobot_openspm.control.contact import Contact
from lerobot_openspm.control.executor import Executor
from lerobot_openspm.control.outcomes import LOOKS_AT_OUTCOME, PartProgress, expected_outcomes, is_met
from lerobot_openspm.control.planner import Planner
from lerobot_openspm.control.planning_context import PlanningContext
from lerobot_openspm.control.scene import GIVE_UP_S, Detect, SceneState
from lerobot_openspm.control.status import Status
from lerobot_openspm.control.transfer import Target
from lerobot_openspm.errors import InstructionError
from lerobot_openspm.flow.condition import Query
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import Outcome
from lerobot_openspm.types import Hand

logger = logging.getLogger(__name__)

# A handle that has come along for less than this share of its way was not in the fingers.
LEAST_TRAVEL = 0.05


class EpisodeController:
    """State of one environment, and nothing that another environment could see.

    Attributes:
        instruction: What is to be done.
        executor: Follows the plan, and holds the episode's status.
        scene: Where the objects are.
        planner: What is acted by, and where.
        refusal: Why the instruction is not acted on; "" unless the status is NOT_UNDERSTOOD.
    """

    def __init__(self, context: PlanningContext, instruction: str, fingerprint: int, noise_seed: int):
        self._context = context
        self.instruction = instruction
        self.executor = Executor(context.settings, context.robot)
        self.scene = SceneState(context)
        self._contact = Contact(self.executor, self.scene)
        self.planner = Planner(context, self.scene, instruction)
        self.refusal = ""
        self._progress = PartProgress()
        self._earlier_parts_known = True  # whether all parts before the present one were seen to be done
        # Told by what the episode shows first, so that it does not matter in which batch or row it runs.
        self._noise_key = (noise_seed, zlib.crc32(instruction.encode()), fingerprint)

    # What others may ask.

    @property
    def status(self) -> Status:
        """What the episode is up to."""
        return self.executor.status

    @property
    def succeeded(self) -> bool | None:
        """Whether what was to be done is seen to be done; None before the end and where it is not seen."""
        if self.status is Status.NO_PROGRESS:
            return False
        return self._progress.verdict if self.status is Status.DONE and self._earlier_parts_known else None

    # One control step: observe, then act.

    def observe(self, hand: Hand, detect: Detect) -> None:
        """Take in a new observation: plan, advance, look around, go where things are now, try again.

        What is not understood ends this episode alone: the hand holds still from then on, and
        :attr:`refusal` says why.
        """
        self.scene.predict()
        try:
            match self.status:
                case Status.WAITING | Status.OBJECT_NOT_FOUND | Status.INFEASIBLE:
                    if self.scene.is_time_for_another_look:
                        self._plan(hand, detect)
                case Status.RUNNING | Status.PAUSED:
                    self._follow_plan(hand, detect)
                case Status.OBJECT_LOST:
                    if self.scene.is_time_for_a_second_look:
                        self._look_around(hand, detect)
                case Status.DONE:
                    if self._progress.looks_left > 0:
                        self._check_outcomes(hand, detect)
                case Status.NO_PROGRESS | Status.NOT_UNDERSTOOD | Status.CAMERA_FAULT:
                    pass
        except InstructionError as error:
            self.refusal = str(error)
            self.executor.stop(Status.NOT_UNDERSTOOD)
            logger.warning("not acting: %s", error)

    def next_action(self, hand: Hand) -> Array | None:
        """The next canonical action ``(7,)``, or None when a chunk is needed."""
        return self.executor.next_action(hand)

    def query(self, hand: Hand) -> Query:
        """The condition of the next chunk."""
        return self.executor.query(hand)

    def noise(self, shape: tuple[int, ...]) -> Array:
        """Standard normal noise of the next chunk, a function of (seed, episode, chunk) alone."""
        return np.random.default_rng([*self._noise_key, self.executor.replans]).standard_normal(shape)

    def _follow_plan(self, hand: Hand, detect: Detect) -> None:
        """Go on to the next key pose where one is reached; look where it is time to."""
        index = self.executor.index
        is_to_retry = self.status is Status.RUNNING and self.executor.advance(hand)
        self._contact.update(self.planner.plan, index, hand)
        if self.executor.status is Status.DONE:
            self._check_outcomes(hand, detect)
        elif is_to_retry:
            self._try_again(hand, detect)
        elif self._is_time_to_look(index):
            self._look_around(hand, detect)

    # Planning.

    def _plan(self, hand: Hand, detect: Detect) -> None:
        """Plan the part that is to be carried out now, once its objects are found."""
        planner = self.planner
        if not planner.parts:
            planner.read(hand)
        self._look(planner.sought(), hand, detect)
        if self.status is Status.CAMERA_FAULT:
            return
        best = planner.choose(hand)
        if missing := [name for name in best.objects if name not in planner.object_poses]:
            logger.info("%r: cannot find %s", self.instruction, missing)
            self.executor.go(Status.OBJECT_NOT_FOUND)
        elif problems := planner.problems(hand):
            logger.warning("%r: %s", self.instruction, "; ".join(problems))
            self.executor.go(Status.INFEASIBLE)
        else:
            planner.note_use()
            self._begin(0, hand)
            if self._is_tracking:  # else nothing is looked at any more that could end the waiting
                self._wait_for_what_is_needed(hand)

    def _begin(self, index: int, hand: Hand) -> None:
        """Go to a key pose; what is grasped or pushed from there on is not in the hand any more."""
        self.planner.T_world_ee = hand.T_world_ee
        tracker = self.scene.tracker
        tracker.drop(tracker.held & self.planner.plan.regrasped(index), hand.T_world_ee)
        self.executor.begin(self._targets(), hand, index)

    def _targets(self) -> tuple[Target, ...]:
        return self.planner.targets(self._progress.gone, self._progress.repeated)

    # Looking.

    @property
    def _is_tracking(self) -> bool:
        return self._context.tracking and self.executor.strategy.looks_around

    def _is_time_to_look(self, index_before: int) -> bool:
        target, scene = self.executor.target, self.scene
        is_paused = self.status is Status.PAUSED
        if not self._is_tracking or target is None:
            return False
        if target.key_pose.dwell and not is_paused:
            return False  # the fingers hide what they are around
        if scene.faults:
            return True
        if is_paused or scene.tracker.doubtful:
            return scene.is_time_for_a_second_look
        return self.executor.index != index_before or scene.is_time_for_another_look

    def _look(self, names: Sequence[str], hand: Hand, detect: Detect) -> frozenset[str]:
        """Look for objects; the names of those that are somewhere else than before."""
        moved = self.scene.look(names, hand, detect)
        for camera, fault in self.scene.faults.items():
            if fault.seconds >= GIVE_UP_S and self.status is not Status.DONE:
                logger.warning("%r: stopping, camera %r: %s", self.instruction, camera, fault.reason)
                self.executor.stop(Status.CAMERA_FAULT)
        return moved

    def _look_around(self, hand: Hand, detect: Detect) -> None:
        """Look at what the remaining key poses need and what is in the hand; act on what has changed."""
        tracker, plan, untouched = self.scene.tracker, self.planner.plan, self._untouched()
        held = tracker.held
        moved = self._look([*untouched, *(held - set(untouched))], hand, detect)
        if self.status is Status.CAMERA_FAULT:
            return
        dropped = {name for name in moved & held if self._contact.is_left_behind(plan, name, hand)}
        for name in (moved & held) - dropped:  # it goes along from where it is
            tracker.hold(name, hand.T_world_ee)
        if dropped:
            logger.info("%r: dropped: %s", self.instruction, ", ".join(sorted(dropped)))
            # What slips out of the hand is no fault of the plan; a push that loses its object may be.
            if self._contact.is_pushing and not self.executor.try_again("what is pushed was left behind"):
                return
            index = self.executor.retry_index()
            self.planner.update(self.planner.plan.anchors(index, self.scene.altered), hand)
            self._begin(index, hand)
        elif changed := self.planner.update(untouched, hand):
            logger.info("%r: moved: %s", self.instruction, ", ".join(sorted(changed)))
            self._go_along(bool(moved & set(self._now_needed())), hand)
        self._wait_for_what_is_needed(hand)

    def _go_along(self, jumped: bool, hand: Hand) -> None:
        """Go to where the key poses are now; from further off, if what is approached has jumped aside."""
        if jumped and self.executor.target is not None:
            self._begin(self.executor.entry_index(), hand)
        else:
            self.executor.change(self._targets())

    def _wait_for_what_is_needed(self, hand: Hand) -> None:
        """Hold still without sound pictures, and while what the hand is on its way to is not to be seen."""
        needed = self._now_needed()
        if lost := self.scene.lost(needed):
            if self.status is not Status.OBJECT_LOST:
                logger.info("%r: lost: %s", self.instruction, ", ".join(lost))
            self.executor.stop(Status.OBJECT_LOST)
            return
        if self.status is Status.OBJECT_LOST:
            self._begin(self.executor.entry_index(), hand)
        is_paused = self.scene.is_blind or self.scene.is_any_stale(needed)
        self.executor.go(Status.PAUSED if is_paused else Status.RUNNING)

    def _untouched(self) -> list[str]:
        """Objects of the key poses to come that still are where they were seen."""
        plan, index = self.planner.plan, self.executor.index
        touched = plan.touched(self.executor.plan[:index]) | self.scene.tracker.held
        return [name for name in plan.anchors(index, self.scene.altered) if name not in touched]

    def _now_needed(self) -> list[str]:
        """Objects that the present key pose is relative to, unless the hand has touched them."""
        untouched = self._untouched()
        anchor = self.executor.plan[self.executor.index].key_pose.anchor
        return [name for name in anchor.objects if name in untouched]

    # Trying again.

    def _try_again(self, hand: Hand, detect: Detect) -> None:
        """Find the objects of the remaining key poses again and go back to where this contact begins."""
        index = self._retry_index(hand)
        self.planner.T_world_ee = hand.T_world_ee
        if self._context.tracking:
            # What should be in the hand is not, or what was to be met is not there: it may be anywhere.
            attempted = self.executor.plan[index : self.executor.index + 1]
            places = {target.key_pose.anchor.place for target in attempted}
            self.scene.tracker.doubt(places - self.scene.altered, hand.T_world_ee)
            ahead = self.planner.plan.anchors(index, self.scene.altered)
            self._look(ahead, hand, detect)
            self.planner.update(ahead, hand)
        if self.status is Status.RUNNING:
            self._begin(index, hand)

    def _retry_index(self, hand: Hand) -> int:
        """Where to go back to: the approach to what is grasped or, with it in the hand, to its place."""
        executor, gone = self.executor, self._progress.gone
        pose = executor.present.target.key_pose
        shown = pose.axis  # the whole way, of which the target's own axis is what is left
        if shown is not None and executor.feels_handle(executor.index):
            so_far, further = gone.get(pose.sub_task, 0.0), max(executor.present.travelled, 0.0)
            # Fingers that close on nothing where a handle slipped out: it went back when they let go.
            is_empty = executor.has_lost_grip(hand) and further < LEAST_TRAVEL * shown.amount
            # At the end of its way too little would be left to feel whether it is held.
            furthest = (1 - LEAST_TRAVEL) * shown.amount
            gone[pose.sub_task] = 0.5 * so_far if is_empty else min(so_far + further, furthest)
        is_carrying = bool(self.scene.tracker.held) and pose.phase == "place"
        if is_carrying and not executor.has_lost_grip(hand):
            return executor.entry_index()
        return executor.retry_index()

    # The end of a part.

    def _check_outcomes(self, hand: Hand, detect: Detect) -> None:
        """Look whether what was to be done is done: go on if so, else go back to what can mend it."""
        progress = self._progress
        if progress.looks_left < LOOKS_AT_OUTCOME and not self.scene.is_time_for_a_second_look:
            return
        missed = self._missed(hand, detect) if self._is_tracking else ()
        if missed is None and progress.looks_left > 0:
            return
        progress.looks_left = 0
        if missed:
            self._go_back(missed[0], hand)
        elif not self.planner.is_last_part:
            self._begin_next_part(hand, detect)

    def _missed(self, hand: Hand, detect: Detect) -> tuple[Outcome, ...] | None:
        """Look at what was moved: the outcomes that are not met, in order; None where that is not seen."""
        entry, progress = self.planner.plan.entry, self._progress
        expected = expected_outcomes(entry)
        progress.followed |= self.executor.followed_sub_tasks()
        names = dict.fromkeys(name for one in expected for name in one.objects)
        if not names:
            progress.judge(entry, (), ())
            return ()
        progress.looks_left -= 1
        self._look([name for name in names if name not in self.scene.altered], hand, detect)
        poses, recognised = self.scene.tracker.poses(hand.T_world_ee), self.scene.recognised()
        seen = [one for one in expected if one.target in recognised and poses.keys() >= set(one.objects)]
        missed = tuple(one for one in seen if not is_met(one, poses, self._context.yaw_periods))
        if len(seen) < len(expected) and not missed:
            return None
        progress.judge(entry, expected, missed)
        return missed

    def _go_back(self, missed: Outcome, hand: Hand) -> None:
        """Do one sub-task again, from where its target is now, if an attempt is left.

        Those after it are not done again: their handles are not where they were.
        """
        if not self.executor.try_again(f"the {missed.target} is not where it should be"):
            return
        self._progress.look_again(missed.sub_task)
        poses = self.planner.plan.entry.key_poses
        index = next(i for i, pose in enumerate(poses) if pose.sub_task == missed.sub_task)
        self.planner.update(self.planner.plan.anchors(index, self.scene.altered), hand)
        self._begin(index, hand)

    def _begin_next_part(self, hand: Hand, detect: Detect) -> None:
        """Look at what the hand has left behind, and go on from there."""
        self.planner.begin_next_part()
        self.executor.finish_subtask()
        self._earlier_parts_known &= self._progress.verdict is True
        self._progress = PartProgress()
        self._plan(hand, detect)
