"""Instructions taught by one drawn demonstration each, and the entries that the policy would act by.

A demonstration goes the way of a real one: its task is read, its key poses are mined, its objects are where
the hand touched them, and its entry is written as JSON and read again. Only the images are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.errors import InstructionError, OpenSPMError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.language.instruction import read_tasks
from lerobot_openspm.memory.compose import plan_parts
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.indexed_entries import known_names
from lerobot_openspm.memory.retrieval import read_instruction
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.memory.schema import entry_from_json, entry_to_json
from lerobot_openspm.mining.anchors import Demonstration
from lerobot_openspm.mining.entries import task_entries
from lerobot_openspm.mining.key_poses import find_key_poses
from lerobot_openspm.mining.objects import contact_cues
from lerobot_openspm.mining.outcomes import carried_to
from lerobot_openspm.mining.processor import compare, mine_episodes
from lerobot_openspm.mining.signals import Episode

ROBOT = RobotModel(1.0, -1.0, 0.08, 0.01, 0.1, 0.01, np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.5]]))
# Opening of the fingers around a thing, metres; metres that the hand and the fingers go in a step.
_HELD_M, _SPEED_M, _FINGERS_M = 0.03, 0.02, 0.0125
# Heights of a drawn hand above the table: on its way, at a thing, where it lets go.
_ABOVE_M, _AT_M, _LET_GO_M = 0.16, 0.02, 0.05
_GRIP_STEPS = 10
_HAND_DOWN = np.diag([1.0, -1.0, -1.0])
# A rival's demonstration is rated as high as it can be, that of what is meant as low.
_RIVAL_QUALITY, _MEANT_QUALITY = 1.0, 0.0


def teach_each(instructions: Sequence[str], rng: np.random.Generator) -> list[MemoryEntry]:
    """Teach instructions one after another to one memory, each by a demonstration drawn at random places.

    Raises:
        OpenSPMError: One of them gives no entry.
    """
    entries: list[MemoryEntry] = []
    for number, instruction in enumerate(instructions):
        entries.append(_teach(instruction, number, entries, rng))
    return entries


def _teach(
    instruction: str, number: int, known: Sequence[MemoryEntry], rng: np.random.Generator
) -> MemoryEntry:
    tasks = read_tasks([instruction], known_names(known))
    if instruction not in tasks:
        raise OpenSPMError(f"{instruction!r} has no words; give it some in everyday.json")
    episode = _drawn(instruction, number, len(tasks[instruction]), rng)
    (mined,), _ = mine_episodes([episode], partial(find_key_poses, robot=ROBOT), known_names(known))
    cues = reversed(contact_cues(mined))
    layout = {cue.name: se3.transform(np.eye(3), [*cue.point_world[:2], 0.0]) for cue in cues}
    # What is only let go of in a part of something, as in a caddy's compartment, lies where the hand ended.
    end = se3.transform(np.eye(3), [*mined.key_poses[-1].T_world_ee[:2, 3], 0.0])
    for name in (name for sub_task in mined.sub_tasks for name in sub_task.objects):
        layout.setdefault(name, end)
    ends = carried_to(Demonstration(mined.key_poses, layout), mined.sub_tasks)
    (task,) = compare([mined], [layout], [ends], {})
    found = task_entries(task, "drawn")
    if not found:
        raise OpenSPMError(f"a demonstration of {instruction!r} gave no entry; it touched {sorted(layout)}")
    return entry_from_json(entry_to_json(found[0]), instruction)


def _drawn(task: str, number: int, n_takes: int, rng: np.random.Generator) -> Episode:
    """An episode in which so many things are taken, each at one random place, and let go at another."""
    path = [np.array([0.0, 0.0, 0.3])]
    closed = [False]

    def go(place: Array, height: float, grip: bool) -> None:
        goal = np.array([*place, height])
        n = max(1, int(np.ceil(np.linalg.norm(goal - path[-1]) / _SPEED_M)))
        path.extend(np.linspace(path[-1], goal, n + 1)[1:])
        closed.extend([grip] * n)

    for _ in range(n_takes):
        start, end = rng.uniform(-0.3, 0.3, (2, 2))
        go(start, _ABOVE_M, False)
        go(start, _AT_M, False)
        path.extend([path[-1]] * _GRIP_STEPS)
        closed.extend([True] * _GRIP_STEPS)
        go(start, _ABOVE_M, True)
        go(end, _ABOVE_M, True)
        go(end, _LET_GO_M, True)
        path.extend([path[-1]] * _GRIP_STEPS)
        closed.extend([False] * _GRIP_STEPS)
        go(end, _ABOVE_M, False)
    return _episode(task, number, np.array(path), np.array(closed))


def _episode(task: str, number: int, path: Array, closed: np.ndarray) -> Episode:
    openings = [ROBOT.open_width]
    for grip in closed[1:]:
        goal = _HELD_M if grip else ROBOT.open_width
        openings.append(openings[-1] + float(np.clip(goal - openings[-1], -_FINGERS_M, _FINGERS_M)))
    steps = np.diff(path, axis=0, append=path[-1:]) / ROBOT.metres_per_action
    commands = np.where(closed, ROBOT.close_command, ROBOT.open_command)
    actions = np.column_stack([steps, np.zeros_like(steps), commands])
    T_world_ee = se3.transform(np.broadcast_to(_HAND_DOWN, (len(path), 3, 3)), path)
    return Episode(number, task, 0, T_world_ee, np.array(openings), actions)


def acted_entries(
    instruction: str,
    entries: Sequence[MemoryEntry],
    is_meant: Callable[[MemoryEntry], bool],
) -> tuple[MemoryEntry, ...]:
    """The entries that would act on an instruction, where everything but the words speaks for others.

    All objects of every entry that is considered are in the scene. They stand as in the demonstration of
    the likeliest entry that is not meant, which also has the best quality, and what is meant the worst.

    Returns:
        One for each part that the instruction is carried out in; none where it is refused.
    """
    rated = [replace(one, quality=_MEANT_QUALITY if is_meant(one) else _RIVAL_QUALITY) for one in entries]
    try:
        parts = plan_parts(instruction, read_instruction(instruction, rated), rated)
    except InstructionError:
        return ()
    context = PlanningContext(rated, {}, ROBOT)
    T_world_ee = se3.transform(_HAND_DOWN, [0.0, 0.0, 0.3])
    acted: list[MemoryEntry] = []
    for part in parts:
        rivals = sorted(part, key=lambda one: (not is_meant(one.sources[0]), one.semantic))
        layout = {name: T for one in rivals for name, T in one.entry.object_poses.items()}
        best = context.rank(part, layout, T_world_ee)[0].entry
        acted.append(next(one.sources[0] for one in part if one.entry is best))
    return tuple(acted)
