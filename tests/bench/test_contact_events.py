"""Events that are read from drawn sequences of contacts."""

import numpy as np
import pytest

from lerobot_openspm.bench.contact_events import contact_events, runs, stands
from lerobot_openspm.bench.contact_sensor import ThingTrack
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
