"""Objects that hardly move are known by patches of the images around them."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from tests.perception.builders import examples, localise
from tests.perception.drawn_world import views_of

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects import store
from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.objects.patches.learn import learn_at_one_place, learn_patches
from lerobot_openspm.perception.objects.patches.match import correlations
from lerobot_openspm.perception.objects.patches.model import PatchModel
from lerobot_openspm.perception.objects.shape.model import ShapeModel
from lerobot_openspm.types import ContactCue, DemonstrationScene

MIDDLES = {"block": (0.02, -0.15, 0.4), "cup": (0.0, 0.15, 0.0), "distractor": (-0.02, 0.0, 0.0)}


def poses(rng, aside_m=0.0):
    """Everything within 15 mm of its usual place, never turned, but the block so far from it."""
    placed = {
        name: se3.from_yaw([x + dx, y + dy, 0.0], yaw)
        for (name, (x, y, yaw)), (dx, dy) in zip(
            MIDDLES.items(), rng.uniform(-0.015, 0.015, (3, 2)), strict=True
        )
    }
    placed["block"][0, 3] += aside_m
    return placed


def demonstration(rng, aside_m=0.0):
    placed = poses(rng, aside_m)
    grasp = placed["cup"][:3, 3] + [0.03, 0.0, 0.05] + rng.normal(0, 0.003, 3)
    release = placed["block"][:3, 3] + [0, 0, 0.12] + rng.normal(0, 0.003, 3)
    return DemonstrationScene(
        views_of(placed), (ContactCue("cup", grasp, "grasp"), ContactCue("block", release, "release"))
    )


@pytest.fixture(scope="module")
def models():
    rng = np.random.default_rng(1)
    return learn_objects([demonstration(rng) for _ in range(8)], np.random.default_rng(0)).models


@pytest.fixture(scope="module")
def unseen():
    rng = np.random.default_rng(2)
    return [poses(rng) for _ in range(12)]


def place_errors(model, scenes, name):
    """Distances in metres from the true places, after one constant offset."""
    estimates = [localise(views_of(scene), model) for scene in scenes]
    assert all(one.status == "found" for one in estimates)
    found = np.stack([one.T_world_obj[:2, 3] for one in estimates])
    offsets = found - np.stack([scene[name][:2, 3] for scene in scenes])
    return np.linalg.norm(offsets - np.median(offsets, axis=0), axis=1)


@pytest.mark.parametrize("name", ["block", "cup"])
def test_places_are_found_within_a_millimetre_or_two(models, unseen, name):
    assert isinstance(models[name], PatchModel)
    errors = place_errors(models[name], unseen, name)
    assert errors.mean() < 0.0015
    # Far better than taking the usual place.
    assert errors.max() < 0.004


def several_tasks(n, T_moved=None):
    """One demonstration each of ``n`` tasks, the first of which grasps the cup and the second the block."""
    rng = np.random.default_rng(5)
    placed = [poses(rng) for _ in range(n)]
    moved = [None if T_moved is None or i % 2 else T_moved for i in range(n)]
    cues = [
        ContactCue("cup", placed[0]["cup"][:3, 3] + [0.03, 0.0, 0.05], "grasp", "first"),
        ContactCue("block", placed[1]["block"][:3, 3] + [0.0, 0.02, 0.04], "grasp", "second"),
    ]
    given = [(cues[i],) if i < len(cues) else () for i in range(n)]
    return [DemonstrationScene(views_of(T, m), g) for T, m, g in zip(placed, moved, given, strict=True)]


@pytest.mark.parametrize("shift", [None, (0.008, -0.006, 0.004)])
def test_one_demonstration_of_each_of_several_tasks_is_enough(unseen, shift):
    T_moved = None if shift is None else se3.transform(np.eye(3), np.array(shift))
    models = learn_patches(examples(["block", "cup"], several_tasks(10, T_moved)))
    for name in ("block", "cup"):
        assert place_errors(models[name], unseen, name).mean() < 0.002, name


def test_two_objects_never_follow_the_same_motion():
    scenes = several_tasks(10)
    cue = scenes[0].cues[0]
    twice = [dataclasses.replace(scenes[0], cues=(cue, dataclasses.replace(cue, name="mug"))), *scenes[1:]]
    models = learn_patches(examples(["block", "cup", "mug"], twice))
    assert "block" in models
    assert len({"cup", "mug"} & set(models)) == 1


def test_what_is_known_already_is_not_learned_again_under_another_name():
    scenes = several_tasks(10)
    known = learn_patches(examples(["cup"], scenes))["cup"]
    mug = dataclasses.replace(scenes[0].cues[0], name="mug")
    again = [dataclasses.replace(scenes[0], cues=(mug,)), *scenes[1:]]
    assert "mug" in learn_patches(examples(["mug"], again))
    assert learn_patches(examples(["mug"], again, [known])) == {}


def test_what_begins_at_a_few_places_is_learned_by_its_shape_where_nothing_was_filmed():
    rng = np.random.default_rng(8)
    scenes = [demonstration(rng, aside) for aside in (-0.12,) * 4 + (0.08,) * 6]
    learned = learn_objects(scenes, np.random.default_rng(0)).models
    assert isinstance(learned["cup"], PatchModel)
    assert isinstance(learned["block"], ShapeModel)
    both = examples(["block", "cup"], scenes)
    still = learn_patches(both)
    assert "block" not in still
    assert learn_at_one_place(both, still).keys() == {"block"}


@pytest.mark.parametrize("noise", [0.001, 0.003])
def test_a_fixture_that_never_moves_is_known_by_patches(noise):
    rng = np.random.default_rng(6)
    scenes = []
    for _ in range(8):
        placed = poses(rng) | {"block": se3.from_yaw([*MIDDLES["block"][:2], 0.0], MIDDLES["block"][2])}
        point = placed["block"][:3, 3] + [0.0, 0.02, 0.04] + rng.normal(0, noise, 3)
        scenes.append(DemonstrationScene(views_of(placed), (ContactCue("block", point, "grasp", "edge"),)))
    block = learn_patches(examples(["block"], scenes))["block"]
    found = [localise(scene.views, block) for scene in scenes]
    assert all(one.status == "found" for one in found)
    assert np.ptp([one.T_world_obj[:2, 3] for one in found], axis=0).max() < 0.001


@pytest.mark.parametrize("name", ["block", "cup"])
def test_the_covariance_tells_how_far_off_places_are(models, unseen, name):
    claimed = np.sqrt(np.trace(localise(views_of(unseen[0]), models[name]).covariance[:2, :2]))
    rms = np.sqrt(np.mean(place_errors(models[name], unseen, name) ** 2))
    assert rms / 3 < claimed < max(3 * rms, 0.001)


def test_too_few_scenes_to_agree_teach_nothing():
    assert learn_patches(examples(["block", "cup"], several_tasks(4))) == {}


def test_another_image_size_gives_the_same_place(models, unseen):
    views = views_of(unseen[0])
    larger = {
        key: dataclasses.replace(
            view, image=cv2.resize(view.image, (240, 240)), camera=view.camera.scaled(240, 240)
        )
        for key, view in views.items()
    }
    plain, scaled = localise(views, models["cup"]), localise(larger, models["cup"])
    np.testing.assert_allclose(scaled.T_world_obj, plain.T_world_obj, atol=1e-3)


@pytest.mark.parametrize("shift", [(0.012, -0.008, 0.005), (-0.01, 0.01, -0.006)])
@pytest.mark.parametrize("name", ["block", "cup"])
def test_a_camera_on_a_hand_that_starts_elsewhere_gives_the_same_place(models, unseen, name, shift):
    T_moved = se3.transform(np.eye(3), np.array(shift))
    usual = np.stack([localise(views_of(one), models[name]).T_world_obj[:2, 3] for one in unseen])
    found = [localise(views_of(one, T_moved), models[name]) for one in unseen]
    assert all(one.status == "found" for one in found)
    away = np.linalg.norm(np.stack([one.T_world_obj[:2, 3] for one in found]) - usual, axis=1)
    # Taken for a motion of the object, that of the camera would be more than a centimetre.
    assert away.mean() < 0.002


def test_a_camera_that_moved_does_not_help(models, unseen):
    T_moved = se3.from_yaw([0.1, 0.0, 0.0], 0.0)
    moved = {
        key: dataclasses.replace(view, T_world_cam=T_moved @ view.T_world_cam)
        for key, view in views_of(unseen[0]).items()
    }
    assert localise(moved, models["cup"]).status == "not_found"


def test_what_is_not_there_is_not_found(models, unseen):
    empty = {name: T for name, T in unseen[0].items() if name == "distractor"}
    assert localise(views_of(empty), models["cup"]).status == "not_found"


@pytest.mark.parametrize(("size", "at"), [((15, 15), (3, 9)), ((40, 23), (0, 0)), ((7, 50), (11, 2))])
def test_correlations_are_those_of_opencv(size, at):
    height, width = size
    pixels = np.random.default_rng(0).integers(0, 255, (height + 12, width + 10, 3), dtype=np.uint8)
    window = cv2.GaussianBlur(pixels, (5, 5), 2)
    patch = window[at[0] : at[0] + height, at[1] : at[1] + width].copy()
    told = correlations(window, patch)
    np.testing.assert_allclose(told, cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED), atol=1e-4)
    assert np.unravel_index(told.argmax(), told.shape) == at


@pytest.mark.parametrize("level", [0, 7, 255])
def test_what_is_all_alike_correlates_with_nothing(level):
    window, patch = (
        np.full((30, 30, 3), level, np.uint8),
        np.random.default_rng(0).integers(0, 255, (9, 9, 3)),
    )
    assert not correlations(window, patch.astype(np.uint8)).any()
    assert not correlations(
        np.tile(patch, (2, 2, 1)).astype(np.uint8), np.full((9, 9, 3), level, np.uint8)
    ).any()


@pytest.mark.parametrize(
    ("away_m", "margin_m", "told"), [(0.0, 0.0, True), (0.08, 0.0, False), (0.08, 0.08, True)]
)
def test_patches_reach_as_far_as_they_are_sought(models, away_m, margin_m, told):
    x, y, z = models["cup"].probes[0].patches[0].point_world
    assert models["cup"].reaches(se3.from_yaw([x + away_m, y, z], 0.0), margin_m) == told


def test_store_round_trip(models):
    fields, arrays = store.to_parts(models["cup"])
    again = store.from_parts(json.loads(json.dumps(fields)), arrays, "here")
    assert isinstance(again, PatchModel)
    for ours, theirs in zip(models["cup"].probes, again.probes, strict=True):
        assert (ours.camera, ours.std_m) == (theirs.camera, theirs.std_m)
        np.testing.assert_array_equal(ours.T_world_cam, theirs.T_world_cam)
        for a, b in zip(ours.patches, theirs.patches, strict=True):
            np.testing.assert_array_equal(a.image, b.image)
            np.testing.assert_array_equal(a.point_world, b.point_world)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("0.calibration", None, "missing"),
        ("0.calibration", np.zeros(6), "impossible"),
        ("0.T_world_cam", np.ones((4, 4)), "rigid"),
        ("0.patch.0", np.zeros((500, 500, 3), np.uint8), "does not lie in its image"),
        ("0.corners", np.zeros((0, 2)), "float64"),
        ("0.points", np.full((5, 3), np.nan), "not finite"),
    ],
)
def test_store_refuses_bad_arrays(models, key, value, words):
    fields, arrays = store.to_parts(models["cup"])
    changed = {k: v for k, v in arrays.items() if k != key} | ({} if value is None else {key: value})
    with pytest.raises(MemoryFormatError, match=words):
        store.from_parts(fields, changed, "here")


@pytest.mark.parametrize("probes", [None, [], ["front"], [{"camera": 3}]])
def test_store_refuses_bad_probes(models, probes):
    fields, arrays = store.to_parts(models["cup"])
    with pytest.raises(MemoryFormatError):
        store.from_parts({**fields, "probes": probes}, arrays, "here")
