"""Events that are read from drawn sequences of contacts."""

import numpy as np
import pytest
from benchmarks.contact_events import contact_events, runs, stands
from benchmarks.contact_sensor import ThingTrack

from lerobot_openspm.geometry import se3

N = 100


def path(*way: tuple[int, float], tremble: float = 0.0) -> np.ndarray:
    """Poses along x: (frame, metres) from one to the next, and a tremble to and fro."""
    frames, metres = zip(*way, strict=True)
    x = np.interp(np.arange(N), frames, metres) + tremble * (np.arange(N) % 2)
    return se3.transform(np.eye(3), np.stack([x, 0 * x, 0 * x], axis=-1))


def during(first: int, last: int) -> np.ndarray:
    """True from one frame to another."""
    return (np.arange(N) >= first) & (np.arange(N) <= last)


def fingers(closed: np.ndarray) -> np.ndarray:
    """Opening that follows at once."""
    return np.where(closed, 0.02, 0.08)


def both(flags: np.ndarray) -> np.ndarray:
    return np.stack([flags, flags], axis=-1)


def read(kind, thing, squeezed, hand, opening, touched=None):
    touched = squeezed.any(axis=1) if touched is None else touched
    events = contact_events([ThingTrack("thing", kind, thing, squeezed, touched)], hand, opening)
    return [(event.phase, event.frame, event.since) for event in events]


@pytest.mark.parametrize(("kind", "end"), [("free", "place"), ("slide", "open"), ("hinge", "turn")])
def test_a_thing_is_taken_moved_and_let_go_of(kind, end):
    held, opening = during(20, 60), fingers(during(19, 60))
    hand = path((30, 0.0), (50, 0.2), (70, 0.2), (80, 0.4), tremble=0.002)
    thing = path((30, 0.0), (50, 0.2), tremble=0.002)
    events = read(kind, thing, both(held), hand, opening)
    assert [(phase, since) for phase, _, since in events] == [("grasp", 20), (end, 60), ("release", 61)]
    frames = [frame for _, frame, _ in events]
    np.testing.assert_allclose(frames, [30, 60, 70], atol=1)


def test_a_thing_that_shifts_between_closing_fingers_has_not_been_carried_off():
    hand = path((40, 0.0), (60, 0.2))
    thing = path((20, 0.0), (24, 0.035), (40, 0.035), (60, 0.235))
    assert read("free", thing, both(during(20, 80)), hand, fingers(during(19, 80)))[0] == ("grasp", 40, 20)


def test_closing_around_what_is_then_not_moved_is_no_grasp():
    still = path((0, 0.0), (99, 0.0))
    assert read("free", still, both(during(20, 60)), still, fingers(during(19, 60))) == []


def test_flickering_contacts_are_one_hold_and_a_free_thing_needs_two_fingers():
    squeezed = both(during(20, 60) & (np.arange(N) % 4 > 0))
    hand = path((30, 0.0), (50, 0.2), (70, 0.2), (80, 0.4))
    thing = path((30, 0.0), (50, 0.2))
    opening = fingers(during(19, 60))
    assert [e[0] for e in read("free", thing, squeezed, hand, opening)] == ["grasp", "place", "release"]
    squeezed[:, 1] = False
    assert [e[0] for e in read("free", thing, squeezed, hand, opening)] == ["push"]
    assert [e[0] for e in read("slide", thing, squeezed, hand, opening)] == ["grasp", "open", "release"]


def test_a_push_ends_when_the_hand_leaves_and_pauses_belong_to_it():
    touched = during(30, 45) | during(60, 70)
    hand = path((30, 0.0), (45, 0.1), (59, 0.1), (70, 0.2), (80, 0.2), (90, 0.5))
    thing = path((30, 0.0), (45, 0.1), (60, 0.1), (70, 0.2))
    squeezed, opening = both(during(1, 0)), fingers(during(0, N))
    assert read("free", thing, squeezed, hand, opening, touched) == [("push", 80, 70)]
    swinging = path((30, 0.0), (45, 0.1), (70, 0.0))
    assert read("free", swinging, squeezed, hand, opening, during(30, 69)) == []


def spatial(x, z=((0, 0.0),)) -> np.ndarray:
    """Poses along x and z, each as of `path`."""
    x, z = path(*x)[:, 0, 3], path(*z)[:, 0, 3]
    return se3.transform(np.eye(3), np.stack([x, 0 * x, z], axis=-1))


PUSHING = [(30, 0.0), (50, 0.1)]
RISING = [(60, 0.0), (80, 0.2)]


