"""Scripted experts for libero_spatial and libero_object: one thing is taken and put down.

In libero_object all things stand on the floor, and go into a basket that is narrower than an open hand: they
are let go of with the fingers above its rim.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lerobot_openspm.envs.libero.puts import BOWL_ON_PLATE, BOWL_RIM, CHEESE_MIDDLE, Put, on

# Grasp points from the object's origin, along the world's axes.
CAN_TOP = np.array([0.0, 0.0, 0.018])
BOTTLE_NECK = np.array([0.0, 0.0, 0.048])
SMALL_BOTTLE_NECK = np.array([0.0, 0.0, 0.035])
CARTON_TOP = np.array([0.0, 0.0, 0.055])
PUDDING_MIDDLE = np.array([0.0, 0.0, 0.006])
# Where an object's origin goes, from the basket's.
CAN_IN_BASKET = np.array([0.0, 0.0, 0.150])
CHEESE_IN_BASKET = np.array([0.0, 0.0, 0.145])
BOTTLE_IN_BASKET = np.array([0.0, 0.0, 0.175])
SMALL_BOTTLE_IN_BASKET = np.array([0.0, 0.0, 0.160])
# The cheese is flat: a hand straight above it has room beside the can when it is turned.
BESIDE_CAN = -math.radians(25)
# They look alike from everywhere, and people take them from one side or another.
CANS = ("alphabet_soup", "tomato_sauce")
# Above the basket's rim and the things that stand on the floor.
FLOOR_CARRY_RISE = 0.20


# Of what goes into a basket: where to grasp it, and where it is let go of.
INTO_BASKET = {
    "alphabet_soup": (CAN_TOP, CAN_IN_BASKET),
    "cream_cheese": (CHEESE_MIDDLE, CHEESE_IN_BASKET),
    "salad_dressing": (BOTTLE_NECK, BOTTLE_IN_BASKET),
    "bbq_sauce": (SMALL_BOTTLE_NECK, SMALL_BOTTLE_IN_BASKET),
    "ketchup": (BOTTLE_NECK, BOTTLE_IN_BASKET),
    "tomato_sauce": (CAN_TOP, CAN_IN_BASKET),
    "butter": (CHEESE_MIDDLE, CHEESE_IN_BASKET),
    "milk": (CARTON_TOP, BOTTLE_IN_BASKET),
    "chocolate_pudding": (PUDDING_MIDDLE, CHEESE_IN_BASKET),
    "orange_juice": (CARTON_TOP, BOTTLE_IN_BASKET),
}


def into_basket(name: str, aside: np.ndarray | None = None) -> Put:
    """Put something into the basket, or a little aside of its middle (3,)."""
    grasp, goal = INTO_BASKET[name]
    return Put(name, grasp, on("basket", goal if aside is None else goal + aside), FLOOR_CARRY_RISE)


_BOWL_ON_PLATE = Put("bowl", BOWL_RIM, on("plate", BOWL_ON_PLATE))
# Before the front of the drawer there is no room for a finger, beside its walls there is.
_BOWL_FROM_DRAWER = replace(_BOWL_ON_PLATE, along="cabinet")
SPATIAL = {
    f"pick_up_the_black_bowl_{place}_and_place_it_on_the_plate": put
    for place, put in {
        "between_the_plate_and_the_ramekin": _BOWL_ON_PLATE,
        "next_to_the_ramekin": _BOWL_ON_PLATE,
        "from_table_center": _BOWL_ON_PLATE,
        "on_the_cookie_box": _BOWL_ON_PLATE,
        "in_the_top_drawer_of_the_wooden_cabinet": _BOWL_FROM_DRAWER,
        "on_the_ramekin": _BOWL_ON_PLATE,
        "next_to_the_cookie_box": _BOWL_ON_PLATE,
        "on_the_stove": _BOWL_ON_PLATE,
        "next_to_the_plate": _BOWL_ON_PLATE,
        "on_the_wooden_cabinet": _BOWL_ON_PLATE,
    }.items()
}
OBJECT = {
    f"pick_up_the_{name}_and_place_it_in_the_basket": put
    for name, put in {
        **{name: into_basket(name) for name in INTO_BASKET},
        **{can: replace(into_basket(can), other_turn=math.pi / 2) for can in CANS},
        "cream_cheese": replace(into_basket("cream_cheese"), turn=BESIDE_CAN),
    }.items()
}
