"""Key poses without demonstrations: grasp the centroid from above, release above the landmark.

The paper's memory ablation asks a multimodal model for key poses. Where no such model is to be had this guess
stands in for it. It gets the simulator's object poses and sizes, which the policy proper never sees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lerobot_openspm.envs.libero.simulator import OBJECTS, LiberoSimulator, tasks
from lerobot_openspm.experience import Experience, load_experience
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import WORLD, Anchor, MemoryEntry, MemoryKeyPose, RetrievalKey, SubTask
from lerobot_openspm.memory.instruction import parse_instruction
from lerobot_openspm.mining.mine import name_simulator_poses
from lerobot_openspm.modeling_openspm import OpenSPMPolicy

ABOVE_M = 0.12
PULL_M = 0.15
QUARTER_TURN_RAD = np.pi / 2
FINGER_STEPS, TRAVEL_STEPS = 12, 15
HELD_SHARE = 0.3


def guessing_policy(oracle: Path, folder: Path) -> Path:
    """A checkpoint like the oracle's, whose memory holds one guess a task instead of demonstrations."""
    policy = OpenSPMPolicy.from_pretrained(oracle)
    experience = load_experience(oracle)
    entries = tuple(_guess(task, instruction, experience) for task, instruction in tasks().items())
    policy.experience = replace(experience, entries=entries)
    # A guess may well lie outside what the demonstrations reached.
    policy.config.reach_margin_m = policy.config.min_clearance_m = 1.0
    policy.config.max_jump_m = 2.0
    policy.save_pretrained(folder)
    return folder


def _guess(task: str, instruction: str, experience: Experience) -> MemoryEntry:
    """One task's entry, in the frames of the simulator's objects with the world's axes."""
    simulator = LiberoSimulator(task)
    simulator.reset(0)
    sub_tasks = parse_instruction(instruction)
    names = list(dict.fromkeys(name for sub_task in sub_tasks for name in sub_task.objects))
    layout = name_simulator_poses(simulator.object_poses(), names, experience.objects)
    middles = {name: _middle(simulator, name) for name in names}
    hand = _Guesser(middles, simulator.ee_pose()[:3, :3], experience.robot.open_width)
    simulator.close()
    poses = tuple(pose for sub_task in sub_tasks for pose in hand.follow(sub_task))
    key = RetrievalKey(sub_tasks, tuple(pose.phase for pose in poses))
    return MemoryEntry(key, instruction, poses, 1.0, 1, "geometric guess", layout)


@dataclass(frozen=True)
class _Guesser:
    """Guesses key poses from where objects are.

    Attributes:
        middles: Middle of each object ``(3,)`` from its origin.
        down: Orientation of the hand at home ``(3, 3)``, which points down.
        open_width: Opening of the fingers when they are open.
    """

    middles: dict[str, Array]
    down: Array
    open_width: float

    def follow(self, sub_task: SubTask) -> list[MemoryKeyPose]:
        """Grasp the target's middle from above, do what is asked, let go and rise."""
        target, landmark = sub_task.target, sub_task.landmark or sub_task.target
        up = np.array([0.0, 0.0, ABOVE_M])
        arrival = [
            self._pose(target, up, "approach", False),
            self._pose(target, np.zeros(3), "approach", False),
        ]
        if sub_task.operation == "push":
            return [*arrival, self._pose(landmark, np.array([0.10, 0.0, 0.0]), "push", False)]
        if sub_task.operation == "put":
            way = [
                self._pose(target, up, "lift", True),
                self._pose(landmark, 2 * up, "pre-place", True),
                self._pose(landmark, up, "place", True),
            ]
        elif sub_task.operation == "open":
            way = [self._pose(target, np.array([0.0, PULL_M, 0.0]), "open", True)]
        else:
            way = [self._pose(target, np.zeros(3), "turn", True, QUARTER_TURN_RAD)]
        last = replace(way[-1], closed=False, opening=self.open_width)
        return [
            *arrival,
            self._pose(target, np.zeros(3), "grasp", True),
            *way,
            replace(last, phase="release", dwell=True, n_steps=FINGER_STEPS),
            replace(last, phase="retreat", T_obj_ee=se3.transform(np.eye(3), up) @ last.T_obj_ee),
        ]

    def _pose(self, name: str, offset: Array, phase: str, closed: bool, turn: float = 0.0) -> MemoryKeyPose:
        rotation = se3.from_yaw(np.zeros(3), turn)[:3, :3] @ self.down
        T_obj_ee = se3.transform(rotation, self.middles[name] + offset)
        dwell = phase == "grasp"
        steps = FINGER_STEPS if dwell else TRAVEL_STEPS
        opening = HELD_SHARE * self.open_width if closed else self.open_width
        return MemoryKeyPose(Anchor(name, WORLD), T_obj_ee, phase, 0.5, closed, opening, steps, dwell)


def _middle(simulator: LiberoSimulator, noun: str) -> Array:
    """Centre of an object's box ``(3,)`` from its origin, along the world's axes."""
    name = next(name for name in OBJECTS if name in noun.split())
    model, data = simulator.sim.model._model, simulator.sim.data._data
    body = simulator.root_body(name)
    root = model.body(body).id
    boxes = [
        data.geom_xpos[geom][:, None] + data.geom_xmat[geom].reshape(3, 3) @ _corners(model.geom_aabb[geom])
        for geom in range(model.ngeom)
        if model.body_rootid[model.geom_bodyid[geom]] == model.body_rootid[root] and model.geom_contype[geom]
    ]
    corners = np.concatenate(boxes, axis=1)
    middle = (corners.min(axis=1) + corners.max(axis=1)) / 2
    return middle - simulator.body_pose(body)[:3, 3]


def _corners(aabb: Array) -> Array:
    """The eight corners ``(3, 8)`` of a box given by its centre and half sizes."""
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3, indexing="ij")).reshape(3, 8)
    return aabb[:3, None] + signs * aabb[3:, None]
