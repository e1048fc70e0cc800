"""What the first pictures do not show is learned from where it was touched, and from the film."""

import dataclasses

import numpy as np
import pytest
from tests.perception.drawn_world import SHAPES, hand_camera, render
from tests.perception.objects.surface.filmed import HOME, MIDDLES, demonstration, looking_down, views_at

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.perception.objects import store
from lerobot_openspm.perception.objects.base import Look
from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.objects.surface import learn
from lerobot_openspm.perception.objects.surface.backdrop import frequent_colour
from lerobot_openspm.perception.objects.surface.model import SurfaceModel
from lerobot_openspm.perception.objects.surface.search import Place
from lerobot_openspm.perception.objects.surface.shown import visible_share
from lerobot_openspm.perception.objects.surface.touched import (
    COVERED_M,
    Touched,
    _is_steady,
    covering,
    middle,
    poses_beside,
    poses_by_touch,
    settled,
)
from lerobot_openspm.types import ContactCue, DemonstrationScene, Moment, PoseEstimate, View

# How far from its usual place the cup begins in another task, metres.
RAISED = (-0.1, 0.05, 0.08)


def covered(view, rng):
    """A view in which something else each time stands before most of the cup."""
    x, y, _ = MIDDLES["cup"]
    (u, v), _ = project(view.camera, view.T_world_cam, np.array([x, y, 0.03]))
    image = view.image.copy()
    rows, columns = slice(int(v) - 14, int(v) + 14), slice(int(u) - 16, int(u) + 10)
    image[rows, columns] = rng.integers(0, 255, (28, 26, 3))
    return View(image, view.camera, view.T_world_cam)


def badly_shown(rng):
    """A demonstration whose fixed camera hardly sees the cup; the hand's camera passes over it."""
    scene = demonstration(rng)
    views = {"front": covered(scene.views["front"], rng)}
    film = scene.film()
    moments = [dataclasses.replace(film[0], views=views), *film[1:]]
    return dataclasses.replace(scene, views=views, film=lambda: moments)


@pytest.fixture(scope="module")
def learned():
    rng = np.random.default_rng(1)
    return learn_objects([badly_shown(rng) for _ in range(6)], np.random.default_rng(0))


def test_what_is_hidden_in_first_pictures_is_learned_from_the_film(learned):
    cup, block = learned.models["cup"], learned.models["block"]
    assert isinstance(cup, SurfaceModel)
    assert cup.near is None
    assert block.near is not None
    assert len(block.shown) == 0
    assert len(cup.shown) == 1
    np.testing.assert_allclose(cup.surface.middle, 0.0, atol=1e-9)
    points = cup.surface.coloured + np.array([0, 0, cup.height])
    assert np.percentile(points[:, 2], 95) == pytest.approx(0.06, abs=0.015)
    assert cup.surface.radius == pytest.approx(0.04, abs=0.015)


def test_what_the_films_do_not_show_where_it_was_touched_has_no_surface(monkeypatch):
    monkeypatch.setattr(learn, "settle_all", lambda *_: {})
    rng = np.random.default_rng(1)
    found = learn_objects([badly_shown(rng) for _ in range(6)], np.random.default_rng(0))
    assert not isinstance(found.models.get("cup"), SurfaceModel)
    assert isinstance(found.models["block"], SurfaceModel)


@pytest.mark.parametrize("off", [(0.0, 0.0), (0.02, -0.01)])
def test_it_is_found_about_where_it_was_shown_and_exactly_once_the_hand_sees_it(learned, off):
    cup, rng = learned.models["cup"], np.random.default_rng(3)
    x, y = np.add(MIDDLES["cup"][:2], off)
    seen = views_at({"cup": se3.from_yaw([x, y, 0.0], 0.0)}, looking_down(x - 0.05, y, 0.35))
    front = covered(seen["front"], rng)

    def away_m(found):
        middle = se3.apply(found.T_world_obj, np.array([[*cup.surface.middle, 0.0]]))[0, :2]
        return np.linalg.norm(middle - [x, y])

    first = cup.localise(Look({"front": front}))
    assert first.status == "found"
    assert away_m(first) < 0.04
    expected = {"cup": first.T_world_obj}
    nearer = cup.localise(Look({"front": front, "hand": seen["hand"]}, expected=expected))
    assert nearer.status == "found"
    assert away_m(nearer) < 0.006


