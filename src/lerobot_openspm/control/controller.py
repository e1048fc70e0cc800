"""One episode from instruction to actions: look, retrieve, transfer, follow, look again.

An instruction that no demonstration shows as a whole is carried out part by part. Each part is planned when
it is reached, from a fresh look, because the parts before it have moved things.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lerobot_openspm.control.between_parts import rise
from lerobot_openspm.control.executor import Executor
from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.control.scene import GIVE_UP_S, LOOK_AGAIN_S, SECOND_LOOK_S, LookRequest, SceneState
from lerobot_openspm.control.state import LOOKS_AT_OUTCOME, EpisodeState, Status
from lerobot_openspm.control.transfer import Target
from lerobot_openspm.errors import InstructionError
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.compose import plan_parts
from lerobot_openspm.memory.entry import Outcome
from lerobot_openspm.memory.retrieval import read_instruction
from lerobot_openspm.perception.tracking.tracker import TrackStatus
from lerobot_openspm.types import Detections, Hand

logger = logging.getLogger(__name__)


class EpisodeController:
    """Carries out one instruction in one environment; other environments never see any of this.

    A control step is :meth:`advance`, then :meth:`take_in` of what each look brings for as long as one is
    wanted, then the executor's next action.

    Attributes:
        instruction: What is to be done.
        state: What is being done.
        scene: Where the objects are.
        executor: Follows the key poses of the plan.
    """

    def __init__(self, context: PlanningContext, instruction: str, fingerprint: int, noise_seed: int):
        self._context = context
        self.instruction = instruction
        self.state = EpisodeState()
        self.scene = SceneState(context)
        self.executor = Executor(context.execution, context.robot, self.state)
        # Told by the first observation, so it does not matter in which batch or row the episode runs.
        self._noise_key = (noise_seed, zlib.crc32(instruction.encode()), fingerprint)

    def noise(self, shape: tuple[int, ...]) -> Array:
        """Standard normal noise of the next chunk, a function of (seed, episode, chunk) alone."""
        return np.random.default_rng([*self._noise_key, self.state.replans]).standard_normal(shape)

    # One control step.

    def advance(self, hand: Hand) -> LookRequest | None:
        """Let one control step pass, and go on to the next key pose where one is reached.

        An instruction that is not understood ends this episode alone: the hand holds still from then on, and
        ``state.refusal`` says why.

        Returns:
            What has to be looked for now; None if nothing.
        """
        self.scene.predict()
        match self.state.status:
            case Status.WAITING | Status.OBJECT_NOT_FOUND | Status.INFEASIBLE:
                return self._look_for_plan(hand) if self.scene.is_due(LOOK_AGAIN_S) else None
            case Status.RUNNING | Status.PAUSED:
                return self._follow_plan(hand)
            case Status.OBJECT_LOST:
                return self._look_around(hand) if self.scene.is_due(SECOND_LOOK_S) else None
            case Status.DONE:
                return self._look_at_outcome(hand) if self.state.looks_left > 0 else None
            case Status.NO_PROGRESS | Status.NOT_UNDERSTOOD | Status.CAMERA_FAULT:
                return None

    def take_in(self, look: LookRequest, detections: Detections, hand: Hand) -> LookRequest | None:
        """Take in what a look brought, and act on it.

        Returns:
            What has to be looked for at the same moment; None if nothing more.
        """
        try:
            moved = self.scene.take_in(detections, hand, self.executor.feels_grip(hand))
        except InstructionError as error:
            return self._refuse(error)
        self._check_cameras()
        match self.state.status:
            case Status.WAITING | Status.OBJECT_NOT_FOUND | Status.INFEASIBLE:
                self._plan(hand)
            case Status.RUNNING | Status.PAUSED | Status.OBJECT_LOST if look.back_to is not None:
                self._follow_objects(look.names, hand)
                self._begin(look.back_to, hand)
            case Status.RUNNING | Status.PAUSED | Status.OBJECT_LOST:
                self._go_on(look, moved, hand)
            case Status.DONE:
                return self._judge(hand)
            case Status.NO_PROGRESS | Status.NOT_UNDERSTOOD | Status.CAMERA_FAULT:
                pass
        return None

    def _refuse(self, error: InstructionError) -> None:
        self.state.refusal = str(error)
        self.executor.stop(Status.NOT_UNDERSTOOD)
        logger.warning("not acting: %s", error)

    def _check_cameras(self) -> None:
        """Give up where a camera gave no sound picture for too long, unless all is done but to look."""
        for camera, fault in self.scene.detections.faults.items():
            if fault.seconds >= GIVE_UP_S and self.state.status is not Status.DONE:
                self.state.refusal = f"camera {camera!r}: {fault.reason}"
                logger.warning("%r: stopping, %s", self.instruction, self.state.refusal)
                self.executor.stop(Status.CAMERA_FAULT)

    # Planning.

    def _look_for_plan(self, hand: Hand) -> LookRequest | None:
        """Look for the objects of the present part, and of those to come, which it may hide."""
        state, scene, context = self.state, self.scene, self._context
        if not state.parts:
            try:
                known = context.entries, context.names
                asked = read_instruction(self.instruction, *known)
                state.parts = plan_parts(self.instruction, asked, *known, context.looks)
            except InstructionError as error:
                return self._refuse(error)
            state.T_start = hand.T_world_ee
            scene.ground(state.parts, 0)
        ahead = [one.entry for part in state.parts[state.part :] for one in part]
        names = dict.fromkeys([*context.objects_of_interest(ahead), *scene.grounding.landmarks])
        return scene.look([name for name in names if name not in scene.altered], hand)

    def _plan(self, hand: Hand) -> None:
        """Plan the present part, once its objects are found."""
        state, candidates = self.state, self.state.parts[self.state.part]
        poses = self.scene.believed(hand, state.refused if state.status is Status.INFEASIBLE else None)
        if state.status is Status.INFEASIBLE and state.refused.is_same_scene(poses, hand.T_world_ee):
            return  # nor is it now
        state.ranked = self._context.rank(candidates, poses, hand.T_world_ee)
        not_meant = self.scene.grounding.not_meant
        plan, problems = self._context.choose(state.ranked, poses, hand.T_world_ee, not_meant)
        if missing := [name for name in plan.entry.objects if name not in poses]:
            state.refusal = self.scene.why_missing(missing, hand)
            logger.info("%r: %s", self.instruction, state.refusal)
            state.go(Status.OBJECT_NOT_FOUND)
        elif problems:
            state.refused = plan
            state.refusal = "; ".join(problems)
            logger.warning("%r: %s", self.instruction, state.refusal)
            state.go(Status.INFEASIBLE)
        else:
            state.refusal = ""
            state.plan = self._context.clear(plan)
            state.used = (*state.used, next(one.sources for one in candidates if one.entry is plan.entry))
            self._begin(0, hand)
            if self._is_tracking:  # else no later look could end the waiting
                self._wait_for_what_is_needed(hand)

    def _begin(self, index: int, hand: Hand) -> None:
        """Go to a key pose; what is grasped or pushed from there on is not in the hand any more."""
        state, tracker = self.state, self.scene.tracker
        state.plan = replace(state.plan, T_world_ee=hand.T_world_ee)
        tracker.drop(tracker.held & state.plan.regrasped(index), hand.T_world_ee)
        self.executor.begin(self._targets(), hand, index)

    def _targets(self) -> tuple[Target, ...]:
        """The key poses of the plan in the scene."""
        targets = self.state.plan.targets(self._context, self.state.gone)
        return targets if self.state.is_last_part else (*targets, *rise(targets[-1], self.state.T_start))

    # Following the plan.

    @property
    def _is_tracking(self) -> bool:
        return self._context.tracking and self.executor.strategy.measures

    def _follow_plan(self, hand: Hand) -> LookRequest | None:
        """Go on to the next key pose where one is reached; look where it is time to."""
        state, scene, executor = self.state, self.scene, self.executor
        before = state.index
        is_to_retry = state.status is Status.RUNNING and executor.advance(hand)
        for i in range(before, state.index):
            scene.pass_key_pose(state.plan, executor.targets[i], executor.targets[i + 1], hand)
        if (target := executor.target) is not None:
            scene.meet(target, hand)
        if state.status is Status.DONE:
            scene.tracker.release(scene.tracker.held, hand.T_world_ee)
            return self._look_at_outcome(hand)
        if is_to_retry:
            return self._try_again(hand)
        return self._look_around(hand) if self._is_time_to_look(before) else None

    def _is_time_to_look(self, index_before: int) -> bool:
        target, scene = self.executor.target, self.scene
        is_paused = self.state.status is Status.PAUSED
        if not self._is_tracking or target is None or (target.key_pose.dwell and not is_paused):
            return False  # the fingers hide what they are around
        if scene.detections.faults:
            return True
        if is_paused or scene.tracker.doubtful:
            return scene.is_due(SECOND_LOOK_S)
        return self.state.index != index_before or scene.is_due(LOOK_AGAIN_S)

    def _look_around(self, hand: Hand) -> LookRequest:
        """Look for what the remaining key poses need, and for what is in the hand."""
        untouched = self.scene.untouched(self.state.plan, self.executor.targets, self.state.index)
        return self.scene.look([*untouched, *self.scene.tracker.held], hand)

    def _go_on(self, look: LookRequest, moved: frozenset[str], hand: Hand) -> None:
        """Act on what has moved: what was in the hand and is seen elsewhere was dropped, so fetch it."""
        scene, executor, plan = self.scene, self.executor, self.state.plan
        target, index = executor.target, self.state.index
        approached = () if target is None else executor.targets
        if dropped := scene.dropped(moved & look.held, plan, approached, index, hand):
            logger.info("%r: dropped: %s", self.instruction, ", ".join(sorted(dropped)))
            # What slips out of the hand is no fault of the plan; a push that loses its object may be.
            is_pushing = target is not None and target.key_pose.phase == "push"
            if is_pushing and not executor.try_again("what is pushed was left behind"):
                return
            index = executor.contact_index(hand)
            self._follow_objects(plan.objects(index, scene.altered), hand)
            self._begin(index, hand)
        elif changed := self._follow_objects([n for n in look.names if n not in look.held], hand):
            logger.info("%r: moved: %s", self.instruction, ", ".join(sorted(changed)))
            # From further off, if what is approached has jumped aside.
            if executor.target is not None and moved & set(self._now_needed()):
                self._begin(executor.way_index(hand), hand)
            else:
                executor.change(self._targets())
        self._wait_for_what_is_needed(hand)

    def _follow_objects(self, names: Sequence[str], hand: Hand) -> set[str]:
        """Take over where objects are now, unless the hand could not follow key poses there.

        Returns:
            Those that are elsewhere than before.
        """
        plan = self.state.plan
        changed = plan.moved(names, self.scene.tracker.poses(hand.T_world_ee))
        if changed:
            plan, problems = self._context.following(plan, changed)
            if problems:
                logger.info("%r: not believed: %s", self.instruction, "; ".join(problems))
                return set()
            self.state.plan = plan
        return set(changed)

    def _wait_for_what_is_needed(self, hand: Hand) -> None:
        """Hold still without sound pictures, and while what the hand is on its way to is not to be seen."""
        state, scene, needed = self.state, self.scene, self._now_needed()
        if lost := scene.those(TrackStatus.LOST, needed):
            state.refusal = scene.why_missing(lost, hand)
            if state.status is not Status.OBJECT_LOST:
                logger.info("%r: lost: %s", self.instruction, state.refusal)
            self.executor.stop(Status.OBJECT_LOST)
            return
        if state.status is Status.OBJECT_LOST:
            state.refusal = ""
            self._begin(self.executor.way_index(hand), hand)
        is_paused = scene.is_blind or scene.those(TrackStatus.STALE, needed)
        state.go(Status.PAUSED if is_paused else Status.RUNNING)

    def _now_needed(self) -> list[str]:
        """Objects that the present key pose is relative to, unless the hand has touched them."""
        untouched = self.scene.untouched(self.state.plan, self.executor.targets, self.state.index)
        return [name for name in self.executor.present.key_pose.anchor.objects if name in untouched]

    # Trying again.

    def _try_again(self, hand: Hand) -> LookRequest | None:
        """Look for the objects of the remaining key poses again, to go back to where this contact begins."""
        state, executor, context = self.state, self.executor, self._context
        executor.note_travel(hand)
        # With the object still in the hand only the way to its place is gone again.
        present, has_slipped = executor.present.key_pose, executor.has_lost_grip(hand)
        is_in_hand = bool(self.scene.tracker.held) and present.phase == "place" and not has_slipped
        index = executor.way_index(hand) if is_in_hand else executor.contact_index(hand)
        own, plan = present.sub_task, replace(state.plan, T_world_ee=hand.T_world_ee)
        if executor.was_kept_from_grasping(hand):
            plan = plan.dodging(own, executor.pushed_aside(hand), context) or context.otherwise(plan, own)
        elif has_slipped:
            plan = plan.deepened(own, context) or context.otherwise(plan, own)
        state.plan = plan
        if not self._is_tracking:
            self._begin(index, hand)
            return None
        places = {one.key_pose.anchor.place for one in executor.targets[index : state.index + 1]}
        self.scene.doubt(places, hand)
        return self.scene.look(plan.objects(index, self.scene.altered), hand, back_to=index)

    # The end of a part.

    def _look_at_outcome(self, hand: Hand) -> LookRequest | None:
        """Look whether what was to be done is done, as far as that can be seen."""
        state, scene = self.state, self.scene
        if state.looks_left < LOOKS_AT_OUTCOME and not scene.is_due(SECOND_LOOK_S):
            return None
        if not self._is_tracking:
            return self._end_part(hand)
        state.followed |= self.executor.followed_sub_tasks()
        if not state.looked_at:
            state.judge(())
            return self._end_part(hand)
        state.looks_left -= 1
        return scene.look([name for name in state.looked_at if name not in scene.altered], hand)

    def _judge(self, hand: Hand) -> LookRequest | None:
        """Compare what is seen with the outcomes: go on if all are met, else go back to what can mend it."""
        state = self.state
        seen = self.scene.tracker.poses(hand.T_world_ee), self.scene.recognised(), self._context
        if state.is_unsure(*seen) and state.looks_left > 0:
            return None
        if (missed := state.plan.missed(*seen)) is not None:
            state.judge(missed)
        if missed:
            return self._mend(missed[0], hand)
        state.take_up_again(*seen)
        n_passed, targets = len(self.executor.targets), self._targets()
        if len(targets) > n_passed:  # it is the last part no more
            return self.executor.begin(targets, hand, n_passed)
        return self._end_part(hand)

    def _mend(self, missed: Outcome, hand: Hand) -> None:
        """Go back to a sub-task, and to where its target is now, if an attempt is left."""
        state = self.state
        state.looks_left = 0
        if not self.executor.try_again(f"the {missed.target} is not where it should be"):
            return
        state.looks_left, state.verdict = LOOKS_AT_OUTCOME, None
        index = state.plan.begin_of(missed.sub_task)
        self._follow_objects(state.plan.objects(index, self.scene.altered), hand)
        self._begin(index, hand)

    def _end_part(self, hand: Hand) -> LookRequest | None:
        """Go on with the next part, if there is one, from a look at what the hand has left behind."""
        state = self.state
        state.looks_left = 0
        if state.is_last_part:
            return None
        self.executor.stop(Status.WAITING)
        state.begin_next_part(self.scene.time_s)
        state.rename(self.scene.ground(state.parts, state.part, hand))
        logger.info("%r: part %d of %d", self.instruction, state.part + 1, len(state.parts))
        return self._look_for_plan(hand)
