"""Which of several objects is meant: by hand, in LIBERO's scenes, and however a scene is moved or turned."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from tests.properties import examples

from lerobot_openspm.control.spatial_relations import MARGIN_M, choose, choose_as_shown
from lerobot_openspm.errors import InstructionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.types import Reference

PLACES = st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)), min_size=2, max_size=5)
AMONG = ["left", "right", "front", "back"]
RELATIONS = [
    Reference("between", ("plate", "cup")),
    *(Reference(name, ("plate",)) for name in ("next to", "center", "on", "in", "under", *AMONG)),
    *(Reference(name) for name in ("middle", *AMONG)),
]
MARKS = {"plate": (0.1, 0.2), "cup": (-0.1, -0.1)}


def at(x, y, z=0.0, yaw=0.3):
    return se3.from_yaw([x, y, z], yaw)


def scene(places, marks=MARKS):
    return [at(*place) for place in places], {name: at(*place) for name, place in marks.items()}


# The regions of LIBERO's scenes, world x and y in metres, and which of the objects its goal names.
SPATIAL = {"plate": (0.06, 0.2), "cookie box": (0.07, 0.03), "ramekin": (-0.2, 0.2), "stove": (-0.41, -0.14)}
PLATES = [(0.0, -0.3), (0.0, 0.3)]
BOWLS = [(0.1, 0.15), (-0.05, 0.2), (-0.15, 0.05)]
BY_THE_PLATE, BY_THE_RAMEKIN = (0.01, 0.31), (-0.18, 0.32)
BETWEEN, BY_THE_BOX = (-0.05, 0.2), (0.13, -0.07)
ON_THE_STOVE, ON_THE_CABINET = (-0.41, -0.14, 0.03), (0.03, -0.27, 0.22)
ON_THE_RAMEKIN, ON_THE_BOX = (-0.2, 0.2, 0.05), (0.07, 0.03, 0.05)
LIBERO = {
    "the left plate": (Reference("left"), PLATES, 0),
    "the right plate": (Reference("right"), PLATES, 1),
    "the black bowl on the left": (Reference("left"), [(-0.1, -0.15), (-0.1, 0.05)], 0),
    "the right moka pot": (Reference("right"), [(-0.05, 0.25), (0.05, 0.05)], 0),
    "the book on the left": (Reference("left"), [(0.0, 0.0), (-0.05, -0.25)], 1),
    "the black bowl at the front": (Reference("front"), BOWLS, 0),
    "the middle black bowl": (Reference("middle"), BOWLS, 1),
    "the black bowl at the back": (Reference("back"), BOWLS, 2),
    "the butter at the front": (Reference("front"), [(0.0, 0.2), (-0.1, 0.2)], 0),
    "the butter at the back": (Reference("back"), [(0.0, 0.2), (-0.1, 0.2)], 1),
    "between": (Reference("between", ("plate", "ramekin")), [BETWEEN, BY_THE_RAMEKIN], 0),
    "next to the box": (Reference("next to", ("cookie box",)), [BY_THE_BOX, ON_THE_STOVE], 0),
    "next to the plate": (Reference("next to", ("plate",)), [BY_THE_PLATE, BY_THE_RAMEKIN], 0),
    "next to the ramekin": (Reference("next to", ("ramekin",)), [BY_THE_RAMEKIN, BY_THE_PLATE], 0),
    "on the stove": (Reference("on", ("stove",)), [ON_THE_STOVE, ON_THE_CABINET], 0),
    "on the ramekin": (Reference("on", ("ramekin",)), [ON_THE_RAMEKIN, ON_THE_BOX], 0),
}


@pytest.mark.parametrize(("reference", "places", "expected"), LIBERO.values(), ids=LIBERO)
def test_liberos_scenes_mean_what_their_goals_say(reference, places, expected):
    candidates, landmarks = scene(places, SPATIAL)
    assert choose(reference, candidates, landmarks) == expected
    assert choose(reference, candidates[::-1], landmarks) == len(places) - 1 - expected


@pytest.mark.parametrize(
    ("relation", "place"),
    [("left", (0.1, 0.05)), ("right", (0.1, 0.35)), ("front", (0.25, 0.2)), ("back", (-0.05, 0.2))],
)
def test_sides_of_a_landmark_as_liberos_regions_lie(relation, place):
    # LIBERO's plate_left_region is at a smaller y than its plate, stove_front_region at a larger x.
    others = [xy for xy in ((0.1, 0.05), (0.1, 0.35), (0.25, 0.2), (-0.05, 0.2)) if xy != place]
    candidates, landmarks = scene([*others, place])
    assert choose(Reference(relation, ("plate",)), candidates, landmarks) == 3
    assert choose(Reference(relation, ("plate",)), candidates[:3], landmarks) is None, "none is there"


def test_under_and_on_are_told_apart_by_height():
    shelf = {"shelf": at(0.0, 0.0, 0.2)}
    candidates = [at(0.0, 0.03, 0.0), at(0.02, 0.0, 0.26)]
    assert choose(Reference("under", ("shelf",)), candidates, shelf) == 0
    assert choose(Reference("on", ("shelf",)), candidates, shelf) == 1


def test_what_stands_on_a_thing_is_not_next_to_it():
    candidates, landmarks = scene([(0.11, 0.2, 0.01), (0.1, 0.35)])
    assert choose(Reference("next to", ("plate",)), candidates, landmarks) == 1
    assert choose(Reference("on", ("plate",)), candidates, landmarks) == 0


@pytest.mark.parametrize("reference", RELATIONS, ids=str)
def test_one_place_for_two_is_ambiguous_and_a_missing_landmark_decides_nothing(reference):
    candidates, landmarks = scene([(0.1, 0.22), (0.1, 0.22 + 0.4 * MARGIN_M)])
    assert choose(reference, candidates, landmarks) is None
    if reference.landmarks:
        assert choose(reference, scene([(0.1, 0.05), (0.3, 0.3)])[0], {}) is None
    assert choose(reference, [], landmarks) is None
    assert choose(reference, candidates[:1], landmarks) == 0


def test_a_relation_that_cannot_be_told_is_an_error():
    for reference in (Reference("around", ("plate",)), Reference("between", ("plate",)), Reference("on")):
        with pytest.raises(InstructionError, match="expected one of back"):
            choose(reference, *scene([(0, 0), (1, 1)]))


@pytest.mark.parametrize("alias", [("left of", "left"), ("behind", "back"), ("in front of", "front")])
def test_relations_go_by_several_names(alias):
    candidates, landmarks = scene([(0.1, 0.05), (0.1, 0.35), (0.25, 0.2), (-0.05, 0.2)])
    first, second = (choose(Reference(name, ("plate",)), candidates, landmarks) for name in alias)
    assert first == second is not None


def costs_are_clear(reference, candidates, landmarks):
    """Whether rounding cannot decide: a scene of slightly other size or with slightly other landmarks means
    the same.
    """
    answers = set()
    shifts = [(0, 0), (1e-6, 0), (-1e-6, 0), (0, 1e-6), (0, -1e-6)]
    for scale, (x, y) in [(0.999, (0, 0)), (1.001, (0, 0)), *((1.0, shift) for shift in shifts)]:
        sized = [se3.transform(T[:3, :3], scale * T[:3, 3]) for T in candidates]
        marks = {
            name: se3.transform(T[:3, :3], scale * T[:3, 3] + [x, y, 0.0]) for name, T in landmarks.items()
        }
        answers.add(choose(reference, sized, marks))
    return len(answers) == 1


@pytest.mark.parametrize("reference", RELATIONS, ids=str)
@examples(30)
@given(places=PLACES, yaw=st.floats(-3, 3), x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_a_scene_that_is_moved_means_the_same_and_only_sides_change_when_it_is_turned(
    reference, places, yaw, x, y
):
    candidates, landmarks = scene(places)
    assume(costs_are_clear(reference, candidates, landmarks))
    G = se3.from_yaw([x, y, 0.1], 0.0 if reference.relation in AMONG else yaw)
    moved, marks = [G @ T for T in candidates], {name: G @ T for name, T in landmarks.items()}
    assert choose(reference, moved, marks) == choose(reference, candidates, landmarks)


@pytest.mark.parametrize("reference", RELATIONS, ids=str)
@examples(30)
@given(places=PLACES, order=st.randoms())
def test_the_order_of_the_candidates_does_not_matter(reference, places, order):
    candidates, landmarks = scene(places)
    shuffled = list(range(len(places)))
    order.shuffle(shuffled)
    chosen = choose(reference, [candidates[i] for i in shuffled], landmarks)
    expected = choose(reference, candidates, landmarks)
    assert (None if chosen is None else shuffled[chosen]) == expected


@pytest.mark.parametrize(
    ("one", "other", "yaw"),
    [("left", "right", np.pi), ("front", "back", np.pi), ("left", "front", np.pi / 2)],
)
@pytest.mark.parametrize("names", [(), ("plate",)])
@examples(30)
@given(places=PLACES)
def test_a_turned_scene_has_its_sides_turned(one, other, yaw, names, places):
    candidates, landmarks = scene(places)
    assume(costs_are_clear(Reference(one, names), candidates, landmarks))
    G = se3.from_yaw(np.zeros(3), yaw)
    turned, marks = [G @ T for T in candidates], {name: G @ T for name, T in landmarks.items()}
    assert choose(Reference(other, names), turned, marks) == choose(
        Reference(one, names), candidates, landmarks
    )


# As demonstrations show it.

OFFSETS = st.lists(st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)), min_size=1, max_size=6)
SHIFT = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))


def shown_at(place, errors, marks=MARKS):
    """Demonstrations in which a bowl stood about at a place, each shifted as a whole."""
    made = []
    for i, (x, y) in enumerate(errors):
        by = np.array([0.1 * i, -0.05 * i])
        others = {name: at(*(np.array(xy) + by)) for name, xy in marks.items()}
        made.append({"bowl": at(*(np.array(place) + by + (x, y))), **others})
    return made


@given(PLACES, OFFSETS, SHIFT)
def test_a_shift_of_the_whole_scene_changes_nothing_of_what_is_shown(places, errors, shift):
    shown = shown_at(places[0], errors)
    candidates, marks = scene(places)
    T = se3.from_yaw([*shift, 0.0], 0.0)
    before = choose_as_shown("bowl", candidates, marks, shown)
    after = choose_as_shown(
        "bowl", [T @ one for one in candidates], {k: T @ v for k, v in marks.items()}, shown
    )
    gaps = np.sort(np.linalg.norm(np.array(places) - places[0], axis=1))
    assume(before == after or gaps[1] > 0.1)  # near the margin rounding decides
    assert before == after


@given(PLACES, OFFSETS, st.randoms(use_true_random=False))
def test_the_one_that_was_shown_is_chosen_whatever_their_order(places, errors, random):
    assume(min(np.linalg.norm(np.array(places[1:]) - places[0], axis=1)) > 0.13)
    order = list(range(len(places)))
    random.shuffle(order)
    candidates, marks = scene([places[i] for i in order])
    assert choose_as_shown("bowl", candidates, marks, shown_at(places[0], errors)) == order.index(0)


@given(SHIFT, st.floats(0.03, 0.3), st.floats(0.0, 2 * np.pi))
def test_two_as_far_from_where_it_was_shown_are_a_tie(place, away, angle):
    way = away * np.array([np.cos(angle), np.sin(angle)])
    candidates, marks = scene([np.array(place) + way, np.array(place) - way])
    assert choose_as_shown("bowl", candidates, marks, shown_at(place, [(0.0, 0.0)])) is None


def test_demonstrations_that_differ_more_than_the_candidates_do_not_choose():
    candidates, marks = scene([(0.0, 0.0), (0.1, 0.0)])
    scattered = [(0.0, 0.0), (0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3)]
    assert choose_as_shown("bowl", candidates, marks, shown_at((0.0, 0.0), scattered)) is None


def test_neither_is_near_where_it_was_shown():
    candidates, marks = scene([(0.5, 0.0), (0.6, 0.0)])
    assert choose_as_shown("bowl", candidates, marks, shown_at((0.0, 0.0), [(0.0, 0.0)])) is None


def test_where_nothing_else_was_shown_the_world_decides():
    candidates, marks = scene([(0.3, 0.1), (0.0, 0.0)])
    shown = [{"bowl": at(0.01, 0.01)}, {"bowl": at(0.0, -0.01)}]
    assert choose_as_shown("bowl", candidates, marks, shown) == 1
    assert choose_as_shown("bowl", candidates, {}, shown) == 1
    # But not where it was shown beside something that is not found here.
    beside = [{"bowl": at(0.0, 0.0), "plate": at(0.2, 0.2)}]
    assert choose_as_shown("bowl", candidates, {}, beside) is None
    assert choose_as_shown("bowl", candidates, marks, []) is None
    assert choose_as_shown("bowl", [], marks, shown) is None
    assert choose_as_shown("bowl", candidates[:1], marks, []) == 0