def test_it_is_not_found_where_it_was_shown_if_it_is_gone(learned):
    cup = learned.models["cup"]
    view = views_at({}, looking_down(*HOME))["front"]
    assert cup.localise(Look({"front": view})).status == "not_found"


def test_one_thing_is_told_once_however_often_it_was_shown(learned):
    cup = learned.models["cup"]
    x, y, z, agreed = cup.shown[0]
    often = dataclasses.replace(cup, shown=np.array([[x + off, y, z, agreed] for off in (0.0, 0.034)]))
    place = se3.from_yaw([*MIDDLES["cup"][:2], 0.0], 0.0)
    found = often.localise(Look(views_at({"cup": place}, looking_down(*HOME))))
    assert (found.status, found.others) == ("found", ())


def test_of_those_that_words_tell_apart_one_is_sought_elsewhere_too(learned):
    at = [MIDDLES["cup"][:2], (-0.12, -0.12)]
    stand = [(SHAPES["cup"], se3.from_yaw([*xy, 0.0], 0.0)) for xy in at]
    views = render(stand, None, hand_camera(looking_down(-0.05, -0.05, 0.45)))
    found = learned.models["cup"].localise(Look(views, told_apart={"cup"}))
    assert len(found.others) == 1


def test_a_record_tells_where_it_was_shown(learned):
    cup = learned.models["cup"]
    again = store.from_parts(*store.to_parts(cup), "here")
    assert isinstance(again, SurfaceModel)
    assert again.near is None
    np.testing.assert_allclose(again.shown, cup.shown)


@pytest.mark.parametrize(
    "shown", [np.zeros((0, 4)), np.zeros((65, 4)), np.full((1, 4), 1.5), np.full((1, 4), -0.1)]
)
def test_a_record_that_would_be_looked_for_at_many_places_or_none_is_refused(learned, shown):
    fields, arrays = store.to_parts(learned.models["cup"])
    with pytest.raises(MemoryFormatError, match=f"'cup' was shown at {len(shown)} places, expected 1 to 64"):
        store.from_parts(fields, {**arrays, "shown": shown}, "here")


@pytest.mark.parametrize("has_another", [True, False])
def test_another_of_the_kind_is_found_around_where_it_was_touched(learned, has_another):
    cup = learned.models["cup"]
    at = {"first": np.array([0.0, -0.15]), "other": np.array([0.0, 0.2])}
    # The frame of a cup that stands there, about as it was learned.
    T = {name: se3.from_yaw([*(xy - cup.surface.middle), cup.height], 0.0) for name, xy in at.items()}
    shape = SHAPES["cup"]
    stand = [(shape, se3.from_yaw([*at[name], 0.0], 0.0)) for name in at if name == "first" or has_another]
    places = [(x, y, 0.35) for y in (-0.15, 0.2) for x in (-0.1, 0.0, 0.05)]
    hands = [hand_camera(looking_down(*place)) for place in places]
    film = [
        # The first touch moves the cup, by all that is known.
        Moment({"hand": render(stand, None, hand)["hand"]}, frozenset({"cup"} if i >= 3 else ()))
        for i, hand in enumerate(hands)
    ]
    aside = T["other"] @ se3.from_yaw([0.04, -0.05, 0.0], 0.0)
    touched = Touched([[T["first"]], [aside]], cup.height)
    stood = settled("cup", cup.surface, [film], touched, cup.backdrop)
    assert stood is not None
    found = [middle(poses) for poses in stood.poses]
    expected = [T["first"], T["other"]] if has_another else [T["first"]]
    np.testing.assert_allclose(found, [one[:3, 3] for one in expected], atol=0.006)


