"""Twenty tasks that put something where the ten put something else, alone or two in one instruction.

The ten show how each thing is grasped and how each place is used, but none of these as one instruction.
The plate is moved in none of them: the ten push it, and the hand does not hold it level by its low rim.
"""

from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.goals import (
    CABINET_TOP,
    RACK_RAILS,
    RACK_SHELF,
    Task,
    all_of,
    before_stove,
    by_name,
    in_top_drawer,
    rests_near,
    rests_within,
)
from lerobot_openspm.envs.tabletop.placement import box_beside_drawers, room_before_stove

_BOX_ON_PLATE = rests_near("box", "plate", 0.04)
_BOX_ON_STOVE = rests_near("box", "stove", 0.05, scene.BURNER_X)
_BOX_ON_CABINET = rests_within("box", "cabinet", *CABINET_TOP)
_BOX_ON_RACK = rests_within("box", "rack", *RACK_SHELF)
_BOTTLE_ON_PLATE = rests_near("bottle", "plate", 0.05)
_BOTTLE_ON_STOVE = rests_near("bottle", "stove", 0.05, scene.BURNER_X)
_BOTTLE_IN_BOWL = rests_near("bottle", "bowl", scene.BOWL_RADIUS - scene.BOTTLE_RADIUS)
_BOWL_ON_RACK = rests_within("bowl", "rack", *RACK_RAILS)


def _in_drawer(name: str, thing: str, instruction: str) -> Task:
    """A task for which the top drawer has to be opened first, whether the instruction says so or not."""
    has_room = box_beside_drawers if thing == "box" else None
    return Task(name, instruction, in_top_drawer(thing), n_parts=2, has_room=has_room)


def _before_stove(name: str, thing: str, instruction: str) -> Task:
    return Task(name, instruction, before_stove(thing), has_room=room_before_stove(thing))


_SINGLE = by_name(
    Task("box_on_plate", "put the cream cheese box on the plate", _BOX_ON_PLATE),
    Task("box_on_stove", "put the cream cheese box on the stove", _BOX_ON_STOVE),
    Task("box_on_cabinet", "put the cream cheese box on top of the cabinet", _BOX_ON_CABINET),
    Task("box_on_rack", "put the cream cheese box on the rack", _BOX_ON_RACK),
    Task("bottle_on_plate", "put the wine bottle on the plate", _BOTTLE_ON_PLATE),
    Task("bottle_on_stove", "put the wine bottle on the stove", _BOTTLE_ON_STOVE),
    Task("bottle_in_bowl", "put the wine bottle in the bowl", _BOTTLE_IN_BOWL),
    Task("bowl_on_rack", "put the bowl on the rack", _BOWL_ON_RACK),
    _before_stove("push_box", "box", "push the box to the front of the stove"),
    _before_stove("bowl_before_stove", "bowl", "put the bowl to the front of the stove"),
    _before_stove("bottle_before_stove", "bottle", "put the bottle to the front of the stove"),
    _in_drawer("bowl_in_shut_drawer", "bowl", "put the bowl in the top drawer"),
    _in_drawer("box_in_top_drawer", "box", "open the top drawer and put the cream cheese box inside"),
    _in_drawer("box_in_shut_drawer", "box", "put the cream cheese box in the top drawer"),
    _in_drawer("bottle_in_shut_drawer", "bottle", "put the wine bottle in the top drawer"),
)


def _two(instruction: str, *parts: str) -> Task:
    return all_of("_then_".join(parts), instruction, _SINGLE, *parts)


COMBINATION_TASKS = _SINGLE | by_name(
    _two("put the box on the plate and the wine bottle on the stove", "box_on_plate", "bottle_on_stove"),
    _two(
        "put the wine bottle on the plate and the cream cheese box on the stove",
        "bottle_on_plate",
        "box_on_stove",
    ),
    _two(
        "put the bowl on the rack and the cream cheese box on top of the cabinet",
        "bowl_on_rack",
        "box_on_cabinet",
    ),
    _two(
        "push the cream cheese box to the front of the stove, then put the wine bottle in the bowl",
        "push_box",
        "bottle_in_bowl",
    ),
    _two(
        "put the cream cheese box in the top drawer and the wine bottle on the stove",
        "box_in_shut_drawer",
        "bottle_on_stove",
    ),
)
