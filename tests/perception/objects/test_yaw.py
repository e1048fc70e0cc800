"""Which yaws an object is sought at, by the yaws that its demonstrations showed."""

import numpy as np
import pytest

from lerobot_openspm.perception.objects.yaw import CHANCE, MARGIN, search_range, yaw_range


@pytest.mark.parametrize("yaws", [[0.3], [0.3, 0.5], [6.2, 0.1]])
def test_one_or_two_yaws_do_not_tell_that_an_object_keeps_its_direction(yaws: list[float]):
    assert yaw_range(np.array(yaws), 2 * np.pi)[1] < np.pi / 2
    assert search_range(np.array(yaws), 2 * np.pi)[1] == np.pi


def test_many_do_and_are_searched_with_a_margin():
    yaws = np.deg2rad([-20, -15, -3, 4, 9, 18])
    centre, halfwidth = search_range(yaws, 2 * np.pi)
    assert (centre, halfwidth) == pytest.approx((np.deg2rad(-1), np.deg2rad(19) + MARGIN))
    assert (centre, halfwidth) == yaw_range(yaws, 2 * np.pi)


def test_more_are_needed_the_less_there_is_to_turn():
    yaws = np.deg2rad([-18, 0, 18])
    assert search_range(yaws, 2 * np.pi)[1] < np.pi
    assert search_range(yaws, np.pi)[1] == np.pi / 2


@pytest.mark.parametrize("n", [2, 3, 4, 6])
def test_an_object_that_turns_at_will_is_seldom_taken_for_one_that_does_not(n: int):
    rng = np.random.default_rng(n)
    drawn = rng.uniform(-np.pi, np.pi, (4000, n))
    mistaken = np.mean([search_range(yaws, 2 * np.pi)[1] < np.pi for yaws in drawn])
    assert mistaken < 1.2 * CHANCE


def test_a_body_of_revolution_has_no_yaw():
    assert search_range(np.array([0.3]), 0.0) == (0.0, 0.0)