def test_touches_tell_poses_by_place_of_which_the_most_touched_comes_first():
    """Two plates: the second one was not touched in every demonstration."""
    left, right = np.array([0.0, -0.3, 0.1]), np.array([0.0, 0.3, 0.12])

    def scene(*touches):
        return DemonstrationScene({}, touches)

    first = ContactCue("plate", left, "release", "task: 1")
    second = ContactCue("plate", right, "release", "task: 3")
    touched = poses_by_touch("plate", [scene(second, first), scene(first), scene()])
    assert [[None if T is None else T[:3, 3].tolist() for T in place] for place in touched.poses] == [
        [[0.0, -0.3, 0.1], [0.0, -0.3, 0.1], None],
        [[0.0, 0.3, 0.1], None, None],
    ]
    assert poses_by_touch("bowl", [scene(first)]) is None


def test_what_is_grasped_higher_stands_higher_and_what_is_let_go_higher_does_not():
    low, high = np.array([0.0, -0.3, 0.1]), np.array([0.0, 0.3, 0.25])
    seen = [se3.from_yaw([0.0, -0.28, 0.06], 0.0), None]
    for kind, height in (("grasp", 0.21), ("release", 0.06)):
        cues = [ContactCue("bowl", low, kind, "table: 0"), ContactCue("bowl", high, kind, "shelf: 0")]
        touched = poses_beside("bowl", [DemonstrationScene({}, (cue,)) for cue in cues], seen, 0.06)
        assert touched.is_seen
        assert touched.poses[0][0] is seen[0]
        assert touched.poses[1][0] is None
        np.testing.assert_allclose(touched.poses[1][1][:3, 3], [0.0, 0.3, height])


@pytest.fixture(scope="module")
def at_two_places():
    """One task begins with the cup on the table, another one with it higher, elsewhere."""
    rng = np.random.default_rng(1)
    on_table = [demonstration(rng, task="from the table") for _ in range(6)]
    raised = [demonstration(rng, cup_by=RAISED, task="from the shelf") for _ in range(4)]
    return learn_objects([*on_table, *raised], np.random.default_rng(0)).models


def test_where_a_task_begins_with_it_higher_is_learned_from_the_films(at_two_places):
    cup = at_two_places["cup"]
    assert isinstance(cup, SurfaceModel)
    assert cup.near is not None
    low, high = cup.shown
    np.testing.assert_allclose((high - low)[:3], RAISED, atol=0.01)
    assert low[2] == pytest.approx(cup.height, abs=0.005)


def test_all_of_a_kind_are_found_where_they_were_shown(at_two_places):
    cup = at_two_places["cup"]
    x, y, _ = MIDDLES["cup"]
    low, high = se3.from_yaw([x, y, 0.0], 0.0), se3.from_yaw(np.add([x, y, 0.0], RAISED), 0.0)
    hand = hand_camera(looking_down(*HOME))
    for stand in ([low, high], [high]):
        views = render([(SHAPES["cup"], T) for T in stand], None, hand)
        found = cup.localise(Look(views, told_apart={"cup"}))
        places = sorted((T[:3, 3] for T in (found.T_world_obj, *found.others)), key=lambda p: p[2])
        assert found.status != "not_found"
        expected = [T[:3, 3] + [*-cup.surface.middle, cup.height] for T in stand]
        np.testing.assert_allclose(places, expected, atol=0.01)


