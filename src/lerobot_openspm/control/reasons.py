"""Why an instruction cannot be carried out in a scene, in words that name the objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.perception.tracking.tracker import TrackerSettings
from lerobot_openspm.types import Hand, PoseEstimate

# Fingers that are open by such a share are around something, as far as can be felt.
FINGERS_AROUND = (0.03, 0.9)
# What does not succeed in a phase, with the object that it is about.
FAILS = {
    "approach": "the hand does not get to the {}",
    "grasp": "the fingers do not hold the {}",
    "lift": "the {} does not stay in the hand",
    "pre-place": "the hand does not get to the {}",
    "place": "nothing can be put at the {}",
    "release": "the hand does not let go at the {}",
    "retreat": "the hand does not get away from the {}",
    "push": "the {} cannot be pushed",
    "open": "the {} does not open",
    "close": "the {} does not close",
    "turn": "the {} does not turn",
}


def why_missing(
    missing: Sequence[str],
    estimates: Mapping[str, PoseEstimate],
    elsewhere: Mapping[str, str],
    is_something_held: bool,
) -> str:
    """What is known of objects that were not found.

    Args:
        missing: Their names, at least one.
        estimates: What the last look brought of the objects that are meant, by name.
        elsewhere: By name, how the only one found is not where it should be.
        is_something_held: Whether the fingers are around something of which it is not known what it is.
    """
    reasons = list[str]()
    for name in missing:
        one = estimates.get(name)
        if one is not None and one.tipped:
            reasons.append(f"the {name} has tipped over")
        elif name in elsewhere:
            reasons.append(f"the only {name} that was found {elsewhere[name]}")
        elif one is not None and one.status == "found" and one.visible < TrackerSettings.visible:
            reasons.append(f"no view shows more than {100 * one.visible:.0f} % of the {name}")
        elif one is not None and one.status == "ambiguous":
            reasons.append(f"cannot tell which {name} is meant, or where it stands")
        else:
            reasons.append(f"cannot find the {name}: it is in no view, hidden, or not as it was shown")
    if is_something_held:
        reasons.append("the fingers are around something, which may be it")
    return "; ".join(reasons)


def why_given_up(phase: str, key_pose: MemoryKeyPose, entry: MemoryEntry, why: str) -> str:
    """What did not succeed although it was tried again.

    Args:
        phase: In which phase; "close" where a push shuts something.
        key_pose: The key pose that was not met.
        entry: The entry that it is of.
        why: What was wrong at last.
    """
    place = key_pose.anchor.place
    for sub_task in entry.key.sub_tasks[key_pose.sub_task : key_pose.sub_task + 1]:
        if sub_task.part and sub_task.target == place:
            place = f"{sub_task.part} of the {place}"
    return f"{FAILS[phase].format(place)}: {why}" if phase in FAILS else why


def are_around_something(hand: Hand, robot: RobotModel) -> bool:
    """Whether the fingers are, as far as can be felt."""
    low, high = FINGERS_AROUND
    return low < hand.opening / robot.open_width < high
