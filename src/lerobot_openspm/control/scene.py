"""What one episode knows of its scene: where the objects are, and what goes along with the hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from lerobot_openspm.control.grounding import Grounding, asked_of_both, demonstrations, references
from lerobot_openspm.control.plan import Plan
from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.control.reasons import are_around_something, why_missing
from lerobot_openspm.control.transfer import Target
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.compose import Candidate
from lerobot_openspm.perception.tracking.tracker import Tracker, TrackerSettings, TrackStatus
from lerobot_openspm.types import Detections, Hand

# An object that is not found is looked for again after this time; while things go well, all objects are.
LOOK_AGAIN_S = 0.25
# What looks wrong is looked at again after this time.
SECOND_LOOK_S = 0.15
# Without a sound picture of every camera the hand goes on for BLIND_S, then holds still, then gives up.
BLIND_S, GIVE_UP_S = 0.5, 2.0
# Of what is opened or turned, a drawer, a door or a knob goes along with the hand, and the rest stays.
PART_MOVES = frozenset({"open", "close", "turn on", "turn off"})
# A hand that has gone this far beyond where it meets what it pushes has lost it. Where that point is not
# known: a hand that has moved this much further than the object, and this much away from it.
LEFT_BEHIND_M, OUTRUN_M = 0.025, 0.06


@dataclass(frozen=True)
class LookRequest:
    """What the controller wants to be looked for.

    Attributes:
        names: The objects.
        expected: Poses ``T_world_obj`` ``(4, 4)`` of the objects that were seen before, without those that
            have fallen out of the hand since.
        time_s: Seconds since the episode began.
        held: Those of the objects that are taken to be in the hand.
        told_apart: Those that the instruction tells from others of their kind.
        displaced: Those that need not be where they were in the first looks any more.
        back_to: The key pose to go back to after the look; None unless something is tried again.
        is_loaded: Whether the fingers are around something, which may be an object that was not seen yet.
    """

    names: tuple[str, ...]
    expected: Mapping[str, Array]
    time_s: float
    held: frozenset[str]
    told_apart: frozenset[str]
    displaced: frozenset[str]
    back_to: int | None
    is_loaded: bool = False


class SceneState:
    """What one episode knows of its scene. The tracker alone says where an object is.

    Attributes:
        tracker: Follows every object that was looked for.
        grounding: Which of several like objects is meant.
        detections: What the last look brought of the objects that are meant.
        altered: Objects that were opened, closed or turned: they look different now, and stand still.
    """

    def __init__(self, context: PlanningContext):
        self._context = context
        self.tracker = Tracker(context.yaw_periods, TrackerSettings())
        self.grounding = Grounding(surfaces=frozenset(context.surfaces), feet=context.feet)
        self.detections = Detections({}, {})
        self.altered: set[str] = set()
        self._shutting = ""  # what a push that has begun shuts
        self._step = -1
        self._looked_at_step = -self._steps(LOOK_AGAIN_S)

    # Looking.

    def predict(self) -> None:
        """Go one control step on."""
        self._step += 1
        self.tracker.predict(self._context.step_s)

    def ground(
        self, parts: Sequence[Sequence[Candidate]], number: int, hand: Hand | None = None
    ) -> frozenset[str]:
        """Take in which of several like objects a part of the instruction is about.

        Two parts that follow each other and ask for the same, as those of "both bowls" do, are about several.

        Args:
            parts: What each part of the instruction can be carried out by.
            number: The part that is turned to, from 0.
            hand: Where the hand is, at the end of the part before; None where there is none.

        Returns:
            Names that mean another object from now on.
        """
        candidates, grounding, meant = parts[number], self.grounding, self._context.object_meant
        told = [[references(one, meant) for one in part] for part in parts]
        said = {name: where for own in told[number] for name, where in own.items()}
        named = {name for one in candidates for asked in one.entry.key.sub_tasks for name in asked.objects}
        # What this part names without such words is the one that was shown, whatever a later one says.
        words = {one for part in told for own in part for one in own.items()}
        grounding.words = frozenset(
            (name, where) for name, where in words if name in said or name not in named
        )
        poses = {} if hand is None else self.tracker.poses(hand.T_world_ee)
        next_ones = self._next_ones(parts, number, said.keys(), poses)
        known = set(self._context.yaw_periods) - set(self._context.surfaces)
        others = grounding.hear(said, demonstrations(candidates, meant, known), poses)
        grounding.named |= named
        self.tracker.forget(others | next_ones)
        self.altered -= others
        return others

    def _next_ones(
        self,
        parts: Sequence[Sequence[Candidate]],
        number: int,
        said: Set[str],
        object_poses: Mapping[str, Array],
    ) -> set[str]:
        """Turn to the next one of several, or to the first one; their names.

        Args:
            parts: As of :meth:`ground`, like `number`.
            number: The part.
            said: Names of which it says where the object is: words mean one, not any.
            object_poses: Where objects are at its beginning, ``T_world_obj`` ``(4, 4)`` by name.
        """
        candidates, grounding = parts[number], self.grounding
        first = asked_of_both(candidates, *parts[number + 1 : number + 2])
        if number:
            first -= asked_of_both(candidates, parts[number - 1])
        targets = {one.entry.key.sub_tasks[0].target for one in candidates}
        following = (grounding.several & targets & object_poses.keys()) - first - said
        if any(parts[number] is one for one in parts[:number]):  # it is done once more, to the same one
            following = frozenset[str]()
        for name in following:
            grounding.next_of(name, object_poses[name])
        for name in first:
            grounding.first_of(name, object_poses.get(name))
        return {*following, *first}

    @property
    def time_s(self) -> float:
        """Seconds since the episode began."""
        return self._step * self._context.step_s

    def look(self, names: Sequence[str], hand: Hand, back_to: int | None = None) -> LookRequest:
        """A look for some objects, now, but for those that are still falling out of the hand."""
        poses, tracker = self.tracker.poses(hand.T_world_ee), self.tracker
        names = [name for name in names if name not in tracker.falling]
        expected = {name: T for name, T in poses.items() if name not in tracker.fallen}
        held = self.tracker.held & frozenset(names)
        told_apart = self.grounding.told_apart & frozenset(names)
        displaced = frozenset(self.tracker.displaced)
        is_unknown = not self.tracker.held and not expected.keys() >= frozenset(names)
        is_loaded = is_unknown and are_around_something(hand, self._context.robot)
        return LookRequest(
            tuple(names), expected, self.time_s, held, told_apart, displaced, back_to, is_loaded
        )

    def take_in(self, detections: Detections, hand: Hand, is_felt: bool = False) -> frozenset[str]:
        """Take in what a look brought; the names of the objects that are somewhere else than before.

        What the fingers feel in the hand, as `is_felt` says, is not believed to be seen elsewhere.

        Raises:
            InstructionError: The instruction tells like objects apart by a relation that is not known.
        """
        waited_steps = min(self._step - self._looked_at_step, self._steps(LOOK_AGAIN_S))
        waited_s = waited_steps * self._context.step_s
        self.detections = detections
        self._looked_at_step = self._step
        known = {**self._context.surfaces, **self.tracker.poses(hand.T_world_ee)}
        meant = self.grounding.sort_out(detections.estimates, known, self.tracker.displaced)
        self.detections = replace(detections, estimates=meant)
        return self.tracker.look(meant, hand.T_world_ee, waited_s, is_felt)

    @property
    def has_just_looked(self) -> bool:
        """Whether the last observation was looked at."""
        return self._looked_at_step == self._step

    def is_due(self, seconds: float) -> bool:
        """Whether the last look is so long ago; at least one step, whatever the robot's rate."""
        return self._step - self._looked_at_step >= self._steps(seconds)

    def _steps(self, seconds: float) -> int:
        return max(1, round(seconds / self._context.step_s))

    # What was seen.

    @property
    def is_blind(self) -> bool:
        """Whether a camera gave no sound picture for long enough to hold still."""
        return any(fault.seconds >= BLIND_S for fault in self.detections.faults.values())

    def recognised(self) -> set[str]:
        """The objects that the last look recognised."""
        return {name for name in self.detections.estimates if self.tracker.is_seen(name)}

    def those(self, status: TrackStatus, names: Sequence[str]) -> list[str]:
        """Those of some objects that have a status."""
        return [name for name in names if self.tracker.status(name) is status]

    def believed(self, hand: Hand, refused: Plan | None = None) -> dict[str, Array]:
        """Poses ``T_world_obj`` ``(4, 4)`` of all objects that were seen.

        Where a plan was refused, without those that are gone by now, unless it needs them.
        """
        poses = self.tracker.poses(hand.T_world_ee)
        if refused is None:
            return poses
        gone = set(self.those(TrackStatus.LOST, list(poses))) - set(refused.entry.objects)
        return {name: T for name, T in poses.items() if name not in gone}

    def why_missing(self, names: Sequence[str], hand: Hand) -> str:
        """What is known of objects that the last look did not find, in words."""
        is_something_held = not self.tracker.held and are_around_something(hand, self._context.robot)
        return why_missing(names, self.detections.estimates, self.grounding.elsewhere, is_something_held)

    def doubt(self, names: Set[str], hand: Hand) -> None:
        """What should be in the hand, or was to be met or shut, is not there: it may be anywhere."""
        self.altered.discard(self._shutting)
        self._shutting = ""
        self.tracker.doubt(names - self.altered, hand.T_world_ee)

    # What goes along with the hand.

    def pass_key_pose(self, plan: Plan, passed: Target, after: Target, hand: Hand) -> None:
        """Take in what the hand took hold of, pushes or let go at a key pose, by the one after it."""
        pose, phase_after = passed.key_pose, after.key_pose.phase
        is_carried = pose.phase == "grasp" and phase_after not in ("open", "turn")
        # Where the path of a push is known, the target is held once the hand has met it; see meet().
        is_pushed = phase_after == "push" != pose.phase and after.push is None
        if is_carried:
            self.tracker.hold(pose.anchor.place, hand.T_world_ee)
        elif is_pushed:
            pushing = plan.sub_task(after.key_pose)
            if pushing.operation not in PART_MOVES:
                self.tracker.hold(pushing.target, hand.T_world_ee)
            elif pushing.target not in self.altered:
                self._shutting = pushing.target
                self.altered.add(pushing.target)
        elif pose.phase == "release" or pose.phase == "push" != phase_after:
            self._shutting = ""
            self.tracker.release(self.tracker.held, hand.T_world_ee)
        elif pose.phase in ("open", "turn"):
            self.altered.add(pose.anchor.place)
            if pose.phase == "open" and plan.sub_task(pose).operation != "close":
                self.tracker.cover()

    def meet(self, target: Target, hand: Hand) -> None:
        """What is pushed on the way to a key pose goes along once the hand has met it."""
        if target.push and self._beyond(target, hand) >= 0:
            self.tracker.hold(target.push.target, hand.T_world_ee)

    def untouched(self, plan: Plan, targets: Sequence[Target], index: int) -> list[str]:
        """Objects of the key poses from one on that still are where they were seen."""
        touched = plan.touched(targets[:index]) | self.tracker.held
        return [name for name in plan.objects(index, self.altered) if name not in touched]

    def dropped(
        self, names: Set[str], plan: Plan, targets: Sequence[Target], index: int, hand: Hand
    ) -> set[str]:
        """Those of some objects, seen elsewhere than in the hand, that it dropped; the others go along.

        All of them where no target is approached.
        """
        dropped = {
            name for name in names if not targets or self.is_left_behind(name, plan, targets, index, hand)
        }
        for name in names - dropped:  # it goes along from where it is
            self.tracker.hold(name, hand.T_world_ee)
        return dropped

    def is_left_behind(
        self, name: str, plan: Plan, targets: Sequence[Target], index: int, hand: Hand
    ) -> bool:
        """Whether an object that turned out not to be in the hand stays behind, on the way to a key pose."""
        target = targets[index]
        if target.key_pose.phase != "push":
            return True
        if target.push is not None:
            return target.push.target != name or self._beyond(target, hand) > LEFT_BEHIND_M
        first = index
        while first > 0 and targets[first - 1].key_pose.phase == "push":
            first -= 1
        began = targets[first - 1].T_world_ee if first > 0 else plan.T_world_ee
        was, place = plan.object_poses[name], self.tracker.poses(hand.T_world_ee)[name]
        further = _apart(hand.T_world_ee, began) - _apart(place, was)
        # On its way to the object the hand has not outrun it, however far that is.
        return min(further, _apart(hand.T_world_ee, place) - _apart(began, was)) > OUTRUN_M

    def _beyond(self, target: Target, hand: Hand) -> float:
        """Metres by which the hand has gone beyond where it meets what it pushes."""
        if target.push is None:
            return -np.inf
        poses = self.tracker.poses(hand.T_world_ee)
        return target.push.beyond(hand.T_world_ee, target.T_world_ee, poses)


def _apart(T: Array, other: Array) -> float:
    """Horizontal distance between the origins of two poses ``(4, 4)``, metres."""
    return float(np.linalg.norm(T[:2, 3] - other[:2, 3]))
