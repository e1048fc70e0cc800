"""What touches what in a MuJoCo simulation, frame by frame: the ground truth behind key poses."""

# mujoco ships no stubs for its compiled part.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

# As for the tabletop's own predicates: surfaces nearer than this touch.
TOUCHING_M = 0.0005
# A finger squeezes a thing when it presses on it within 45 degrees of the way to the other finger.
SQUEEZING_COSINE = math.sqrt(0.5)

ThingKind = Literal["free", "slide", "hinge"]
KINDS: dict[int, ThingKind] = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
}


@dataclass(frozen=True)
class ThingTrack:
    """One thing that can move and what the hand did to it, `n` frames long.

    Attributes:
        name: Its body in the MuJoCo model.
        kind: What it can do: move freely, slide, turn.
        T_world_thing: Its poses ``(n, 4, 4)``.
        squeezed: Whether each finger presses on it towards the other one, ``(n, 2)``.
        touched: Whether any part of the robot touches it, ``(n,)``.
    """

    name: str
    kind: ThingKind
    T_world_thing: Array
    squeezed: NDArray[np.bool_]
    touched: NDArray[np.bool_]


class ContactSensor:
    """Records the contacts between a robot's hand and everything that can move.

    A "thing" is a body with a joint of its own that is no part of the robot, with all that is fixed to it.

    Args:
        model: MuJoCo's model.
        data: MuJoCo's data, read at every :meth:`record`.
        fingers: Names of the two finger bodies.
    """

    def __init__(self, model: Any, data: Any, fingers: Sequence[str]) -> None:
        self._model, self._data = model, data
        weld = model.body_weldid
        self._fingers = [int(weld[model.body(name).id]) for name in fingers]
        robot = int(model.body_rootid[self._fingers[0]])
        own = [int(b) for b in np.unique(weld) if b > 0 and model.body_jntnum[b] > 0]
        self._things = [b for b in own if model.body_rootid[b] != robot]
        # Of every geom: the body that it moves with, and whether it is the robot's.
        self._moves_with = weld[model.geom_bodyid]
        self._is_robot = model.body_rootid[model.geom_bodyid] == robot
        collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        self._finger_geoms = [np.flatnonzero((self._moves_with == f) & collides) for f in self._fingers]
        self._poses: list[Array] = []
        self._contacts: list[NDArray[np.bool_]] = []

    def record(self) -> None:
        """Note the poses of all things and what the hand touches now."""
        self._poses.append(np.stack([self._pose(thing) for thing in self._things]))
        self._contacts.append(self._touching())

    def tracks(self) -> list[ThingTrack]:
        """Everything that the hand ever touched."""
        poses, contacts = np.stack(self._poses, axis=1), np.stack(self._contacts, axis=1)
        return [
            ThingTrack(
                self._model.body(body).name,
                KINDS[int(self._model.jnt_type[self._model.body_jntadr[body]])],
                poses[i],
                contacts[i, :, :2],
                contacts[i, :, 2],
            )
            for i, body in enumerate(self._things)
            if contacts[i].any()
        ]

    def _pose(self, body: int) -> Array:
        return se3.transform(self._data.xmat[body].reshape(3, 3), self._data.xpos[body])

    def _touching(self) -> NDArray[np.bool_]:
        """Per thing ``(3,)``: left and right finger squeeze it, the robot touches it."""
        found = np.zeros((len(self._things), 3), bool)
        middles = [self._data.geom_xpos[geoms].mean(axis=0) for geoms in self._finger_geoms]
        across = middles[1] - middles[0]
        inwards = across / max(float(np.linalg.norm(across)), 1e-9) * np.array([[1.0], [-1.0]])
        for contact in self._data.contact:
            robots, other = int(contact.geom1), int(contact.geom2)
            pushing = contact.frame[:3]
            if self._is_robot[other]:
                robots, other, pushing = other, robots, -pushing
            body = int(self._moves_with[other])
            if not self._is_robot[robots] or body not in self._things or contact.dist > TOUCHING_M:
                continue
            row = found[self._things.index(body)]
            row[2] = True
            for finger in (0, 1):
                presses = float(pushing @ inwards[finger]) > SQUEEZING_COSINE
                row[finger] |= presses and self._moves_with[robots] == self._fingers[finger]
        return found