@pytest.mark.parametrize(
    ("beyond", "covered_share", "expected"), [(0, 0, 1), (0.5, 0, 1), (0, 0.5, 0.5), (0.8, 0, 0.2)]
)
def test_what_lies_beyond_the_picture_is_not_hidden(beyond, covered_share, expected):
    view = views_at({}, looking_down(*HOME))["front"]
    width = view.camera.width
    pixels = np.stack([np.linspace(-beyond, 1 - beyond, 100) * 60, np.full(100, 100.0)], axis=1)
    rays = np.column_stack([(pixels - [view.camera.cx, view.camera.cy]) / view.camera.focal_px, np.ones(100)])
    points = se3.apply(view.T_world_cam, 0.5 * rays)
    hidden = np.arange(width) < 60 * covered_share
    look = Look({"front": view}, hidden={"front": np.broadcast_to(hidden, view.image.shape[:2])})
    assert visible_share(look, points) == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize(("aside_m", "status"), [(0.01, "found"), (0.05, "not_found")])
def test_what_falls_is_not_seen_sliding_away_at_its_height(learned, monkeypatch, aside_m, status):
    """A can that fell into a basket looks like one that hovers beside it."""
    cup = learned.models["cup"]
    let_go = se3.from_yaw([0.0, 0.15, cup.height + 0.15], 0.0)
    seen = PoseEstimate("found", let_go @ se3.from_yaw([aside_m, 0.0, 0.0], 0.0), 1e-6 * np.eye(4), 1.0, 1.0)
    monkeypatch.setattr(SurfaceModel, "_at", lambda *_: seen)
    view = views_at({}, looking_down(*HOME))["front"]
    assert cup.localise(Look({"front": view}, expected={"cup": let_go})).status == status


def test_a_steady_offset_from_the_touch_tells_more_than_one_that_varies():
    poses = [se3.from_yaw([0.1 * i, 0.0, 0.0], 0.0) for i in range(4)]
    for spread, steady in ((0.005, True), (0.05, False)):
        places = [Place(np.array([0.1 * i + (-1) ** i * spread, 0.03, 0.0, 0.0]), 0.5) for i in range(4)]
        assert _is_steady([*places, None], [*poses, None]) is steady
    assert not _is_steady(places[:2], poses[:2])


@pytest.mark.parametrize(("grey_share", "is_wood"), [(0.35, True), (0.45, False)])
def test_the_table_is_what_most_shows_and_not_what_fills_a_bin(grey_share, is_wood):
    """Wood has many colours; a grey thing that is nearly as large is not taken for it, nor wood for that."""
    rng = np.random.default_rng(0)
    wood = rng.normal([43.0, 10.0, 28.0], [3.5, 3.0, 3.0], (int(1000 * (1 - grey_share)), 3))
    grey = np.tile([5.0, 0.0, 0.0], (int(1000 * grey_share), 1)) + rng.normal(
        0, 0.2, (int(1000 * grey_share), 3)
    )
    colour, _ = frequent_colour(np.concatenate([grey, wood]).astype(np.float32))
    assert (colour.mean[0] > 30) == is_wood


def test_places_that_demonstrations_showed_further_apart_are_all_remembered():
    rng = np.random.default_rng(4)
    xy = rng.uniform([-0.06, -0.03], [0.06, 0.03], (12, 2))
    poses = [None if i == 5 else se3.from_yaw([*one, 1.1], 0.0) for i, one in enumerate(xy)]
    groups = covering(poses)
    places = np.array([place for place, _ in groups])
    own = [[T for T in group if T is not None] for _, group in groups]
    assert sum(map(len, own)) == 11
    for place, group in zip(places, own, strict=True):
        assert all(np.linalg.norm(T[:3, 3] - place) <= COVERED_M for T in group)
    assert 2 < len(groups) < 11
    np.testing.assert_allclose(places[0], middle(poses))
    # Where all stand alike the middle is enough.
    near = [se3.from_yaw([x, 0.0, 1.1], 0.0) for x in (-0.02, 0.0, 0.02)]
    ((place, group),) = covering(near)
    assert group == near
    np.testing.assert_allclose(place, [0.0, 0.0, 1.1])
