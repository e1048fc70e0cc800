"""One environment from instruction to actions: look, retrieve, transfer, follow, look again.

An instruction that no demonstration shows as a whole is carried out part by part: each is planned when it is
reached, from a fresh look, because what the parts before it moved is elsewhere now.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_openspm.control.executor import Executor, Hand, Status
from lerobot_openspm.control.planning_context import PlanningContext
from lerobot_openspm.control.referents import Referents, references
from lerobot_openspm.control.transfer import PushWays, Target, rise
from lerobot_openspm.errors import InstructionError
from lerobot_openspm.flow.condition import Query
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.compose import Candidate, plan_parts
from lerobot_openspm.memory.entry import WORLD, MemoryEntry, MemoryKeyPose, Outcome
from lerobot_openspm.memory.retrieval import Scored
from lerobot_openspm.perception.tracking.camera_health import Fault
from lerobot_openspm.perception.tracking.tracker import Tracker, TrackStatus
from lerobot_openspm.types import PoseEstimate, SubTask

logger = logging.getLogger(__name__)

# An object that is not found is looked for again after this long; while things go well, all are.
LOOK_AGAIN_S = 0.25
# What looks wrong is looked at again after this long.
SECOND_LOOK_S = 0.15

# Without a sound picture of every camera the hand goes on for so long, then holds still, then gives up.
BLIND_S, GIVE_UP_S = 0.5, 2.0

# After the last key pose the policy looks up to three times at what it moved. Then the outcome stays unknown.
LOOKS_AT_OUTCOME = 3

# A hand that has gone this far beyond where it meets what it pushes has lost it; or, where it is not known
# where they meet, this much further than what it pushes, and this much further away from it than at first.
LEFT_BEHIND_M, OUTRUN_M = 0.025, 0.06

# A handle that has come along for less than this share of its way was not in the fingers.
LEAST_TRAVEL = 0.05

# An object that is this far from where the key poses took it to be takes them along; less is noise.
MOVED_M, MOVED_RAD = 0.002, 0.05


@dataclass(frozen=True)
class Detections:
    """What one look brought.

    Attributes:
        estimates: By name, for the objects that were looked for.
        faults: Cameras whose pictures cannot be used.
    """

    estimates: Mapping[str, PoseEstimate]
    faults: Mapping[str, Fault]


# Names of objects, poses T_world_obj at which some are expected, seconds since the start -> what is seen.
Look = Callable[[Sequence[str], Mapping[str, Array], float], Detections]


class EpisodeController:
    """State of one environment, and nothing that another environment could see.

    Attributes:
        instruction: What is to be done.
        executor: Follows the plan.
        tracker: Follows the objects.
        ranked: The entries of the last retrieval with their scores, best first; where a part of the
            instruction is carried out, those parts of entries that are about it.
        layout: Poses ``T_world_obj`` that the plan was made with: of what the hand has touched, from before.
        seen: What the last look brought; None before the first.
        is_paused: Whether the hand holds still until something is seen again.
        refusal: Why the instruction is not acted on; "" unless the status is NOT_UNDERSTOOD.
    """

    def __init__(self, knowledge: PlanningContext, instruction: str, fingerprint: int, noise_seed: int):
        self._knowledge = knowledge
        self.instruction = instruction
        self.executor = Executor(knowledge.settings, knowledge.robot)
        self.tracker = Tracker(knowledge.yaw_periods, knowledge.tracker)
        self.ranked: list[Scored] = []
        self.layout: dict[str, Array] = {}
        self.seen: Detections | None = None
        self.is_paused = False
        self._verdict: bool | None = None  # whether the present part is seen to be done
        self._parts_known = True  # whether all parts before it were
        self._looks_left = LOOKS_AT_OUTCOME  # at how the present part ended
        self.refusal = ""
        # What the instruction is carried out by; made at the first look, because it may be refused.
        self._parts: tuple[tuple[Candidate, ...], ...] = ()
        self._part = 0
        self._used: list[MemoryEntry] = []
        self._referents = Referents()
        self._altered: set[str] = set()  # opened or turned: looks different now, and stands still
        self._gone: dict[int, float] = {}  # how far drawers and knobs are on their way, by sub-task
        self._followed: set[int] = set()  # sub-tasks whose drawer or knob went all the way
        self._repeated: int | None = None  # the sub-task that is done again, if one is
        self._start_height = np.inf
        self._step = -1
        # Both at least one step; four looks a second whatever the robot's rate.
        self._look_again_steps = max(1, round(LOOK_AGAIN_S / knowledge.step_s))
        self._second_look_steps = max(1, round(SECOND_LOOK_S / knowledge.step_s))
        self._looked_at_step = -self._look_again_steps
        self._planned_from = np.eye(4)  # the hand's pose when the plan was made
        # Told by what the episode shows first, so that it does not matter in which batch or row it runs.
        self._noise_key = (noise_seed, zlib.crc32(instruction.encode()), fingerprint)

    @property
    def status(self) -> Status:
        """What the execution is up to."""
        return self.executor.status

    @property
    def succeeded(self) -> bool | None:
        """Whether what was to be done is seen to be done; None before the end and where it is not seen."""
        if self.status is Status.NO_PROGRESS:
            return False
        return self._verdict if self.status is Status.DONE and self._parts_known else None

    @property
    def used_entries(self) -> tuple[MemoryEntry, ...]:
        """The entries of the bank that were acted by so far, each once, in order."""
        return tuple(self._used)

    def observe(self, hand: Hand, look: Look) -> None:
        """Take in a new observation: plan, advance, look around, go where things are now, try again.

        What is not understood ends this episode alone: the hand holds still from then on, and
        :attr:`refusal` says why.
        """
        try:
            self._observe(hand, look)
        except InstructionError as error:
            self.refusal = str(error)
            self.executor.stop(Status.NOT_UNDERSTOOD)
            logger.warning("not acting: %s", error)

    def _observe(self, hand: Hand, look: Look) -> None:
        self._step += 1
        self.tracker.predict(self._knowledge.step_s)
        if self.status in (Status.WAITING, Status.OBJECT_NOT_FOUND, Status.INFEASIBLE):
            if self._waited_steps >= self._look_again_steps:
                self._plan(hand, look)
        elif self.status is Status.OBJECT_LOST:
            if self._waited_steps >= self._second_look_steps:
                self._look_around(hand, look)
        elif self.status is Status.RUNNING:
            index = self.executor.index
            is_to_retry = not self.is_paused and self.executor.advance(hand)
            self._carry(index, hand)
            if self.executor.status is Status.DONE:
                self._check_outcomes(hand, look)
            elif is_to_retry:
                self._try_again(hand, look)
            elif self._is_time_to_look(index):
                self._look_around(hand, look)
        elif self.status is Status.DONE and self._looks_left > 0:
            self._check_outcomes(hand, look)

    def next_action(self, hand: Hand) -> Array | None:
        """The next canonical action ``(7,)``, or None when a chunk is needed."""
        return self.executor.hold() if self.is_paused else self.executor.next_action(hand)

    def query(self, hand: Hand) -> Query:
        """The condition of the next chunk."""
        return self.executor.query(hand)

    def noise(self, shape: tuple[int, ...]) -> Array:
        """Standard normal noise of the next chunk, a function of (seed, episode, chunk) alone."""
        return np.random.default_rng([*self._noise_key, self.executor.replans]).standard_normal(shape)

    # Planning.

    @property
    def candidates(self) -> tuple[tuple[Candidate, ...], ...]:
        """For each part of the instruction, in order, what it can be carried out by; none before a look."""
        return self._parts

    @property
    def _is_last_part(self) -> bool:
        return self._part + 1 >= len(self._parts)

    def _plan(self, hand: Hand, look: Look) -> None:
        """Plan the part that is to be carried out now, once its objects are found."""
        if not self._parts:
            self._parts = plan_parts(self.instruction, self._knowledge.entries, self._knowledge.names)
            self._refer()
            self._start_height = float(hand.T_world_ee[2, 3])
        self._see(self._sought(), hand, look)
        if self.status is Status.CAMERA_FAULT:
            return
        self.layout |= self.tracker.poses(hand.T_world_ee)
        candidates = self._parts[self._part]
        self.ranked = self._knowledge.rank(candidates, self.layout, hand.T_world_ee)
        best = self.ranked[0].entry
        if missing := [name for name in best.objects if name not in self.layout]:
            logger.info("%r: cannot find %s", self.instruction, missing)
            self.executor.status = Status.OBJECT_NOT_FOUND
        elif problems := self._knowledge.problems(best, self.layout, hand.T_world_ee):
            logger.warning("%r: %s", self.instruction, "; ".join(problems))
            self.executor.status = Status.INFEASIBLE
        else:
            source = next(one.source for one in candidates if one.entry is best)
            if not any(used is source for used in self._used):
                self._used.append(source)
            self._begin(0, hand)
            if self._is_tracking:  # else nothing is looked at any more that could end the waiting
                self._wait_for_what_is_needed(hand)

    def _sought(self) -> list[str]:
        """Objects of this part, and of those to come, which it may hide; not what looks different now."""
        entries = [one.entry for part in self._parts[self._part :] for one in part]
        needed = [name for entry in entries for name in entry.objects]
        names = dict.fromkeys([*needed, *self._referents.landmarks])
        return [name for name in names if name not in self._altered]

    def _refer(self) -> None:
        """Take in which of several like objects this part is about."""
        meant = self._knowledge.object_meant
        said = {k: where for one in self._parts[self._part] for k, where in references(one, meant).items()}
        others = self._referents.hear(said)
        self.tracker.forget(others)
        self.layout = {name: T for name, T in self.layout.items() if name not in others}
        self._altered -= set(others)

    def _check_outcomes(self, hand: Hand, look: Look) -> None:
        """Look whether what was to be done is done: go on if so, else go back to what can mend it."""
        if self._looks_left < LOOKS_AT_OUTCOME and self._waited_steps < self._second_look_steps:
            return
        missed = self._missed(hand, look) if self._is_tracking else ()
        if missed is None and self._looks_left > 0:
            return
        self._looks_left = 0
        if missed:
            self._go_back(missed[0], hand)
        elif not self._is_last_part:
            self._begin_next_part(hand, look)

    def _missed(self, hand: Hand, look: Look) -> tuple[Outcome, ...] | None:
        """Look at what was moved: the outcomes that are not met, in order; None where that is not seen."""
        entry = self.ranked[0].entry
        served = {pose.sub_task for pose in entry.key_poses}
        expected = [one for one in entry.outcomes if one.sub_task in served]  # others could not be mended
        self._followed |= self.executor.followed_sub_tasks()
        names = dict.fromkeys(name for one in expected for name in one.objects)
        if not names:
            self._verdict = self._is_all_known(()) or None
            return ()
        self._looks_left -= 1
        self._see([name for name in names if name not in self._altered], hand, look)
        poses = self.tracker.poses(hand.T_world_ee)
        looked_for = list(self.seen.estimates) if self.seen else []
        recognised = {name for name in looked_for if self.tracker.is_seen(name)}
        seen = [one for one in expected if one.target in recognised and poses.keys() >= set(one.objects)]
        missed = tuple(one for one in seen if not self._is_met(one, poses))
        if len(seen) < len(expected) and not missed:
            return None
        self._verdict = False if missed else self._is_all_known(expected) or None
        return missed

    def _is_all_known(self, met: Sequence[Outcome]) -> bool:
        """Whether met outcomes, and handles that went all the way, tell that every sub-task is done."""
        done = {one.sub_task for one in met} | self._followed
        return done >= set(range(len(self.ranked[0].entry.key.sub_tasks)))

    def _is_met(self, outcome: Outcome, poses: Mapping[str, Array]) -> bool:
        """Whether an outcome is met whichever way round a symmetric landmark was seen."""
        axes = outcome.anchor.axes
        if axes == WORLD:
            return outcome.is_met(poses)
        turned = se3.yaw_equivalents(poses[axes], self._knowledge.yaw_periods.get(axes, 2 * np.pi))
        return any(outcome.is_met({**poses, axes: T}) for T in turned)

    def _go_back(self, missed: Outcome, hand: Hand) -> None:
        """Do one sub-task again, from where its target is now, if an attempt is left.

        Those after it are not done again: their handles are not where they were.
        """
        if not self.executor.try_again(f"the {missed.target} is not where it should be"):
            return
        self._looks_left, self._verdict = LOOKS_AT_OUTCOME, None
        self._repeated = missed.sub_task
        poses = self.ranked[0].entry.key_poses
        index = next(i for i, pose in enumerate(poses) if pose.sub_task == missed.sub_task)
        self._update(self._anchors(index), hand)
        self._begin(index, hand)

    def _begin_next_part(self, hand: Hand, look: Look) -> None:
        """Look at what the hand has left behind, and go on from there."""
        self._part += 1
        self._refer()
        logger.info("%r: part %d of %d", self.instruction, self._part + 1, len(self._parts))
        self.executor.finish_part()
        self._parts_known &= self._verdict is True
        self._looks_left, self._verdict = LOOKS_AT_OUTCOME, None
        self._gone.clear()
        self._followed.clear()
        self._repeated = None
        self._plan(hand, look)

    def _try_again(self, hand: Hand, look: Look) -> None:
        """Find the objects of the remaining key poses again and go back to where this contact begins."""
        index = self._retry_index(hand)
        self._planned_from = hand.T_world_ee
        if self._knowledge.tracking:
            # What should be in the hand is not, or what was to be met is not there: it may be anywhere.
            attempted = self.executor.plan[index : self.executor.index + 1]
            places = {pose.key_pose.anchor.place for pose in attempted}
            self.tracker.doubt(places - self._altered, hand.T_world_ee)
            ahead = self._anchors(index)
            self._see(ahead, hand, look)
            self._update(ahead, hand)
        if self.status is Status.RUNNING:
            self._begin(index, hand)

    def _retry_index(self, hand: Hand) -> int:
        """Where to go back to: the approach to what is grasped or, with it in the hand, to its place."""
        target = self.executor.plan[self.executor.index]
        shown = target.key_pose.axis  # the whole way, of which the target's own axis is what is left
        if shown is not None and self.executor.feels_handle(self.executor.index):
            gone, further = self._gone.get(target.key_pose.sub_task, 0.0), max(self.executor.travelled, 0.0)
            # Fingers that close on nothing where a handle slipped out: it went back when they let go.
            is_empty = self.executor.has_lost_grip(hand) and further < LEAST_TRAVEL * shown.amount
            # At the end of its way too little would be left to feel whether it is held.
            furthest = (1 - LEAST_TRAVEL) * shown.amount
            self._gone[target.key_pose.sub_task] = 0.5 * gone if is_empty else min(gone + further, furthest)
        is_carrying = bool(self.tracker.held) and target.key_pose.phase == "place"
        if is_carrying and not self.executor.has_lost_grip(hand):
            return self.executor.entry_index()
        return self.executor.retry_index()

    # Looking.

    @property
    def faults(self) -> Mapping[str, Fault]:
        """Cameras that were no use at the last look."""
        return {} if self.seen is None else self.seen.faults

    @property
    def has_just_looked(self) -> bool:
        """Whether the last observation was looked at."""
        return self._looked_at_step == self._step

    @property
    def _waited_steps(self) -> int:
        return self._step - self._looked_at_step

    @property
    def _is_tracking(self) -> bool:
        return self._knowledge.tracking and self._knowledge.settings.execution != "open_loop"

    def _is_time_to_look(self, index_before: int) -> bool:
        if not self._is_tracking:
            return False
        target = self.executor.target
        if target is None or (target.key_pose.dwell and not self.is_paused):
            return False  # done, or the fingers hide what they are around
        if self.faults:
            return True
        if self.is_paused or self.tracker.doubtful:
            return self._waited_steps >= self._second_look_steps
        return self.executor.index != index_before or self._waited_steps >= self._look_again_steps

    def _see(self, names: Sequence[str], hand: Hand, look: Look) -> frozenset[str]:
        """Look for objects; the names of those that are somewhere else than before."""
        waited_s = min(self._waited_steps, self._look_again_steps) * self._knowledge.step_s
        expected = {k: T for k, T in self.tracker.poses(hand.T_world_ee).items() if k in names}
        self.seen = look(names, expected, self._step * self._knowledge.step_s)
        self._looked_at_step = self._step
        for camera, fault in self.faults.items():
            if fault.seconds >= GIVE_UP_S and self.status is not Status.DONE:
                logger.warning("%r: stopping, camera %r: %s", self.instruction, camera, fault.reason)
                self.executor.stop(Status.CAMERA_FAULT)
        layout = {**self._knowledge.surfaces, **self.tracker.poses(hand.T_world_ee)}
        meant = self._referents.sort_out(self.seen.estimates, layout)
        return self.tracker.look(meant, hand.T_world_ee, waited_s)

    def _look_around(self, hand: Hand, look: Look) -> None:
        """Look at what the remaining key poses need and what is in the hand; act on what has changed."""
        untouched, held = self._untouched(), self.tracker.held
        moved = self._see([*untouched, *(held - set(untouched))], hand, look)
        if self.status is Status.CAMERA_FAULT:
            return
        dropped = {name for name in moved & held if self._is_left_behind(name, hand)}
        for name in (moved & held) - dropped:  # it goes along from where it is
            self.tracker.hold(name, hand.T_world_ee)
        if dropped:
            logger.info("%r: dropped: %s", self.instruction, ", ".join(sorted(dropped)))
            # What slips out of the hand is no fault of the plan; a push that loses its object may be.
            if self._is_pushing and not self.executor.try_again("what is pushed was left behind"):
                return
            index = self.executor.retry_index()
            self._update(self._anchors(index), hand)
            self._begin(index, hand)
        elif changed := self._update(untouched, hand):
            logger.info("%r: moved: %s", self.instruction, ", ".join(sorted(changed)))
            self._follow(bool(moved & set(self._now_needed())), hand)
        self._wait_for_what_is_needed(hand)

    def _follow(self, jumped: bool, hand: Hand) -> None:
        """Go to where the key poses are now; from further off, if what is approached has jumped aside."""
        if jumped and self.status is Status.RUNNING:
            self._begin(self.executor.entry_index(), hand)
        else:
            self.executor.change(self._transfer(self.ranked[0].entry, self._planned_from))

    def _wait_for_what_is_needed(self, hand: Hand) -> None:
        """Hold still without sound pictures, and while what the hand is on its way to is not to be seen."""
        statuses = {name: self.tracker.status(name) for name in self._now_needed()}
        blind = any(fault.seconds >= BLIND_S for fault in self.faults.values())
        if lost := [name for name, status in statuses.items() if status is TrackStatus.LOST]:
            if self.status is Status.RUNNING:
                logger.info("%r: lost: %s", self.instruction, ", ".join(lost))
            self.executor.stop(Status.OBJECT_LOST)
        elif self.status is Status.OBJECT_LOST:
            self._begin(self.executor.entry_index(), hand)
        self.is_paused = blind or TrackStatus.STALE in statuses.values()

    def _carry(self, index_before: int, hand: Hand) -> None:
        """Tell the tracker what the hand took hold of, pushes or let go on the key poses just passed."""
        for i in range(index_before, self.executor.index):
            passed, after = self.executor.plan[i].key_pose, self.executor.plan[i + 1].key_pose
            is_carried = passed.phase == "grasp" and after.phase not in ("open", "turn")
            # Where the way of a push is known, the target is held once the hand has met it; see below.
            is_pushed = after.phase == "push" != passed.phase and self.executor.plan[i + 1].push is None
            if is_carried:
                self.tracker.hold(passed.anchor.place, hand.T_world_ee)
            elif is_pushed:
                self.tracker.hold(self._sub_task(after).target, hand.T_world_ee)
            elif passed.phase == "release" or passed.phase == "push" != after.phase:
                self.tracker.release(self.tracker.held, hand.T_world_ee)
            elif passed.phase in ("open", "turn"):
                self._altered.add(passed.anchor.place)
                if passed.phase == "open" and self._sub_task(passed).operation != "close":
                    self.tracker.cover()
        target = self.executor.target
        if target and target.push and self._beyond(target, target.push, hand) >= 0:
            self.tracker.hold(target.push.target, hand.T_world_ee)
        if self.status is Status.DONE:
            self.tracker.release(self.tracker.held, hand.T_world_ee)

    @property
    def _is_pushing(self) -> bool:
        target = self.executor.target
        return target is not None and target.key_pose.phase == "push"

    def _beyond(self, target: Target, push: PushWays, hand: Hand) -> float:
        """Metres by which the hand has gone beyond where it meets what it pushes."""
        place = self.tracker.poses(hand.T_world_ee)[push.target][:3, 3]
        return push.beyond(hand.T_world_ee, target.T_world_ee, place)

    def _is_left_behind(self, name: str, hand: Hand) -> bool:
        """Whether an object that turned out to be elsewhere than in the hand does not go along with it."""
        target = self.executor.target
        if target is None or target.key_pose.phase != "push":
            return True
        if target.push is None:
            return self._outrun_by(name, hand) > OUTRUN_M
        return target.push.target != name or self._beyond(target, target.push, hand) > LEFT_BEHIND_M

    def _outrun_by(self, name: str, hand: Hand) -> float:
        """Metres by which the hand has gone further than an object and away from it since the push began."""
        plan, first = self.executor.plan, self.executor.index
        while first > 0 and plan[first - 1].key_pose.phase == "push":
            first -= 1
        began = plan[first - 1].T_world_ee if first > 0 else self._planned_from
        place, was = self.tracker.poses(hand.T_world_ee)[name][:3, 3], self.layout[name][:3, 3]
        start, here = began[:3, 3], hand.T_world_ee[:3, 3]
        further = _beside(here, start) - _beside(place, was)
        # On its way to the object the hand has not outrun it, however far that is.
        return min(further, _beside(here, place) - _beside(start, was))

    def _anchors(self, index: int) -> list[str]:
        """Objects of the key poses from one on that look as they did in the demonstrations."""
        ahead = self.ranked[0].entry.key_poses[index:]
        names = dict.fromkeys(name for pose in ahead for name in pose.anchor.objects)
        return [name for name in names if name not in self._altered]

    def _untouched(self) -> list[str]:
        """Objects of the key poses to come that still are where they were seen."""
        index = self.executor.index
        touched = {self._touched(target) for target in self.executor.plan[:index]} | self.tracker.held
        return [name for name in self._anchors(index) if name not in touched]

    def _touched(self, target: Target) -> str | None:
        """What the hand takes hold of or moves at a key pose, if anything: it is elsewhere from then on."""
        pose = target.key_pose
        if pose.phase == "push":  # its anchor may be where the target goes
            return self._sub_task(pose).target
        return pose.anchor.place if pose.phase in ("grasp", "open", "turn") else None

    def _sub_task(self, pose: MemoryKeyPose) -> SubTask:
        return self.ranked[0].entry.key.sub_tasks[pose.sub_task]

    def _now_needed(self) -> list[str]:
        """Objects that the present key pose is relative to, unless the hand has touched them."""
        untouched = self._untouched()
        return [
            name
            for name in self.executor.plan[self.executor.index].key_pose.anchor.objects
            if name in untouched
        ]

    # Believing.

    def _begin(self, index: int, hand: Hand) -> None:
        """Go to a key pose; what is grasped or pushed from there on is not in the hand any more."""
        self._planned_from = hand.T_world_ee
        ahead = self.ranked[0].entry.key_poses[index:]
        own = [pose for pose in ahead if pose.sub_task == ahead[0].sub_task]
        regrasped = {pose.anchor.place for pose in own if pose.phase in ("approach", "grasp")}
        self.tracker.drop(self.tracker.held & regrasped, hand.T_world_ee)
        self.executor.begin(self._transfer(self.ranked[0].entry, self._planned_from), hand, index)

    def _update(self, names: Sequence[str], hand: Hand) -> set[str]:
        """Take over where objects are now, unless the hand could not follow key poses there.

        Returns:
            Those that are elsewhere than before.
        """
        poses = self.tracker.poses(hand.T_world_ee)
        changed = {name for name in names if name in poses and _is_moved(poses[name], self.layout[name])}
        if not changed:
            return changed
        entry, believed = self.ranked[0].entry, self.layout
        self.layout = {**believed, **{name: poses[name] for name in changed}}
        if problems := self._knowledge.problems(entry, self.layout, self._planned_from):
            logger.info("%r: not believed: %s", self.instruction, "; ".join(problems))
            self.layout = believed
            return set()
        return changed

    def _transfer(self, entry: MemoryEntry, T_world_ee: Array) -> tuple[Target, ...]:
        if self._repeated is not None:
            entry = _until(entry, self._repeated)
        targets = self._knowledge.transfer(entry, self.layout, T_world_ee, self._gone)
        return targets if self._is_last_part else (*targets, *rise(targets[-1], self._start_height))


def _beside(a: Array, b: Array) -> float:
    """Horizontal distance of two points, metres."""
    return float(np.linalg.norm(a[:2] - b[:2]))


def _until(entry: MemoryEntry, sub_task: int) -> MemoryEntry:
    """An entry without the sub-tasks after one."""
    key = replace(entry.key, sub_tasks=entry.key.sub_tasks[: sub_task + 1])
    return replace(entry, key=key, key_poses=tuple(p for p in entry.key_poses if p.sub_task <= sub_task))


def _is_moved(T: Array, other: Array) -> bool:
    metres, radians = se3.distances(T, other)
    return bool(metres > MOVED_M or radians > MOVED_RAD)
