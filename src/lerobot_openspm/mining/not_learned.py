"""What a dataset's demonstrations handle and could not teach, in how many of them, and why."""

from __future__ import annotations

from collections import defaultdict

from lerobot_openspm.memory.not_learned import MAX_RECORDS, NotLearned, not_learned
from lerobot_openspm.mining.anchors import Demonstration, contact_roles, roles, suggested_anchor
from lerobot_openspm.mining.mined import MinedDataset, MinedTask

UNTOUCHED = "the hand touches it in no demonstration"


def missing_objects(demonstration: Demonstration, task: MinedTask) -> frozenset[str]:
    """The objects of a demonstration's contacts that it does not show; with any, it cannot be acted by."""
    missing = set[str]()
    touching = contact_roles(demonstration.key_poses)
    for role, pose in zip(roles(demonstration.key_poses), demonstration.key_poses, strict=True):
        if role not in touching:
            continue
        anchor = task.anchors.get(role)
        needed = (suggested_anchor(pose, task.sub_tasks),) if anchor is None else anchor.objects
        missing |= {name for name in needed if anchor is None or name not in demonstration.object_poses}
    return frozenset(missing)


def list_not_learned(mined: MinedDataset) -> tuple[NotLearned, ...]:
    """The objects that could not be learned or found, then the instructions that are lost with them.

    At most :data:`MAX_RECORDS` of them.
    """
    # By object, numbers of the episodes: one that puts two things is two demonstrations here, see `divided`.
    handled, lost = defaultdict[str, set[int]](set), defaultdict[str, set[int]](set)
    stand_ins, instructions = defaultdict[str, set[str]](set), list[NotLearned]()
    for task in mined.tasks:
        numbers = [one.episode.index for one in task.episodes]
        missing = [missing_objects(one, task) for one in task.aligned]
        for number, demonstration, own in zip(numbers, task.aligned, missing, strict=True):
            anchors = _anchors_of_handled(demonstration, task)
            for name in anchors.keys() | own:
                handled[name].add(number)
            for name in own:
                lost[name].add(number)
            for name, places in anchors.items():
                stand_ins[name] |= places - {name}
        if all(missing):
            named = " and ".join(map(repr, sorted(frozenset[str]().union(*missing))))
            why = f"what they handle is not known: {named}"
            said, count = task.episodes[0].episode.task, len(set(numbers))
            instructions.append(not_learned("instruction", said, count, why))
    found = frozenset[str]().union(*mined.object_poses)
    objects: list[NotLearned] = []
    for name, episodes in sorted(handled.items()):
        if name in mined.surfaces:
            continue
        is_known = name in mined.objects or bool(mined.simulator_objects)
        if name not in found and (name in mined.unlearned or (stand_ins[name] and not is_known)):
            why = mined.unlearned.get(name, UNTOUCHED)
            if marks := " and the ".join(sorted(stand_ins[name])):
                why += f"; what the hand does there is kept relative to the {marks}, with which it goes along"
            objects.append(not_learned("object", name, len(episodes), why))
        elif name in lost and not is_known:
            objects.append(not_learned("object", name, len(episodes), UNTOUCHED))
        elif name in lost:
            why = "the first picture does not show it clearly"
            objects.append(not_learned("demonstrations", name, len(lost[name]), why))
    return (*objects, *instructions)[:MAX_RECORDS]


def _anchors_of_handled(demonstration: Demonstration, task: MinedTask) -> dict[str, set[str]]:
    """By object that contacts of a demonstration belong to, as the instruction says: what anchors them."""
    touching = contact_roles(demonstration.key_poses)
    anchors = defaultdict[str, set[str]](set)
    for role, pose in zip(roles(demonstration.key_poses), demonstration.key_poses, strict=True):
        if role in touching:
            anchor = task.anchors.get(role)
            anchors[suggested_anchor(pose, task.sub_tasks)] |= set() if anchor is None else {anchor.place}
    return anchors
