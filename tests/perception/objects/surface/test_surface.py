"""Surfaces are learned from films of a hand that passes over objects, which are found wherever they stand."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from tests.perception.objects.surface.filmed import (
    HOME,
    MIDDLES,
    demonstration,
    looking_down,
    moved,
    views_at,
)

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.perception.objects import store
from lerobot_openspm.perception.objects.base import EarlierLook, Look, localise_all
from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.objects.patches.model import PatchModel
from lerobot_openspm.perception.objects.surface import model as model_module
from lerobot_openspm.perception.objects.surface.compare import correlation
from lerobot_openspm.perception.objects.surface.learn import _first_poses
from lerobot_openspm.perception.objects.surface.model import SurfaceModel
from lerobot_openspm.perception.objects.surface.search import Place, _areas, _ranked
from lerobot_openspm.perception.objects.surface.sight import Surface
from lerobot_openspm.types import DemonstrationScene, Moment, PoseEstimate


def test_what_hardly_moves_and_was_filmed_is_known_by_its_surface(models):
    assert {name: type(model) for name, model in models.items()} == {
        "block": SurfaceModel, "cup": SurfaceModel,
    }  # fmt: skip
    # A table of one colour does not tell its height: it is taken to lie right below what was touched.
    assert 0 <= models["cup"].backdrop.table_height < 0.03
    assert models["cup"].surface.is_round
    assert not models["block"].surface.is_round


def test_a_demonstration_shows_what_patches_are_sure_of():
    """Where another can stands in the place of the soup, the patches of the soup agree by 0.79."""
    told = {"soup": 0.79, "basket": 0.92, "milk": 0.43}

    def near(share):
        seen = PoseEstimate("found", np.eye(4), np.eye(4), share)
        return SimpleNamespace(localise=lambda look: seen)

    scene = DemonstrationScene(views_at({}, looking_down(*HOME)), ())
    assert _first_poses(scene, {name: near(share) for name, share in told.items()}).keys() == {"basket"}


@pytest.mark.parametrize(("name", "height", "radius"), [("block", 0.05, 0.055), ("cup", 0.06, 0.04)])
def test_its_points_lie_where_its_walls_and_its_top_are(models, name, height, radius):
    model = models[name]
    points = model.surface.coloured + np.array([0, 0, model.height])
    assert np.percentile(points[:, 2], 95) == pytest.approx(height, abs=0.01)
    assert model.surface.radius == pytest.approx(radius, abs=0.012)


@pytest.mark.parametrize(
    "pose", [(0.12, 0.12, 0.0), (-0.15, -0.1, 0.5), (0.05, 0.1, np.pi / 2), (0.1, -0.2, 2.4)]
)
def test_it_is_found_elsewhere_and_turned(models, pose):
    usual = {"block": se3.from_yaw((*MIDDLES["block"][:2], 0.0), 0.0)}
    model = models["block"]
    before = model.localise(Look(views_at(usual, looking_down(*HOME)))).T_world_obj
    found = model.localise(Look(views_at(moved(*pose), looking_down(*HOME))))
    assert found.status == "found"
    # The frame that was learned lies somewhere on the block, the same place of it every time.
    T_block_frame = se3.inverse(usual["block"]) @ before
    choices = [moved(*pose)["block"] @ se3.from_yaw(np.zeros(3), turn) @ T_block_frame for turn in (0, np.pi)]
    apart = [tuple(map(float, se3.distances(found.T_world_obj, T))) for T in choices]
    assert any(metres < 0.006 and radians < np.deg2rad(4) for metres, radians in apart)


def test_what_is_not_there_is_not_found(models):
    scene = {"distractor": se3.from_yaw([-0.1, 0.1, 0.0], 0.0), "block": se3.from_yaw([0.1, -0.1, 0.0], 0.3)}
    assert models["cup"].localise(Look(views_at(scene, looking_down(*HOME)))).status == "not_found"


def test_what_lies_on_its_side_is_not_found_and_said_to_have_tipped(models):
    on_its_side = se3.exp_so3([0.0, np.pi / 2, 0.0])
    cup = se3.transform(on_its_side, np.array([0.0, 0.12, 0.04]))
    found = models["cup"].localise(Look(views_at({"cup": cup}, looking_down(*HOME))))
    assert (found.status, found.tipped) == ("not_found", True)
    told = models["cup"].localise(Look(views_at({"cup": cup}, looking_down(*HOME)), told_apart=("cup",)))
    assert (told.status, told.tipped) == ("not_found", True)
    # It has fallen over and rolled away since it was seen.
    expected = {"cup": se3.from_yaw([0.0, -0.1, models["cup"].height], 0.0)}
    fallen = models["cup"].localise(Look(views_at({"cup": cup}, looking_down(*HOME)), expected=expected))
    assert (fallen.status, fallen.tipped) == ("not_found", True)
    away = models["cup"].localise(Look(views_at(moved(0.12, 0.12, 0.0), looking_down(*HOME))))
    assert (away.status, away.tipped) == ("not_found", False)


def test_pictures_are_searched_once_for_what_has_tipped(models, monkeypatch):
    searched = []
    monkeypatch.setattr(model_module, "has_tipped", lambda *_: bool(searched.append(1)))
    # On the block the cup, which lies beside it, is sought as well.
    on_its_side = se3.exp_so3([0.0, np.pi / 2, 0.0])
    scene = {
        "block": se3.from_yaw([0.05, 0.1, 0.0], 0.4),
        "cup": se3.transform(on_its_side, [-0.1, 0.1, 0.04]),
    }
    found = localise_all(models, Look(views_at(scene, looking_down(*HOME))))
    assert found["cup"].status == "not_found"
    assert searched == [1]


def test_what_stands_on_another_is_found_at_its_height(models):
    block, cup = se3.from_yaw([0.05, 0.1, 0.0], 0.4), se3.from_yaw([0.05, 0.1, 0.05], 0.0)
    look = Look(views_at({"block": block, "cup": cup}, looking_down(*HOME)))
    found = localise_all(models, look)["cup"]
    assert found.status == "found"
    assert found.T_world_obj[2, 3] - models["cup"].height == pytest.approx(0.05, abs=0.012)
    usual = models["cup"].localise(
        Look(views_at({"cup": se3.from_yaw([0.05, 0.1, 0.0], 0.0)}, looking_down(*HOME)))
    )
    assert found.T_world_obj[:2, 3] == pytest.approx(usual.T_world_obj[:2, 3], abs=0.008)


def test_colours_vary_together_with_what_is_expected():
    rng = np.random.default_rng(0)
    expected = np.repeat(rng.uniform(40, 60, (50, 1, 3)), 2, axis=1).astype(np.float32)
    inside = np.ones((1, 50), np.float32)
    lighter, mixed = expected[None, :, 0] + 5.0, expected[None, rng.permutation(50), 0]
    together, tells = correlation(lighter, expected, inside)
    assert together == pytest.approx(1.0, abs=1e-3)
    assert tells > 0.9
    assert correlation(mixed, expected, inside)[0] < 0.3
    # Of what has one colour its pattern tells nothing.
    plain = np.full((50, 2, 3), 50.0, np.float32)
    assert correlation(mixed, plain, inside)[1] == pytest.approx(0.0, abs=1e-3)


def test_where_it_is_found_from_is_told_by_what_looks_like_it_elsewhere(models):
    model = models["cup"]
    shares = [
        dataclasses.replace(model, typical_agreement=0.8, rival_agreement=rival).found_share
        for rival in (0.1, 0.4, 0.7)
    ]
    assert shares[0] < shares[1] < shares[2] < 1.0
    assert shares[2] > 0.7 / 0.8


def test_where_it_stood_in_the_demonstrations_its_patches_are_believed(models):
    usual = {name: se3.from_yaw((x, y, 0.0), yaw) for name, (x, y, yaw) in MIDDLES.items()}
    look = Look(views_at(usual, looking_down(*HOME)))
    found, near = models["cup"].localise(look), models["cup"].near.localise(look)
    assert np.array_equal(found.T_world_obj, near.T_world_obj)


@pytest.mark.parametrize(("share", "status"), [(0.3, "not_found"), (0.5, "found")])
def test_patches_are_not_believed_where_the_surface_hardly_agrees(models, monkeypatch, share, status):
    usual = {name: se3.from_yaw((x, y, 0.0), yaw) for name, (x, y, yaw) in MIDDLES.items()}
    model, look = models["cup"], Look(views_at(usual, looking_down(*HOME)))
    score = share * model.typical_agreement
    place = Place(np.array([-0.1, 0.1, model.height, 0.0]), score)  # nothing agrees better anywhere
    monkeypatch.setattr(model_module, "score_at", lambda *_: score)
    monkeypatch.setattr(model_module, "search", lambda *_: [place])
    assert model.near.localise(look).status == "found"
    assert model.localise(look).status == status


@pytest.mark.parametrize(("share", "is_raised"), [(0.7, False), (0.9, True)])
def test_a_place_on_a_thing_that_is_not_believed_hides_none_on_the_table(
    models, monkeypatch, share, is_raised
):
    model, supports = models["cup"], np.array([[0.1, 0.1, 0.05]])

    def search(surface, sights, ground, *_):
        on_thing = ground[0, 2] > model.height + 0.011
        pose = np.array([0.1, 0.1, model.height + (0.05 if on_thing else 0.0), 0.0])
        return [Place(pose, (share if on_thing else 0.62) * model.typical_agreement)]

    monkeypatch.setattr(model_module, "search", search)
    for told_apart in ((), ("cup",)):
        look = Look(views_at({}, looking_down(*HOME)), supports=supports, told_apart=told_apart)
        places = (model._all_places if told_apart else model._anywhere)(look, model._sights(look))
        assert (places[0].pose[2] > model.height + 0.01) == is_raised


@pytest.mark.parametrize(("is_large", "first"), [(False, np.pi / 2), (True, 0.0)])
def test_another_direction_counts_less_of_a_large_object(models, is_large, first):
    surface = dataclasses.replace(models["block"].surface)
    surface.__dict__["is_large"] = is_large
    turned, shown = (
        Place(np.array([0.0, 0.0, 0.0, yaw]), score) for yaw, score in ((np.pi / 2, 0.6), (0, 0.55))
    )
    for places in ([turned, shown], [shown, turned]):
        assert _ranked(surface, places)[0].pose[3] == first


@pytest.mark.parametrize(("is_large", "status"), [(False, "ambiguous"), (True, "found")])
def test_a_rival_in_another_direction_makes_a_large_object_less_doubtful(models, is_large, status):
    model = dataclasses.replace(models["block"], surface=dataclasses.replace(models["block"].surface))
    model.surface.__dict__["is_large"] = is_large
    look = Look(views_at(moved(0.12, 0.12, 0.0), looking_down(*HOME)))
    shown, turned = (
        Place(np.array([x, 0.12, model.height, yaw]), 0.97 * model.typical_agreement)
        for x, yaw in ((0.12, 0.0), (-0.15, np.pi / 2))
    )
    assert model._estimate(look, model._sights(look), [shown, turned]).status == status


@pytest.mark.parametrize(("same", "status"), [("middle", "found"), ("origin", "ambiguous")])
def test_places_are_told_apart_by_the_middle_of_what_stands_there(models, same, status):
    # The frame lies 15 cm beside the block.
    model = models["block"]
    surface = dataclasses.replace(model.surface, points=model.surface.points + np.array([0.15, 0.0, 0.0]))
    model = dataclasses.replace(model, surface=surface)
    shown = np.array([-0.03, 0.12, model.height, 0.0])
    turned = np.array([*shown[:3], np.pi])
    if same == "middle":
        turned[:2] += surface.middle_at(shown) - surface.middle_at(turned)
    look = Look(views_at(moved(0.12, 0.12, 0.0), looking_down(*HOME)))
    places = [Place(pose, 0.97 * model.typical_agreement) for pose in (shown, turned)]
    assert model._estimate(look, model._sights(look), places).status == status


def test_it_is_followed_from_where_it_is_expected(models):
    model, scene = models["block"], moved(0.12, 0.12, 0.3)
    first = model.localise(Look(views_at(scene, looking_down(*HOME))))
    expected = {"block": se3.from_yaw([0.008, -0.006, 0.0], 0.0) @ first.T_world_obj}
    look = Look(views_at(scene, looking_down(0.0, 0.1, 0.35)), expected=expected)
    again = model.localise(look)
    assert again.status == "found"
    assert float(se3.distance(first.T_world_obj, again.T_world_obj)) < 0.006


@pytest.mark.parametrize(("rise", "taken"), [(0.0, 0.016), (0.014, 0.006)])
def test_what_was_taken_to_stand_too_high_or_too_low_on_something_is_found_at_its_height(models, rise, taken):
    model = models["block"]
    T = model.localise(Look(views_at(moved(0.12, 0.12, 0.3), looking_down(*HOME)))).T_world_obj
    scene = {"block": se3.from_yaw([0.12, 0.12, rise], 0.3)}
    expected = {"block": se3.from_yaw([0.0, 0.0, taken], 0.0) @ T}
    first = Look(views_at(scene, looking_down(0.12, 0.16, 0.34)))
    true = T[:3, 3] + [0.0, 0.0, rise]
    for before in ((), (EarlierLook(first, expected),)):
        views = views_at(scene, looking_down(0.12, 0.08, 0.3))
        again = model.localise(Look(views, expected=expected, before=before))
        assert again.status == "found"
        assert again.T_world_obj[:3, 3] == pytest.approx(true, abs=0.006)


def test_pictures_that_tell_a_place_vaguely_are_no_evidence(models):
    model, scene = models["block"], moved(0.12, 0.12, 0.3)
    views = views_at(scene, looking_down(0.12, 0.1, 0.35))
    T = model.localise(Look(views)).T_world_obj
    # All is hidden but the middle of its top, which has one colour.
    hidden = {}
    for name, view in views.items():
        uv, _ = project(view.camera, view.T_world_cam, scene["block"][:3, 3] + [0.0, 0.0, 0.05])
        rows, columns = np.mgrid[: view.camera.height, : view.camera.width]
        hidden[name] = np.hypot(columns - uv[0], rows - uv[1]) > 5
    expected = {"block": se3.from_yaw([0.004, 0.004, 0.0], 0.0) @ T}
    seen = model.localise(Look(views, hidden=hidden, expected=expected))
    assert seen.status == "not_found"
    assert seen.visible == 0
    clear = model.localise(Look(views, expected=expected))
    assert clear.status == "found"
    assert np.sqrt(clear.covariance[:2, :2].diagonal()).max() < 0.004


def from_the_front(scene):  # as the fixed camera shows it
    view = {"front": scene.views["front"]}
    return dataclasses.replace(scene, views=view, film=lambda: [Moment(view, frozenset())])


def test_nothing_is_learned_of_surfaces_without_a_camera_in_the_hand():
    rng = np.random.default_rng(1)
    scenes = [from_the_front(demonstration(rng)) for _ in range(6)]
    models = learn_objects(scenes, np.random.default_rng(0)).models
    assert {name: type(model) for name, model in models.items()} == {"block": PatchModel, "cup": PatchModel}


def test_what_begins_at_a_few_places_is_known_by_its_surface():
    rng = np.random.default_rng(1)
    scenes = [demonstration(rng, aside_m=aside) for aside in (-0.15,) * 4 + (0.1,) * 6]
    learned = learn_objects(scenes, np.random.default_rng(0)).models
    assert learned.keys() == {"block", "cup"}
    assert all(isinstance(model, SurfaceModel) for model in learned.values())


def test_what_begins_at_a_few_places_is_not_known_at_one_of_them_alone():
    rng = np.random.default_rng(1)
    scenes = [from_the_front(demonstration(rng, aside_m=aside)) for aside in (-0.15,) * 4 + (0.1,) * 6]
    learned = learn_objects(scenes, np.random.default_rng(0))
    assert list(learned.models) == ["cup"]
    assert "it begins at a few places, and no camera of the hand shows a table" in learned.left_out["block"]


def test_a_record_tells_all_of_it(models):
    fields, arrays = store.to_parts(models["block"])
    again = store.from_parts(fields, arrays, "here")
    look = Look(views_at(moved(0.12, 0.12, 0.3), looking_down(*HOME)))
    T, T_again = (model.localise(look).T_world_obj for model in (models["block"], again))
    assert np.allclose(T, T_again, atol=2e-3)
    assert isinstance(again, SurfaceModel)
    assert again.near.name == "block"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"near": "patches"}, "'near' of 'block'"),
        ({"near": None}, "'block' was shown at 0 places, expected 1 to 64"),
        ({"hand_cameras": "hand"}, "list of camera keys"),
        ({"spacing": -1.0}, "'spacing' is -1.0"),
        ({"typical_agreement": 0.0}, "'typical_agreement' is 0.0"),
        ({"table_height": -100.0}, "'table_height' -100, expected 3 m between them at most"),
    ],
)
def test_a_broken_record_is_refused(models, change, message):
    fields, arrays = store.to_parts(models["block"])
    with pytest.raises(MemoryFormatError, match=message):
        store.from_parts(fields | change, arrays, "here")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("table_area", np.array([[-1e6, -1e6], [1e6, 1e6]]), "'table_area' is"),
        ("table_area", np.array([[1.0, 1.0], [-1.0, -1.0]]), "'table_area' is"),
        ("points", np.array([[0.0, 0.0, 1e7], *7 * [[0.0, 0.0, 0.0]]]), "'points' lie 1e\\+07 m"),
        ("hand.0", np.zeros((0, 4), np.uint8), "has no pixels"),
    ],
)
def test_a_record_that_would_hang_or_crash_a_search_is_refused(models, name, value, message):
    fields, arrays = store.to_parts(models["block"])
    value = value if value.dtype == np.uint8 else value.astype(np.float32)
    with pytest.raises(MemoryFormatError, match=message):
        store.from_parts(fields, arrays | {name: value}, "here")


def test_a_record_without_colours_is_refused(models):
    fields, arrays = store.to_parts(models["block"])
    blank = np.full_like(arrays["colours"], -1000.0)
    with pytest.raises(MemoryFormatError, match="0 points of 'block' have colours"):
        store.from_parts(fields, arrays | {"colours": blank}, "here")


@pytest.mark.parametrize("name", ["points", "normals", "colours", "table_colour", "table_area", "hand.0"])
def test_a_record_that_lacks_an_array_is_refused(models, name):
    fields, arrays = store.to_parts(models["block"])
    with pytest.raises(MemoryFormatError, match=name):
        store.from_parts(fields, {key: value for key, value in arrays.items() if key != name}, "here")


def test_the_shape_tells_by_what_an_object_turns_into_itself(models):
    assert models["cup"].symmetry.turn == 0
    assert models["block"].symmetry.turn == pytest.approx(np.pi)
    usual = se3.from_yaw((*MIDDLES["block"][:2], 0.0), 0.0)
    look = Look(views_at({"block": usual}, looking_down(*HOME)))
    T_world_obj = models["block"].localise(look).T_world_obj
    middle = se3.apply(T_world_obj, np.array([[*models["block"].symmetry.middle, 0.0]]))[0, :2]
    assert middle == pytest.approx(usual[:2, 3], abs=models["block"].surface.spacing)


@pytest.mark.parametrize("has_knob", [False, True])
def test_a_square_plate_is_not_round(has_knob):
    x, y = (at.ravel() for at in np.meshgrid(*2 * [np.arange(-0.1, 0.101, 0.007)]))
    plate = np.stack([x, y, np.zeros_like(x)], -1)
    knob = plate[np.hypot(x, y) < 0.04] + [0.15, 0.0, 0.0]
    points = np.concatenate([plate, knob]) if has_knob else plate
    colours = np.full((len(points), 2, 3), 60.0, np.float32)
    surface = Surface(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), colours, 0.007)
    assert (surface.symmetry is None) == has_knob
    assert not surface.is_round


def test_a_shape_that_was_seen_from_one_side_is_told_by_all_its_points(models):
    surface = models["cup"].surface
    is_behind = surface.points[:, 0] < surface.middle[0]
    colours = np.where(is_behind[:, None, None], np.nan, surface.colours)
    assert dataclasses.replace(surface, colours=colours).symmetry.turn == 0


def test_of_large_objects_cameras_see_other_sides_elsewhere(models):
    small = models["block"].surface
    large, flat = (dataclasses.replace(small, points=small.points * size) for size in (4, (4, 4, 1)))
    assert [one.is_large for one in (small, large, flat)] == [False, True, False]
    places = np.array([[0.1, 0.1, 0.0], [0.2, 0.1, 0.0], [0.4, 0.1, 0.0], [0.1, -0.1, 0.0]])
    assert list(_areas(small, places)) == [0, 0, 0, 0]
    alike = _areas(large, places)
    assert alike[0] == alike[1]
    assert len(set(alike)) == 3


def test_objects_of_one_memory_share_prepared_views(models):
    read = [store.from_parts(*store.to_parts(models[name]), "here") for name in ("block", "cup")]
    assert read[0].backdrop.key == read[1].backdrop.key
    look = Look(views_at(moved(0.12, 0.12, 0.0), looking_down(*HOME)))
    for model in read:
        model.localise(look)
    sights = [key for key in look._prepared if isinstance(key, tuple) and key[0] in look.views]
    assert len(sights) == len(look.views)
