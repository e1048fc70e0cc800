"""The ten tasks: their instructions, and by which predicates of `goals` they are done.

Beside them, five tasks that are made of two of the ten: the parts can be demonstrated, the whole never is.
And five of the ten with a second bowl on the table, where the instruction says which bowl is meant; and all
ten with everything anywhere on the table, beside distractors and a second object of the kind. And twenty that
put something where the ten put something else, see `combinations`.
"""

from __future__ import annotations

from lerobot_openspm.envs.selection import select
from lerobot_openspm.envs.tabletop import scene, settings
from lerobot_openspm.envs.tabletop.combinations import COMBINATION_TASKS
from lerobot_openspm.envs.tabletop.goals import (
    CABINET_TOP,
    RACK_SHELF,
    Task,
    all_of,
    box_in_bowl,
    by_name,
    in_top_drawer,
    middle_drawer_open,
    plate_before_stove,
    rests_near,
    rests_within,
    stove_on,
)
from lerobot_openspm.envs.tabletop.settings import Setting

# Goals have to hold for so many control steps in a row.
SUCCESS_HOLD_STEPS = 5

_BOTTLE_ON_CABINET = rests_within("bottle", "cabinet", *CABINET_TOP)
_BOTTLE_ON_RACK = rests_within("bottle", "rack", *RACK_SHELF)
_BOWL_ON_CABINET = rests_within("bowl", "cabinet", *CABINET_TOP)
_BOWL_ON_PLATE = rests_near("bowl", "plate", 0.035)
_BOWL_ON_STOVE = rests_near("bowl", "stove", 0.05, scene.BURNER_X)

TASKS = by_name(
    Task("bowl_on_plate", "put the bowl on the plate", _BOWL_ON_PLATE),
    Task("bowl_on_stove", "put the bowl on the stove", _BOWL_ON_STOVE),
    Task("bowl_on_cabinet", "put the bowl on top of the cabinet", _BOWL_ON_CABINET),
    Task("box_in_bowl", "put the cream cheese box in the bowl", box_in_bowl),
    Task("bottle_on_cabinet", "put the wine bottle on top of the cabinet", _BOTTLE_ON_CABINET),
    Task("bottle_on_rack", "put the wine bottle on the rack", _BOTTLE_ON_RACK),
    Task("open_middle_drawer", "open the middle drawer of the cabinet", middle_drawer_open),
    Task("bowl_in_top_drawer", "open the top drawer and put the bowl inside", in_top_drawer("bowl")),
    Task("push_plate", "push the plate to the front of the stove", plate_before_stove),
    Task("turn_on_stove", "turn on the stove", stove_on),
)
TASK_NAMES = tuple(TASKS)


def _compound(name: str, *parts: str) -> Task:
    """A task of several of the ten, all of which have to be done in the end."""
    return all_of(name, " and ".join(TASKS[part].instruction for part in parts), TASKS, *parts)


# Not among "all": nothing demonstrates them as a whole. The third and the fourth depend on their order: the
# second part takes place where the first one has put something.
COMPOUND_TASKS = by_name(
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
TWO_BOWL_TASKS = by_name(
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
ANYWHERE_TASKS = by_name(
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
# Every task that can be named, the last ones without an expert; a task's number is its place here.
ANY_TASK = {**TASKS, **COMPOUND_TASKS, **TWO_BOWL_TASKS, **ANYWHERE_TASKS, **COMBINATION_TASKS}
SELECTIONS = {
    "all": TASK_NAMES,
    "compound": tuple(COMPOUND_TASKS),
    "two_bowls": tuple(TWO_BOWL_TASKS),
    "anywhere": tuple(ANYWHERE_TASKS),
    "combinations": tuple(COMBINATION_TASKS),
}


def select_tasks(spec: str) -> list[str]:
    """Names of the tasks that a name, a comma list or a selection ("all": the ten) stands for.

    Raises:
        ValueError: A name is unknown, or there is none.
    """
    return select(spec, ANY_TASK, SELECTIONS, "openspm_tabletop")
