"""Small memories built by hand, for tests of memory, control and storage."""

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import read_task
from lerobot_openspm.language.names import TABLE_NAMES
from lerobot_openspm.memory.compose import plan_parts
from lerobot_openspm.memory.entry import Anchor, MemoryEntry, MemoryKeyPose, RetrievalKey
from lerobot_openspm.memory.retrieval import candidates_for, read_instruction
from lerobot_openspm.memory.robot import RobotModel

OPEN_WIDTH = 0.08

# The hand looks down: its z axis is the world's -z.
DOWN = np.diag([1.0, -1.0, -1.0])


def hand_pose(x, y, z, yaw=0.0):
    """A hand that looks down, turned by `yaw` about the vertical."""
    return se3.from_yaw([x, y, z], yaw) @ se3.transform(DOWN, np.zeros(3))


def robot(**changes):
    fields = {
        "close_command": 1.0, "open_command": -1.0, "open_width": OPEN_WIDTH, "metres_per_action": 0.01,
        "radians_per_action": 0.1, "metres_per_step": 0.01,
        "workspace": np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.5]]),
    }  # fmt: skip
    return RobotModel(**{**fields, **changes})


def key_pose(place, T_obj_ee, phase, closed=False, axes=None, **changes):
    fields = {
        "confidence": 1.0, "opening": 0.03 if closed else OPEN_WIDTH, "n_steps": 10,
        "dwell": phase in ("grasp", "release"),
    }  # fmt: skip
    anchor = Anchor(place, place if axes is None else axes)
    return MemoryKeyPose(anchor, T_obj_ee, phase, closed=closed, **{**fields, **changes})


def pick_and_place(target="bowl", landmark="plate", yaw=0.3):
    """Approach from above, grasp, lift, carry, release, leave; every key pose anchored with its own axes."""
    return (
        key_pose(target, hand_pose(0.01, 0.02, 0.12, yaw), "approach"),
        key_pose(target, hand_pose(0.01, 0.02, 0.03, yaw), "approach"),
        key_pose(target, hand_pose(0.01, 0.02, 0.03, yaw), "grasp", closed=True),
        key_pose(target, hand_pose(0.01, 0.02, 0.14, yaw), "lift", closed=True),
        key_pose(landmark, hand_pose(-0.02, 0.0, 0.15, yaw), "pre-place", closed=True),
        key_pose(landmark, hand_pose(-0.02, 0.0, 0.05, yaw), "place", closed=True),
        key_pose(landmark, hand_pose(-0.02, 0.0, 0.05, yaw), "release"),
        key_pose(landmark, hand_pose(-0.02, 0.0, 0.16, yaw), "retreat"),
    )


def entry(instruction="put the bowl on the plate", key_poses=None, object_poses=None, **changes):
    sub_tasks = read_task(instruction)
    objects = [name for sub_task in sub_tasks for name in sub_task.objects]
    if key_poses is None:
        key_poses = pick_and_place(objects[0], objects[-1])
    if object_poses is None:
        object_poses = {name: se3.from_yaw([0.1 * i, 0.2, 0.0], 0.5 * i) for i, name in enumerate(objects)}
    fields = {"quality": 0.9, "version": 1, "source": "local/demos#0", **changes}
    key = RetrievalKey(sub_tasks, tuple(pose.phase for pose in key_poses))
    return MemoryEntry(key, instruction, tuple(key_poses), object_poses=object_poses, **fields)


def semantic_candidates(instruction, entries, names=TABLE_NAMES):
    """Entries that are about all that an instruction says, with their semantic score."""
    return candidates_for(read_instruction(instruction, entries), instruction, entries, names)


def planned(instruction, entries):
    """By what an instruction is carried out, part by part."""
    return plan_parts(instruction, read_instruction(instruction, entries), entries)
