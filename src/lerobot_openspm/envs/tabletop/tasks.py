"""The ten tasks: their instructions, and the physical predicates that say when one is done.

Beside them, five tasks that are made of two of the ten: the parts can be demonstrated, the whole never is.
And five of the ten with a second bowl on the table, where the instruction says which bowl is meant; and all
ten with everything anywhere on the table, beside distractors and a second object of the kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lerobot_openspm.envs.selection import select
from lerobot_openspm.envs.tabletop import scene, settings
from lerobot_openspm.envs.tabletop.settings import Setting

if TYPE_CHECKING:
    from lerobot_openspm.envs.tabletop.simulator import TabletopSimulator

    Predicate = Callable[[TabletopSimulator], bool]

DRAWER_OPEN_M = 0.10
KNOB_ON_RAD = math.radians(75)
PLATE_TOLERANCE_M = 0.03
STEPS_PER_PART = 300
# Goals have to hold for so many control steps in a row.
SUCCESS_HOLD_STEPS = 5
UPRIGHT_COSINE = math.cos(math.radians(20))


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


def _rests_near(name: str, support: str, radius: float, centre_x: float = 0.0) -> Predicate:
    """Whether an object was left within `radius` of a point on the x axis of another one's frame."""

    def done(simulator: TabletopSimulator) -> bool:
        offset = _local(simulator, name, support)
        near = math.hypot(offset[0] - centre_x, offset[1]) < radius
        return near and _is_upright(simulator, name) and _is_left_on(simulator, name, support)

    return done


def _rests_within(name: str, support: str, half: tuple[float, float], height: float) -> Predicate:
    """Whether an object was left within half widths of another one's middle, at a height in its frame."""

    def done(simulator: TabletopSimulator) -> bool:
        offset = _local(simulator, name, support)
        inside = abs(offset[0]) < half[0] and abs(offset[1]) < half[1] and abs(offset[2] - height) < 0.01
        return inside and _is_upright(simulator, name) and _is_left_on(simulator, name, support)

    return done


def _box_in_bowl(simulator: TabletopSimulator) -> bool:
    offset = _local(simulator, "box", "bowl")
    inside = (
        math.hypot(offset[0], offset[1]) < scene.BOWL_RADIUS - 0.01 and offset[2] < scene.BOWL_HEIGHT - 0.005
    )
    return inside and _is_upright(simulator, "bowl") and _is_left_on(simulator, "box", "bowl")


def _middle_drawer_open(simulator: TabletopSimulator) -> bool:
    name = "drawer_middle"
    is_open = simulator.joint_position(name) > DRAWER_OPEN_M and simulator.is_at_rest(name)
    return is_open and "hand" not in simulator.touching(name)


def _bowl_in_top_drawer(simulator: TabletopSimulator) -> bool:
    offset = _local(simulator, "bowl", "cabinet")
    front = scene.DRAWER_FRONT_X - 0.01 + simulator.joint_position("drawer_top")
    floor = scene.drawer_height(2) + 0.008
    inside = offset[0] < front and abs(offset[1]) < scene.DRAWER_HALF_WIDTH and abs(offset[2] - floor) < 0.02
    return bool(inside) and _is_left_on(simulator, "bowl", "drawer_top")


def _plate_before_stove(simulator: TabletopSimulator) -> bool:
    offset = _local(simulator, "plate", "stove")
    near = math.hypot(offset[0] - scene.PLATE_GOAL_X, offset[1]) < PLATE_TOLERANCE_M
    return near and _is_left_on(simulator, "plate", "world")


def _stove_on(simulator: TabletopSimulator) -> bool:
    turned = simulator.joint_position("knob") > KNOB_ON_RAD and simulator.is_at_rest("knob")
    return turned and "hand" not in simulator.touching("knob")


@dataclass(frozen=True)
class Task:
    """A goal on the shared tabletop: what to type, what to say, and when it is reached.

    Attributes:
        name: What to type.
        instruction: What to say.
        is_done: Whether the goal is reached now.
        parts: Names of the tasks that it is made of, in the order of the instruction; none for the ten.
        setting: What else stands there; None where nothing does.
    """

    name: str
    instruction: str
    is_done: Predicate
    parts: tuple[str, ...] = ()
    setting: Setting | None = None

    @property
    def max_steps(self) -> int:
        """Control steps after which an episode ends by default: `STEPS_PER_PART` for each part."""
        return STEPS_PER_PART * max(1, len(self.parts))


def _by_name(*tasks: Task) -> dict[str, Task]:
    return {task.name: task for task in tasks}


_CABINET_TOP = ((scene.CABINET_HALF[0] - 0.01, scene.CABINET_HALF[1] - 0.01), scene.CABINET_HEIGHT)
_RACK_SHELF = ((scene.RACK_HALF[0], scene.RACK_HALF[1] - 0.01), scene.RACK_SHELF_HEIGHT)
_BOTTLE_ON_CABINET = _rests_within("bottle", "cabinet", *_CABINET_TOP)
_BOTTLE_ON_RACK = _rests_within("bottle", "rack", *_RACK_SHELF)
_BOWL_ON_CABINET = _rests_within("bowl", "cabinet", *_CABINET_TOP)
_BOWL_ON_PLATE = _rests_near("bowl", "plate", 0.035)
_BOWL_ON_STOVE = _rests_near("bowl", "stove", 0.05, scene.BURNER_X)

