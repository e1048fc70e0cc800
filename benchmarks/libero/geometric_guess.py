"""Key poses without demonstrations: made up by a multimodal model, or by geometry alone.

The paper's memory ablation asks a multimodal model for key poses. Where no such model is to be had, geometry
stands in for it: grasp the centroid from above, release above the landmark. Both get the simulator's object
poses and sizes, which the policy proper never sees.

    python -m benchmarks.libero.geometric_guess --oracle=CHECKPOINT --output=FOLDER --source=openai ...

writes a checkpoint whose memory holds one guess a task; evaluate it with `benchmarks.libero.evaluate`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from benchmarks.libero.guessed_key_poses import (
    GuessedKeyPose,
    SceneQuestion,
    SeenObject,
    guess_by_endpoint,
    guess_by_qwen3vl,
)
from benchmarks.results import run

from lerobot_openspm.envs.libero.simulator import OBJECTS, SUITE, LiberoSimulator, tasks
from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.entry import WORLD, Anchor, MemoryEntry, MemoryKeyPose, RetrievalKey
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.mining.phase_labels.endpoint import API_BASE, ChatEndpoint
from lerobot_openspm.mining.phase_labels.qwen3vl import WEIGHTS, Qwen3VL
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.oracle import name_simulator_poses
from lerobot_openspm.types import SubTask

ABOVE_M = 0.12
PULL_M = 0.15
QUARTER_TURN_RAD = np.pi / 2
FINGER_STEPS, TRAVEL_STEPS = 12, 15
HELD_SHARE = 0.3
PICTURE_PX = 256


logger = logging.getLogger(__name__)

Source = Literal["geometric", "openai", "qwen3vl"]
# Makes up key poses; raises PhaseLabelError where there is no answer, or none that can be followed.
KeyPoseSource = Callable[[SceneQuestion], tuple[GuessedKeyPose, ...]]


@dataclass
class GuessConfig:
    """Who makes up the key poses.

    Args:
        oracle: Checkpoint trained with perception=oracle; everything but its memory is kept.
        output: Folder of the checkpoint to write.
        source: "geometric", or a multimodal model: "openai" behind an endpoint, "qwen3vl" in this process.
        model_id: The model, as --policy.judge.model_id names it.
        api_base: Where the endpoint is.
        device: Where "qwen3vl" runs.
    """

    oracle: str
    output: str
    source: Source = "geometric"
    model_id: str | None = None
    api_base: str | None = None
    device: str = "cpu"


def guessing_policy(oracle: Path, folder: Path, source: KeyPoseSource | None = None) -> Path:
    """A checkpoint like the oracle's, whose memory holds one guess a task instead of demonstrations.

    Args:
        oracle: The checkpoint.
        folder: Where to write the new one.
        source: The model to ask; geometry if not given.

    Raises:
        PhaseLabelError: Nothing that the model said can be followed, for any task.
    """
    policy = OpenSPMPolicy.from_pretrained(oracle)
    memory = read_memory(oracle)
    entries, refused = list[MemoryEntry](), dict[str, str]()
    for task, instruction in tasks().items():
        try:
            entries.append(_guess(task, instruction, memory, source))
        except PhaseLabelError as error:
            logger.warning("no key poses for %r: %s", instruction, error)
            refused[task] = str(error)
    if not entries:
        raise PhaseLabelError(f"no task has key poses that can be followed; the last: {refused.popitem()[1]}")
    policy.memory = replace(memory, entries=tuple(entries))
    # A guess may well lie outside what the demonstrations reached.
    policy.config.reach_margin_m = policy.config.min_clearance_m = 1.0
    policy.save_pretrained(folder)
    return folder


def source_of(config: GuessConfig) -> KeyPoseSource | None:
    """The model that a configuration names; None for geometry.

    Raises:
        PhaseLabelError: The endpoint's model is not named.
        PerceptionError: Qwen3-VL cannot be loaded.
    """
    if config.source == "geometric":
        return None
    if config.source == "qwen3vl":
        model = Qwen3VL.from_pretrained(config.model_id or WEIGHTS, config.device)
        return partial(guess_by_qwen3vl, model=model)
    if not config.model_id:
        raise PhaseLabelError("source=openai needs the name of a model; pass --model_id=NAME")
    return partial(guess_by_endpoint, endpoint=ChatEndpoint(config.api_base or API_BASE, config.model_id))


def _guess(task: str, instruction: str, memory: Memory, source: KeyPoseSource | None) -> MemoryEntry:
    """One task's entry, in the frames of the simulator's objects with the world's axes."""
    simulator = LiberoSimulator(task, PICTURE_PX if source else None)
    simulator.reset(0)
    sub_tasks = parse_instruction(instruction)
    names = list(dict.fromkeys(name for sub_task in sub_tasks for name in sub_task.objects))
    layout = name_simulator_poses(simulator.object_poses(), names, memory.objects)
    boxes = {name: _box(simulator, name) for name in names}
    down, open_width = simulator.ee_pose()[:3, :3], memory.robot.open_width
    if source is None:
        hand = _Guesser({name: middle for name, (middle, _) in boxes.items()}, down, open_width)
        poses = tuple(pose for sub_task in sub_tasks for pose in hand.follow(sub_task))
    else:
        objects = tuple(
            SeenObject(name, layout[name][:3, 3] + middle, size) for name, (middle, size) in boxes.items()
        )
        pictures = simulator.images()
        at = simulator.ee_pose()[:3, 3]
        guessed = source(SceneQuestion(instruction, objects, at, open_width, pictures))
        poses = remembered(guessed, sub_tasks, layout, down, open_width)
    simulator.close()
    key = RetrievalKey(sub_tasks, tuple(pose.phase for pose in poses))
    return MemoryEntry(
        key, instruction, poses, 1.0, 1, "geometric guess" if source is None else "model", layout
    )