@pytest.mark.parametrize(
    "thing",
    [
        pytest.param(spatial(x=PUSHING, z=[(60, 0.0), (66, 0.01), (68, 0.0)]), id="tips back"),
        pytest.param(spatial(x=PUSHING, z=[(60, 0.0), (70, 0.1), (74, 0.0)]), id="rises and falls"),
        pytest.param(spatial(x=[*PUSHING, (72, 0.1), (90, 0.13)], z=RISING), id="hangs on the hand"),
        pytest.param(spatial(x=PUSHING), id="touched again"),
    ],
)
def test_a_push_ends_when_the_hand_rises_whatever_it_touches_then(thing):
    hand = spatial(x=[*PUSHING, (72, 0.1), (90, 0.13)], z=RISING)
    nothing, opening = both(during(1, 0)), fingers(during(0, N))
    for touched in (during(30, 75), during(30, 58) | during(62, 63) | during(66, 80)):
        assert read("free", thing, nothing, hand, opening, touched) == [("push", 60, 50)]


def test_what_tips_up_against_a_low_hand_is_pushed_on():
    thing = spatial(x=[*PUSHING, (60, 0.1), (70, 0.2)], z=[(50, 0.0), (52, 0.04)])
    hand = spatial(x=[*PUSHING, (60, 0.1), (70, 0.2)], z=[(75, 0.0), (85, 0.2)])
    nothing, opening = both(during(1, 0)), fingers(during(0, N))
    assert read("free", thing, nothing, hand, opening, during(30, 70)) == [("push", 75, 70)]


@pytest.mark.parametrize(
    ("rise", "pushes"), [pytest.param(0.02, [90], id="slides"), pytest.param(0.1, [50, 90], id="lifts off")]
)
def test_a_hand_that_slides_over_what_it_pushes_goes_on_pushing_it(rise, pushes):
    thing = spatial(x=[*PUSHING, (75, 0.1), (90, 0.2)])
    # It stands behind the thing's middle, and slides forwards over it.
    way = [(0, -0.08), (30, -0.08), (50, 0.02), (65, 0.07), (75, 0.07), (90, 0.17)]
    hand = spatial(x=way, z=[(50, 0.0), (58, rise), (66, 0.0), (90, 0.0), (95, 0.1)])
    nothing, opening = both(during(1, 0)), fingers(during(0, N))
    touched = during(30, 50) | during(76, 90)
    assert [e[1] for e in read("free", thing, nothing, hand, opening, touched)] == pushes


def test_what_turns_about_a_hinge_is_pushed_where_the_hand_is():
    angle = np.interp(np.arange(N), [30, 50], [0.0, 0.5])
    thing = se3.transform(se3.exp_so3(np.stack([0 * angle, angle, 0 * angle], axis=-1)), np.zeros((N, 3)))
    hand = thing @ se3.transform(np.eye(3), np.array([0.2, 0.0, 0.0]))
    hand[:, :3, :3] = np.eye(3)
    hand[:, 0, 3] += np.interp(np.arange(N), [60, 80], [0.0, 0.2])
    nothing, opening = both(during(1, 0)), fingers(during(0, N))
    assert read("hinge", thing, nothing, hand, opening, during(31, 70)) == [("push", 60, 50)]


def test_what_moves_by_itself_at_a_touch_is_not_pushed():
    thing = path((30, 0.0), (50, 0.1))
    still, nothing = path((0, 0.0), (99, 0.0)), both(during(1, 0))
    assert read("free", thing, nothing, still, fingers(during(0, N)), during(30, 50)) == []


def test_what_the_end_of_the_demonstration_cuts_ends_there():
    hand = path((30, 0.0), (50, 0.2))
    held = both(during(20, N))
    assert read("free", hand, held, hand, fingers(during(19, N))) == [("grasp", 30, 20), ("place", 99, 99)]
    held, opening = both(during(20, 60)), fingers(during(19, 60))
    assert read("free", hand, held, hand, opening)[-1] == ("release", 99, 61)


def test_stretches_are_bridged_over_short_gaps():
    flags = np.array([0, 1, 1, 0, 0, 1, 0, 0, 0, 1], bool)
    assert runs(flags, 2) == [(1, 5), (9, 9)]
    assert runs(flags, 0) == [(1, 2), (5, 5), (9, 9)]
    assert runs(np.zeros(4, bool), 2) == []


def test_one_stands_until_both_leave():
    early, late = path((20, 0.0), (40, 0.2)), path((60, 0.0), (80, 0.2))
    assert stands([early], 0.03) == 20
    assert stands([early, late], 0.03) == 60
    assert stands([path((0, 0.0), (99, 0.0))], 0.03) == N - 1
