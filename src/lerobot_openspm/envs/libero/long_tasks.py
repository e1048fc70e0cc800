"""Scripted experts for libero_10: two things are put somewhere, or a fixture is turned on or shut besides.

Kitchen, living room and study have tables of other heights; all points are told from what stands on them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.envs.libero.fixtures import in_open_drawer, shut_drawer, shut_microwave, turn_on_stove
from lerobot_openspm.envs.libero.picks import into_basket
from lerobot_openspm.envs.libero.puts import (
    BOWL_RIM,
    PRE_GRASP,
    LiberoHand,
    Put,
    backed,
    carried,
    grasp,
    on,
    on_region,
    take_and_put,
)
from lerobot_openspm.envs.motions import DOWN, Actions, in_world, raised, yaw_matrix
from lerobot_openspm.geometry.se3 import transform

# Grasp points from the object's origin, along the world's axes. Mugs are taken by the rim opposite the
# handle, moka pots by the middle of the knob on the lid: lower, the fingers stand on the lid.
WHITE_MUG_RIM = np.array([-0.001, -0.063, 0.095])
YELLOW_MUG_RIM = np.array([-0.001, 0.066, 0.085])
# The outside of the handle, for a hand that comes from there.
YELLOW_MUG_HANDLE = np.array([0.0, -0.063, 0.058])
MOKA_POT_KNOB = np.array([0.0, 0.0, 0.085])
# In the axes of the hand that grasps it: the middle of the book's upper edge.
BOOK_EDGE = np.array([-0.012, 0.0, 0.125])
PUDDING_MIDDLE = np.array([0.0, 0.0, 0.006])

# Where an object's origin goes, from the origin of what it goes onto. A mug's lies beside its middle.
WHITE_MUG_ON_PLATE = np.array([0.0, 0.017, 0.008])
YELLOW_MUG_ON_PLATE = np.array([0.0, -0.017, 0.008])
# From the middles of LIBERO's regions.
MOKA_POT_ON_BURNER = np.array([0.0, 0.0, 0.087])
BURNER_HALF = np.array([0.045, 0.0, 0.0])
PUDDING_ON_TABLE = np.array([0.0, 0.0, 0.040])
# Towards the robot, so that a finger has room beside the bowl. It is lowered from further out, past the
# handles above the drawer.
BOWL_IN_DRAWER = np.array([-0.010, 0.0, -0.022])
PAST_HANDLES = np.array([0.0, -0.020, 0.0])
OVER_BOTTLE_RISE = 0.16
# The fingers that let go of it stay above the walls of the caddy.
BOOK_IN_CADDY = np.array([0.0, -0.016, -0.028])
OVER_CADDY_RISE = 0.22
# In the microwave's frame, which is just higher inside than the mug: so far out that the palm stays outside,
# which is as broad as the opening, and so far in that the door clears the handle.
MUG_IN_MICROWAVE = np.array([-0.032, -0.018, 0.034])
# From there, and along a door that is as little open as it ever is at the start.
BEFORE_MICROWAVE = np.array([0.055, -0.220, 0.016])
MICROWAVE_LEAN = math.radians(50)
MICROWAVE_RISE = 0.06
# Over the door on the way to its other side.
MICROWAVE_RETREAT = 0.12
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


def _after(first: Callable[[LiberoHand], Actions], put: Put) -> Callable[[LiberoHand], Actions]:
    return partial(one_after_another, (first, partial(take_and_put, put)))


def _before(put: Put, last: Callable[[LiberoHand], Actions]) -> Callable[[LiberoHand], Actions]:
    return partial(one_after_another, (partial(take_and_put, put), last))


def _mug_into_microwave(hand: LiberoHand) -> Actions:
    """Take the mug by its handle with a hand that leans back, and push it in from the front."""
    offset, turn = hand.grasp_noise()
    lean = Rotation.from_rotvec([MICROWAVE_LEAN, 0.0, 0.0]).as_matrix() @ yaw_matrix(-math.pi / 2) @ DOWN
    rotation = yaw_matrix(turn) @ lean
    name = "yellow_and_white_mug"
    yield from grasp(hand, transform(rotation, hand.origin(name) + YELLOW_MUG_HANDLE + offset))
    inside = in_world(hand.frame("microwave"), MUG_IN_MICROWAVE)
    front = carried(hand, name, inside + BEFORE_MICROWAVE)
    yield from hand.travel(raised(hand.simulator.ee_pose(), MICROWAVE_RISE))
    yield from hand.travel(front)
    yield from hand.advance(carried(hand, name, inside))
    yield from hand.grip(closing=False)
    yield from hand.travel(backed(hand.simulator.ee_pose(), PRE_GRASP))
    yield from hand.retreat(MICROWAVE_RETREAT)


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
    "KITCHEN_SCENE3_turn_on_the_stove_and_put_the_moka_pot_on_it": _after(
        turn_on_stove, Put("moka_pot", MOKA_POT_KNOB, on_region(_COOK, MOKA_POT_ON_BURNER))
    ),
    "KITCHEN_SCENE4_put_the_black_bowl_in_the_bottom_drawer_of_the_cabinet_and_close_it": _before(
        Put(
            "bowl",
            BOWL_RIM,
            in_open_drawer("bottom", BOWL_IN_DRAWER),
            OVER_BOTTLE_RISE,
            turn=-math.pi / 2,
            slant=PAST_HANDLES,
        ),
        partial(shut_drawer, "bottom"),
    ),
    "KITCHEN_SCENE6_put_the_yellow_and_white_mug_in_the_microwave_and_close_it": partial(
        one_after_another, (_mug_into_microwave, shut_microwave)
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
    "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy": _puts(
        Put(
            "book",
            BOOK_EDGE,
            on_region("desk_caddy_1_back_contain_region", BOOK_IN_CADDY),
            OVER_CADDY_RISE,
            along="book",
            turn=math.pi,
            like="caddy",
        )
    ),
}  # fmt: skip
