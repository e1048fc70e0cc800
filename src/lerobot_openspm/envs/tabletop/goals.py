"""What a task on the tabletop is, and the physical predicates that say when one is done."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.placement import Layout
from lerobot_openspm.envs.tabletop.settings import Setting

if TYPE_CHECKING:
    from lerobot_openspm.envs.tabletop.simulator import TabletopSimulator

    Predicate = Callable[[TabletopSimulator], bool]

DRAWER_OPEN_M = 0.10
KNOB_ON_RAD = math.radians(75)
PLATE_TOLERANCE_M = 0.03
# Of other things, from where the plate is pushed to.
BEFORE_STOVE_M = 0.05
STEPS_PER_PART = 300
UPRIGHT_COSINE = math.cos(math.radians(20))


@dataclass(frozen=True)
class Task:
    """A goal on the shared tabletop: what to type, what to say, and when it is reached.

    Attributes:
        name: What to type.
        instruction: What to say.
        is_done: Whether the goal is reached now.
        parts: Names of the tasks that it is made of, in the order of the instruction; none for the ten.
        setting: What else stands there; None where nothing does.
        n_parts: How many parts its time is for, see `max_steps`.
        has_room: Whether a layout leaves room for it; None where every one does.
    """

    name: str
    instruction: str
    is_done: Predicate
    parts: tuple[str, ...] = ()
    setting: Setting | None = None
    n_parts: int = 1
    has_room: Callable[[Layout], bool] | None = None

    @property
    def max_steps(self) -> int:
        """Control steps after which an episode ends by default: `STEPS_PER_PART` for each part."""
        return STEPS_PER_PART * self.n_parts


def by_name(*tasks: Task) -> dict[str, Task]:
    """Tasks by their names."""
    return {task.name: task for task in tasks}


def all_of(name: str, instruction: str, tasks: Mapping[str, Task], *parts: str) -> Task:
    """A task whose goal is that the goals of all its parts, named among `tasks`, hold at the same time."""

    def done(simulator: TabletopSimulator) -> bool:
        return all(tasks[part].is_done(simulator) for part in parts)

    asked = [one for part in parts if (one := tasks[part].has_room) is not None]

    def has_room(layout: Layout) -> bool:
        return all(one(layout) for one in asked)

    n_parts = sum(tasks[part].n_parts for part in parts)
    return Task(name, instruction, done, parts, n_parts=n_parts, has_room=has_room if asked else None)


def _local(simulator: TabletopSimulator, name: str, frame: str) -> np.ndarray:
    """Origin of object `name` in the frame of object `frame`, (3,) metres."""
    poses = simulator.object_poses()
    return (np.linalg.inv(poses[frame]) @ poses[name])[:3, 3]


def _is_upright(simulator: TabletopSimulator, name: str) -> bool:
    return bool(simulator.object_poses()[name][2, 2] > UPRIGHT_COSINE)


def _is_left_on(simulator: TabletopSimulator, name: str, support: str) -> bool:
    """At rest, touching the support and not the hand."""
    touched = simulator.touching(name)
    return support in touched and "hand" not in touched and simulator.is_at_rest(name)


def rests_near(name: str, support: str, radius: float, centre_x: float = 0.0) -> Predicate:
    """Whether an object was left within `radius` of a point on the x axis of another one's frame."""

    def done(simulator: TabletopSimulator) -> bool:
        offset = _local(simulator, name, support)
        near = math.hypot(offset[0] - centre_x, offset[1]) < radius
        return near and _is_upright(simulator, name) and _is_left_on(simulator, name, support)

    return done


def rests_within(name: str, support: str, half: tuple[float, float], height: float) -> Predicate:
    """Whether an object was left within half widths of another one's middle, at a height in its frame."""

    def done(simulator: TabletopSimulator) -> bool:
        offset = _local(simulator, name, support)
        inside = abs(offset[0]) < half[0] and abs(offset[1]) < half[1] and abs(offset[2] - height) < 0.01
        return inside and _is_upright(simulator, name) and _is_left_on(simulator, name, support)

    return done


def in_top_drawer(name: str) -> Predicate:
    """Whether an object was left on the floor of the top drawer."""

    def done(simulator: TabletopSimulator) -> bool:
        offset = _local(simulator, name, "cabinet")
        front = scene.DRAWER_FRONT_X - 0.01 + simulator.joint_position("drawer_top")
        across, above = abs(offset[1]), abs(offset[2] - scene.drawer_height(2) - 0.008)
        inside = offset[0] < front and across < scene.DRAWER_HALF_WIDTH and above < 0.02
        return bool(inside) and _is_left_on(simulator, name, "drawer_top")

    return done


def before_stove(name: str) -> Predicate:
    """Whether an object was left standing on the table about where the plate is pushed to."""

    def done(simulator: TabletopSimulator) -> bool:
        offset = _local(simulator, name, "stove")
        near = math.hypot(offset[0] - scene.PLATE_GOAL_X, offset[1]) < BEFORE_STOVE_M
        return near and _is_upright(simulator, name) and _is_left_on(simulator, name, "world")

    return done


def box_in_bowl(simulator: TabletopSimulator) -> bool:
    """Whether the box was left in the upright bowl, below its rim."""
    offset = _local(simulator, "box", "bowl")
    inside = (
        math.hypot(offset[0], offset[1]) < scene.BOWL_RADIUS - 0.01 and offset[2] < scene.BOWL_HEIGHT - 0.005
    )
    return inside and _is_upright(simulator, "bowl") and _is_left_on(simulator, "box", "bowl")


def middle_drawer_open(simulator: TabletopSimulator) -> bool:
    """Whether the middle drawer was left open."""
    name = "drawer_middle"
    is_open = simulator.joint_position(name) > DRAWER_OPEN_M and simulator.is_at_rest(name)
    return is_open and "hand" not in simulator.touching(name)


def plate_before_stove(simulator: TabletopSimulator) -> bool:
    """Whether the plate was left on the table where it belongs in front of the stove."""
    offset = _local(simulator, "plate", "stove")
    near = math.hypot(offset[0] - scene.PLATE_GOAL_X, offset[1]) < PLATE_TOLERANCE_M
    return near and _is_left_on(simulator, "plate", "world")


def stove_on(simulator: TabletopSimulator) -> bool:
    """Whether the knob was turned far enough, and let go of."""
    turned = simulator.joint_position("knob") > KNOB_ON_RAD and simulator.is_at_rest("knob")
    return turned and "hand" not in simulator.touching("knob")


CABINET_TOP = ((scene.CABINET_HALF[0] - 0.01, scene.CABINET_HALF[1] - 0.01), scene.CABINET_HEIGHT)
RACK_SHELF = ((scene.RACK_HALF[0], scene.RACK_HALF[1] - 0.01), scene.RACK_SHELF_HEIGHT)
# What is wider than the shelf stands on its rails.
RACK_RAILS = (RACK_SHELF[0], scene.RACK_SHELF_HEIGHT + scene.RACK_RAIL_HEIGHT)