TASKS = _by_name(
    Task("bowl_on_plate", "put the bowl on the plate", _BOWL_ON_PLATE),
    Task("bowl_on_stove", "put the bowl on the stove", _BOWL_ON_STOVE),
    Task("bowl_on_cabinet", "put the bowl on top of the cabinet", _BOWL_ON_CABINET),
    Task("box_in_bowl", "put the cream cheese box in the bowl", _box_in_bowl),
    Task("bottle_on_cabinet", "put the wine bottle on top of the cabinet", _BOTTLE_ON_CABINET),
    Task("bottle_on_rack", "put the wine bottle on the rack", _BOTTLE_ON_RACK),
    Task("open_middle_drawer", "open the middle drawer of the cabinet", _middle_drawer_open),
    Task("bowl_in_top_drawer", "open the top drawer and put the bowl inside", _bowl_in_top_drawer),
    Task("push_plate", "push the plate to the front of the stove", _plate_before_stove),
    Task("turn_on_stove", "turn on the stove", _stove_on),
)
TASK_NAMES = tuple(TASKS)


def _compound(name: str, *parts: str) -> Task:
    """A task whose goal is that the goals of all its parts hold at the same time."""

    def done(simulator: TabletopSimulator) -> bool:
        return all(TASKS[part].is_done(simulator) for part in parts)

    return Task(name, " and ".join(TASKS[part].instruction for part in parts), done, parts)


# Not among "all": nothing demonstrates them as a whole. The third and the fourth depend on their order: the
# second part takes place where the first one has put something.
COMPOUND_TASKS = _by_name(
    _compound("bowl_on_plate_then_stove", "bowl_on_plate", "turn_on_stove"),
    _compound("bottle_on_rack_then_box_in_bowl", "bottle_on_rack", "box_in_bowl"),
    _compound("bowl_on_plate_then_box_in_bowl", "bowl_on_plate", "box_in_bowl"),
    _compound("push_plate_then_bowl_on_plate", "push_plate", "bowl_on_plate"),
    _compound("open_drawer_then_bottle_on_cabinet", "open_middle_drawer", "bottle_on_cabinet"),
)


def _of_two(name: str, like: str, instruction: str, setting: Setting) -> Task:
    """A task of the ten, done with the one of two objects that the instruction names."""
    return Task(name, instruction, TASKS[like].is_done, (like,), setting)


# Not among "all" either: no demonstration shows two bowls.
TWO_BOWL_TASKS = _by_name(
    _of_two(
        "bowl_next_to_rack_on_plate",
        "bowl_on_plate",
        "pick up the bowl next to the rack and put it on the plate",
        Setting("bowl", settings.next_to("rack")),
    ),
    _of_two(
        "bowl_between_plate_and_box_on_stove",
        "bowl_on_stove",
        "put the bowl between the plate and the cream cheese box on the stove",
        Setting("bowl", settings.between("plate", "box")),
    ),
    _of_two(
        "bowl_next_to_box_on_cabinet",
        "bowl_on_cabinet",
        "pick up the bowl next to the cream cheese box and place it on top of the cabinet",
        Setting("bowl", settings.next_to("box")),
    ),
    _of_two(
        "left_bowl_on_plate",
        "bowl_on_plate",
        "put the left bowl on the plate",
        Setting("bowl", settings.left),
    ),
    _of_two(
        "right_bowl_on_stove",
        "bowl_on_stove",
        "put the right bowl on the stove",
        Setting("bowl", settings.right),
    ),
)


def _anywhere(like: str, instruction: str, twin: str, is_clear: settings.Condition) -> Task:
    return _of_two(f"{like}_anywhere", like, instruction, Setting(twin, is_clear, is_anywhere=True))


# Not among "all" either. A second cabinet or stove finds no room: there a second bowl stands about.
ANYWHERE_TASKS = _by_name(
    _anywhere("bowl_on_plate", "put the left bowl on the plate", "bowl", settings.left),
    _anywhere("bowl_on_stove", "put the right bowl on the stove", "bowl", settings.right),
    _anywhere(
        "bowl_on_cabinet",
        "pick up the bowl next to the cream cheese box and place it on top of the cabinet",
        "bowl",
        settings.next_to("box"),
    ),
    _anywhere("box_in_bowl", "put the left cream cheese box in the bowl", "box", settings.left),
    _anywhere(
        "bottle_on_cabinet", "put the right wine bottle on top of the cabinet", "bottle", settings.right
    ),
    _anywhere("bottle_on_rack", "put the left wine bottle on the rack", "bottle", settings.left),
    _anywhere("open_middle_drawer", "open the middle drawer of the cabinet", "bowl", settings.not_told),
    _anywhere(
        "bowl_in_top_drawer", "open the top drawer and put the left bowl inside", "bowl", settings.left
    ),
    _anywhere("push_plate", "push the right plate to the front of the stove", "plate", settings.right),
    _anywhere("turn_on_stove", "turn on the stove", "bowl", settings.not_told),
)
# Every task that can be named; a task's number is its place here.
ANY_TASK = {**TASKS, **COMPOUND_TASKS, **TWO_BOWL_TASKS, **ANYWHERE_TASKS}
SELECTIONS = {
    "all": TASK_NAMES,
    "compound": tuple(COMPOUND_TASKS),
    "two_bowls": tuple(TWO_BOWL_TASKS),
    "anywhere": tuple(ANYWHERE_TASKS),
}


def select_tasks(spec: str) -> list[str]:
    """Names of the tasks that a name, a comma list or a selection ("all": the ten) stands for.

    Raises:
        ValueError: A name is unknown, or there is none.
    """
    return select(spec, ANY_TASK, SELECTIONS, "openspm_tabletop")