def remembered(
    guessed: Sequence[GuessedKeyPose],
    sub_tasks: Sequence[SubTask],
    layout: Mapping[str, Array],
    down: Array,
    open_width: float,
) -> tuple[MemoryKeyPose, ...]:
    """Key poses in the world as a memory keeps them: relative to the object that the instruction suggests.

    Args:
        guessed: What the model said.
        sub_tasks: What the instruction asks for; letting go or having pushed ends one.
        layout: Poses ``T_world_obj`` of the named objects.
        down: Orientation ``(3, 3)`` of the hand that the model's rotations turn.
        open_width: Opening of the open fingers.
    """
    found, done = list[MemoryKeyPose](), 0
    for pose, after in zip(guessed, [*guessed[1:], None], strict=True):
        index = min(done - (pose.phase == "retreat" and done > 0), len(sub_tasks) - 1)
        sub_task = sub_tasks[index]
        arriving = pose.phase in ("pre-place", "place", "release", "retreat", "push")
        anchor = Anchor(sub_task.landmark if arriving and sub_task.landmark else sub_task.target, WORLD)
        T_world_ee = se3.transform(se3.exp_so3(pose.rotation) @ down, pose.position)
        dwell = pose.phase in ("grasp", "release")
        found.append(
            MemoryKeyPose(
                anchor, se3.inverse(anchor.frame(layout)) @ T_world_ee, pose.phase, 0.5, pose.closed,
                HELD_SHARE * open_width if pose.closed else open_width,
                FINGER_STEPS if dwell else TRAVEL_STEPS, dwell, sub_task=index,
            )
        )  # fmt: skip
        goes_on = pose.phase == "push" and after is not None and after.phase == "push"
        done += pose.phase in ("release", "push") and not goes_on
    return tuple(found)


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


def _box(simulator: LiberoSimulator, noun: str) -> tuple[Array, Array]:
    """Centre of an object's box ``(3,)`` from its origin, and its size ``(3,)``, along the world's axes."""
    name = next(name for name in OBJECTS[SUITE] if name in noun.split())
    model, data = simulator.sim.model._model, simulator.sim.data._data
    body = simulator.root_body(name)
    root = model.body(body).id
    boxes = [
        data.geom_xpos[geom][:, None] + data.geom_xmat[geom].reshape(3, 3) @ _corners(model.geom_aabb[geom])
        for geom in range(model.ngeom)
        if model.body_rootid[model.geom_bodyid[geom]] == model.body_rootid[root] and model.geom_contype[geom]
    ]
    corners = np.concatenate(boxes, axis=1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    return (low + high) / 2 - simulator.body_pose(body)[:3, 3], high - low


def _corners(aabb: Array) -> Array:
    """The eight corners ``(3, 8)`` of a box given by its centre and half sizes."""
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3, indexing="ij")).reshape(3, 8)
    return aabb[:3, None] + signs * aabb[3:, None]


def main(config: GuessConfig) -> dict[str, object]:
    """Write the checkpoint; says for which tasks there are key poses."""
    folder = guessing_policy(Path(config.oracle), Path(config.output), source_of(config))
    guessed = [entry.language for entry in read_memory(folder).entries]
    missing = [instruction for instruction in tasks().values() if instruction not in guessed]
    return {"source": config.source, "guessed": guessed, "refused": missing, "output": config.output}


if __name__ == "__main__":
    run(GuessConfig, main)
