"""Scripted experts for the first tasks of libero_spatial and libero_object: one thing is taken and put down.

In libero_object all things stand on the floor, and go into a basket that is narrower than an open hand: they
are let go of with the fingers above its rim.
"""

from __future__ import annotations

import math

import numpy as np

from lerobot_openspm.envs.libero.puts import BOWL_ON_PLATE, BOWL_RIM, CHEESE_MIDDLE, Put, on

# Grasp points from the object's origin, along the world's axes.
CAN_TOP = np.array([0.0, 0.0, 0.018])
BOTTLE_NECK = np.array([0.0, 0.0, 0.048])
# Where an object's origin goes, from the basket's.
CAN_IN_BASKET = np.array([0.0, 0.0, 0.150])
CHEESE_IN_BASKET = np.array([0.0, 0.0, 0.145])
BOTTLE_IN_BASKET = np.array([0.0, 0.0, 0.175])
# The cheese is flat: a hand straight above it would stand on the can beside it.
CHEESE_LEAN = math.radians(30)
# Above the basket's rim and the things that stand on the floor.
FLOOR_CARRY_RISE = 0.20


def _into_basket(name: str, grasp: np.ndarray, goal: np.ndarray, lean: float = 0.0) -> Put:
    return Put(name, grasp, on("basket", goal), FLOOR_CARRY_RISE, lean)


_BOWL_ON_PLATE = Put("bowl", BOWL_RIM, on("plate", BOWL_ON_PLATE))
SPATIAL = {
    "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate": _BOWL_ON_PLATE,
    "pick_up_the_black_bowl_next_to_the_ramekin_and_place_it_on_the_plate": _BOWL_ON_PLATE,
    "pick_up_the_black_bowl_from_table_center_and_place_it_on_the_plate": _BOWL_ON_PLATE,
}
OBJECT = {
    "pick_up_the_alphabet_soup_and_place_it_in_the_basket": _into_basket(
        "alphabet_soup", CAN_TOP, CAN_IN_BASKET
    ),
    "pick_up_the_cream_cheese_and_place_it_in_the_basket": _into_basket(
        "cream_cheese", CHEESE_MIDDLE, CHEESE_IN_BASKET, CHEESE_LEAN
    ),
    "pick_up_the_salad_dressing_and_place_it_in_the_basket": _into_basket(
        "salad_dressing", BOTTLE_NECK, BOTTLE_IN_BASKET
    ),
}
