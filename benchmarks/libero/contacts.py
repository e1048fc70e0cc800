"""Contacts that a task does not ask for: with which objects, and how far these were moved by them."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from lerobot_openspm.envs.libero.simulator import OBJECTS, SUITE, LiberoSimulator

# What was moved farther than this from where it stood.
MOVED_M = 0.010
NOTHING, ROBOT = -1, 0
ROBOT_BODIES = ("robot0_", "gripper0_")


def task_objects(instruction: str, file: Path, suite: str = SUITE) -> set[str]:
    """Those of a suite's `OBJECTS` that an instruction names, or the goal of LIBERO's file of the task.

    A variant of the task may hold another bowl, whose name ends as ours does.
    """
    goal, words, found = file.read_text().partition("(:goal")[2], instruction.lower(), set[str]()
    # The yellow and white mug is no white mug: what a longer name stands for is no shorter one.
    for name in sorted(OBJECTS[suite], key=len, reverse=True):
        words, named = re.subn(rf"\b{name.replace('_', ' ')}\b", "", words)
        if named or re.search(rf"(?<![a-z])({name}_\d|{OBJECTS[suite][name]}(?!\d))", goal):
            found.add(name)
    return found


def shares(found: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Of what episodes told by :meth:`Contacts.told`; None of no episodes.

    Returns:
        ``touched``: share of the episodes in which an object that is not of the task was touched. ``moved``:
        share in which one was moved by more than 1 cm.
    """
    moved = [any(mm > 1000 * MOVED_M for mm in one.values()) for one in found]
    counted = {"touched": [bool(one) for one in found], "moved": moved}
    return {name: round(float(np.mean(true)), 4) if found else None for name, true in counted.items()}


class Contacts:
    """Watches an episode from where its objects stand now.

    The robot touches an object when its arm, its hand, or a part of any object that is more than 1 cm from
    where it stood, so that it was carried, pushed or thrown, is in contact with it at the end of a control
    step. The robot's mount, the table and the walls are neither.

    Args:
        simulator: Where; it must not be reset meanwhile.
        of_task: The objects that may be touched.
    """

    def __init__(self, simulator: LiberoSimulator, of_task: Collection[str]) -> None:
        model, self._data = simulator.sim.model._model, simulator.sim.data._data
        self._things = tuple(simulator.object_poses())
        roots = {model.body(simulator.root_body(name)).id: i for i, name in enumerate(self._things, start=1)}
        owners = np.full(model.nbody, NOTHING)
        # A body comes after the one that it is fixed to.
        for body in range(1, model.nbody):
            is_robot = model.body(body).name.startswith(ROBOT_BODIES)
            inherited = owners[model.body_parentid[body]]
            owners[body] = ROBOT if is_robot else roots.get(body, inherited if inherited > ROBOT else NOTHING)
        self._owners = owners[model.geom_bodyid]
        self._start = self._data.geom_xpos.copy()
        self._watched = [name for name in self._things if name not in of_task]
        self._touched: set[str] = set()

    def note(self) -> None:
        """Look at the contacts of the present moment."""
        moves = (self._owners == ROBOT) | ((self._owners > ROBOT) & (self._moved_m() > MOVED_M))
        pairs = self._data.contact.geom
        geoms, others = np.concatenate([pairs, pairs[:, ::-1]]).T
        touched = self._owners[others]
        found = moves[geoms] & (touched > ROBOT) & (touched != self._owners[geoms])
        self._touched.update(self._things[owner - 1] for owner in touched[found])

    def told(self) -> dict[str, float]:
        """How far from where it stood each object is now, in mm, that was touched and is not of the task.

        That is its farthest moved part, so a bottle that fell over and a drawer that opened were moved. An
        object that is more than 1 cm away was touched, between two moments that were looked at if need be.
        """
        moved_m = self._moved_m()
        farthest = {
            name: moved_m[self._owners == self._things.index(name) + 1].max() for name in self._watched
        }
        return {
            name: round(1000 * float(distance), 1)
            for name, distance in farthest.items()
            if name in self._touched or distance > MOVED_M
        }

    def _moved_m(self) -> np.ndarray:
        """Distance of every geom from where it was."""
        return np.linalg.norm(self._data.geom_xpos - self._start, axis=-1)
