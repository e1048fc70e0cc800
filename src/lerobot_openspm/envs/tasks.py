"""The ten tasks: their instructions, and the physical predicates that say when one is done."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lerobot_openspm.envs import scene

if TYPE_CHECKING:
    from lerobot_openspm.envs.simulator import TabletopSimulator

DRAWER_OPEN_M = 0.10
KNOB_ON_RAD = math.radians(75)
PLATE_TOLERANCE_M = 0.03
UPRIGHT_COSINE = math.cos(math.radians(20))


def _local(simulator: "TabletopSimulator", name: str, frame: str) -> np.ndarray:
    """Origin of object `name` in the frame of object `frame`, (3,) metres."""
    poses = simulator.object_poses()
    return (np.linalg.inv(poses[frame]) @ poses[name])[:3, 3]


def _is_upright(simulator: "TabletopSimulator", name: str) -> bool:
    return bool(simulator.object_poses()[name][2, 2] > UPRIGHT_COSINE)


def _is_left_on(simulator: "TabletopSimulator", name: str, support: str) -> bool:
    """At rest, touching the support and not the hand."""
    touched = simulator.touching(name)
    return support in touched and "hand" not in touched and simulator.is_at_rest(name)


def _rests_near(
    name: str, support: str, radius: float, centre_x: float = 0.0
) -> Callable[["TabletopSimulator"], bool]:
    def done(simulator: "TabletopSimulator") -> bool:
        offset = _local(simulator, name, support)
        near = math.hypot(offset[0] - centre_x, offset[1]) < radius
        return near and _is_upright(simulator, name) and _is_left_on(simulator, name, support)

    return done


def _rests_within(
    name: str, support: str, half: tuple[float, float], height: float
) -> Callable[["TabletopSimulator"], bool]:
    def done(simulator: "TabletopSimulator") -> bool:
        offset = _local(simulator, name, support)
        inside = abs(offset[0]) < half[0] and abs(offset[1]) < half[1] and abs(offset[2] - height) < 0.01
        return inside and _is_upright(simulator, name) and _is_left_on(simulator, name, support)

    return done


def _box_in_bowl(simulator: "TabletopSimulator") -> bool:
    offset = _local(simulator, "box", "bowl")
    inside = (
        math.hypot(offset[0], offset[1]) < scene.BOWL_RADIUS - 0.01 and offset[2] < scene.BOWL_HEIGHT - 0.005
    )
    return inside and _is_upright(simulator, "bowl") and _is_left_on(simulator, "box", "bowl")


def _middle_drawer_open(simulator: "TabletopSimulator") -> bool:
    name = "drawer_middle"
    is_open = simulator.joint_position(name) > DRAWER_OPEN_M and simulator.is_at_rest(name)
    return is_open and "hand" not in simulator.touching(name)


def _bowl_in_top_drawer(simulator: "TabletopSimulator") -> bool:
    offset = _local(simulator, "bowl", "cabinet")
    front = scene.DRAWER_FRONT_X - 0.01 + simulator.joint_position("drawer_top")
    floor = scene.drawer_height(2) + 0.008
    inside = offset[0] < front and abs(offset[1]) < scene.DRAWER_HALF_WIDTH and abs(offset[2] - floor) < 0.02
    return bool(inside) and _is_left_on(simulator, "bowl", "drawer_top")


def _plate_before_stove(simulator: "TabletopSimulator") -> bool:
    offset = _local(simulator, "plate", "stove")
    near = math.hypot(offset[0] - scene.PLATE_GOAL_X, offset[1]) < PLATE_TOLERANCE_M
    return near and _is_left_on(simulator, "plate", "world")


def _stove_on(simulator: "TabletopSimulator") -> bool:
    turned = simulator.joint_position("knob") > KNOB_ON_RAD and simulator.is_at_rest("knob")
    return turned and "hand" not in simulator.touching("knob")


@dataclass(frozen=True)
class Task:
    """A goal on the shared tabletop: what to type, what to say, and when it is reached."""

    name: str
    instruction: str
    is_done: Callable[["TabletopSimulator"], bool]


_CABINET_TOP = ((scene.CABINET_HALF[0] - 0.01, scene.CABINET_HALF[1] - 0.01), scene.CABINET_HEIGHT)
_RACK_SHELF = ((scene.RACK_HALF[0], scene.RACK_HALF[1] - 0.01), scene.RACK_SHELF_HEIGHT)

TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        Task("bowl_on_plate", "put the bowl on the plate", _rests_near("bowl", "plate", 0.035)),
        Task(
            "bowl_on_stove", "put the bowl on the stove", _rests_near("bowl", "stove", 0.05, scene.BURNER_X)
        ),
        Task(
            "bowl_on_cabinet",
            "put the bowl on top of the cabinet",
            _rests_within("bowl", "cabinet", *_CABINET_TOP),
        ),
        Task("box_in_bowl", "put the cream cheese box in the bowl", _box_in_bowl),
        Task(
            "bottle_on_cabinet",
            "put the wine bottle on top of the cabinet",
            _rests_within("bottle", "cabinet", *_CABINET_TOP),
        ),
        Task(
            "bottle_on_rack", "put the wine bottle on the rack", _rests_within("bottle", "rack", *_RACK_SHELF)
        ),
        Task("open_middle_drawer", "open the middle drawer of the cabinet", _middle_drawer_open),
        Task("bowl_in_top_drawer", "open the top drawer and put the bowl inside", _bowl_in_top_drawer),
        Task("push_plate", "push the plate to the front of the stove", _plate_before_stove),
        Task("turn_on_stove", "turn on the stove", _stove_on),
    )
}
TASK_NAMES = tuple(TASKS)


def select_tasks(spec: str) -> list[str]:
    """Expand a task name, a comma list or "all" into task names, in the order given.

    Raises:
        ValueError: A name is unknown, or there is none.
    """
    names = [part.strip() for part in spec.split(",") if part.strip()]
    if names == ["all"]:
        return list(TASK_NAMES)
    unknown = [name for name in names if name not in TASKS]
    if unknown or not names:
        raise ValueError(
            f"unknown openspm_tabletop task {', '.join(unknown) or repr(spec)}; "
            f"expected 'all' or a comma list of: {', '.join(TASK_NAMES)}"
        )
    return names
