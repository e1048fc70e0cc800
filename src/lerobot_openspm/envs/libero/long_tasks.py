"""Scripted experts for tasks of libero_10: two things are put somewhere, one after the other.

Kitchen, living room and study have tables of other heights; all points are told from what stands on them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from lerobot_openspm.envs.libero.picks import into_basket
from lerobot_openspm.envs.libero.puts import LiberoHand, Put, on, on_region, take_and_put
from lerobot_openspm.envs.motions import Actions

# Grasp points from the object's origin, along the world's axes. Mugs are taken by the rim opposite the
# handle, moka pots by the knob of the lid.
WHITE_MUG_RIM = np.array([-0.001, -0.063, 0.095])
YELLOW_MUG_RIM = np.array([-0.001, 0.066, 0.085])
MOKA_POT_KNOB = np.array([0.0, 0.0, 0.078])
PUDDING_MIDDLE = np.array([0.0, 0.0, 0.006])

# Where an object's origin goes, from the origin of what it goes onto. A mug's lies beside its middle.
WHITE_MUG_ON_PLATE = np.array([0.0, 0.017, 0.008])
YELLOW_MUG_ON_PLATE = np.array([0.0, -0.017, 0.008])
# From the middles of LIBERO's regions.
MOKA_POT_ON_BURNER = np.array([0.0, 0.0, 0.087])
BURNER_HALF = np.array([0.045, 0.0, 0.0])
PUDDING_ON_TABLE = np.array([0.0, 0.0, 0.040])
# In the basket, one beside the other.
BASKET_HALF = np.array([0.030, 0.0, 0.0])
# The hand around the cheese fits between milk and juice, that around the butter beside the basket.
BETWEEN_CARTONS, BESIDE_BASKET = -math.radians(20), -math.radians(30)


def one_after_another(parts: tuple[Callable[[LiberoHand], Actions], ...], hand: LiberoHand) -> Actions:
    """Carry out the parts of a task."""
    for part in parts:
        yield from part(hand)


def _puts(*puts: Put) -> Callable[[LiberoHand], Actions]:
    return partial(one_after_another, tuple(partial(take_and_put, put) for put in puts))


def _both_into_basket(one: str, other: str) -> Callable[[LiberoHand], Actions]:
    return _puts(into_basket(one, -BASKET_HALF), into_basket(other, BASKET_HALF))


_COOK = "flat_stove_1_cook_region"
_BOTH = "LIVING_ROOM_SCENE2_put_both_the_"
LONG: dict[str, Callable[[LiberoHand], Actions]] = {
    f"{_BOTH}alphabet_soup_and_the_tomato_sauce_in_the_basket": _both_into_basket(
        "alphabet_soup", "tomato_sauce"
    ),
    f"{_BOTH}cream_cheese_box_and_the_butter_in_the_basket": _puts(
        replace(into_basket("cream_cheese", -BASKET_HALF), turn=BETWEEN_CARTONS),
        replace(into_basket("butter", BASKET_HALF), turn=BESIDE_BASKET),
    ),
    "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove": _puts(
        Put("moka_pot", MOKA_POT_KNOB, on_region(_COOK, MOKA_POT_ON_BURNER - BURNER_HALF)),
        Put("moka_pot_2", MOKA_POT_KNOB, on_region(_COOK, MOKA_POT_ON_BURNER + BURNER_HALF)),
    ),
    "LIVING_ROOM_SCENE5_put_the_white_mug_on_the_left_plate_and_put_the_yellow_and_white_mug_on_the_right_plate":
        _puts(
            Put("white_mug", WHITE_MUG_RIM, on("plate", WHITE_MUG_ON_PLATE)),
            Put("yellow_and_white_mug", YELLOW_MUG_RIM, on("plate_2", YELLOW_MUG_ON_PLATE)),
        ),
    "LIVING_ROOM_SCENE6_put_the_white_mug_on_the_plate_and_put_the_chocolate_pudding_to_the_right_of_the_plate":
        _puts(
            Put("white_mug", WHITE_MUG_RIM, on("plate", WHITE_MUG_ON_PLATE)),
            Put(
                "chocolate_pudding",
                PUDDING_MIDDLE,
                on_region("living_room_table_plate_right_region", PUDDING_ON_TABLE),
            ),
        ),
    "LIVING_ROOM_SCENE1_put_both_the_alphabet_soup_and_the_cream_cheese_box_in_the_basket": _both_into_basket(
        "alphabet_soup", "cream_cheese"
    ),
}  # fmt: skip
