"""Learning objects of a drawn world from cues alone, and finding them again."""

import dataclasses
import json

import numpy as np
import pytest
from tests.perception.builders import localise
from tests.perception.drawn_world import SHAPES, demonstration, draw_poses, partly_hidden, render, views_of

from lerobot_openspm.errors import DatasetError, MemoryFormatError, ObservationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects import store
from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.objects.shape.model import ShapeModel


@pytest.fixture
def models(drawn_objects):
    return drawn_objects


@pytest.fixture(scope="module")
def unseen():
    rng = np.random.default_rng(2)
    return [draw_poses(rng) for _ in range(12)]


def errors(model, name, scenes):
    """Position errors in metres, and yaw errors modulo the period after one constant offset."""
    estimates = [localise(views_of(poses), model) for poses in scenes]
    assert all(one.status == "found" for one in estimates)
    places = np.stack(
        [one.T_world_obj[:3, 3] - poses[name][:3, 3] for one, poses in zip(estimates, scenes, strict=True)]
    )
    turns = np.array(
        [
            se3.yaw_of(one.T_world_obj) - se3.yaw_of(poses[name])
            for one, poses in zip(estimates, scenes, strict=True)
        ]
    )
    period = model.yaw_period or 2 * np.pi
    turns = se3.wrap_angle(turns - turns[0], period)
    return np.linalg.norm(places[:, :2], axis=1), turns - np.median(turns)


def test_objects_that_move_far_are_known_by_their_shapes(models):
    assert {name: type(model) for name, model in models.items()} == {"block": ShapeModel, "cup": ShapeModel}


def test_objects_are_found_within_millimetres(models, unseen):
    for name in ("block", "cup"):
        places, _ = errors(models[name], name, unseen)
        assert places.mean() < 0.002, name
        assert places.max() < 0.005, name


def test_yaw_is_found_up_to_the_symmetry(models, unseen):
    _, turns = errors(models["block"], "block", unseen)
    assert models["block"].yaw_period == pytest.approx(np.pi)
    assert np.rad2deg(np.abs(turns)).mean() < 2
    assert models["cup"].yaw_period == 0


def test_support_plane_and_size_are_learned(models):
    for name, height in (("block", 0.05), ("cup", 0.06)):
        assert models[name].height == pytest.approx(0.0, abs=0.015)
        assert models[name].points[:, 2].min() >= 0
        assert models[name].points[:, 2].max() == pytest.approx(height, abs=0.02)
    assert models["cup"].radius == pytest.approx(0.04, abs=0.006)


def test_what_often_hides_a_part_does_not_shrink_the_shape():
    rng = np.random.default_rng(1)
    hidden = [partly_hidden(demonstration(rng), "block", "side", 0.3) for _ in range(10)]
    scenes = [
        dataclasses.replace(scene, cues=tuple(cue for cue in scene.cues if cue.name == "block"))
        for scene in hidden
    ]
    block = learn_objects(scenes, np.random.default_rng(0)).models["block"]
    half = np.sort(np.abs(block.points[:, :2]).max(axis=0))[::-1] + block.spacing / 2
    assert half == pytest.approx(SHAPES["block"][0], abs=0.008)


def test_absent_object_is_not_found(models, unseen):
    for name in ("block", "cup"):
        for poses in unseen[:4]:
            estimate = localise(views_of({k: T for k, T in poses.items() if k != name}), models[name])
            assert estimate.status == "not_found"
            assert estimate.confidence < 0.3


def test_two_of_a_kind_are_ambiguous(models, unseen):
    poses = unseen[0] | {"distractor": se3.from_yaw([0.0, -0.02, 0.0], 0.0)}
    views = render([(SHAPES["cup"], poses["cup"]), (SHAPES["cup"], poses["distractor"])])
    estimate = localise(views, models["cup"])
    assert estimate.status == "ambiguous"
    assert len(estimate.others) == 1
    for T in (poses["cup"], poses["distractor"]):
        told = (estimate.T_world_obj, *estimate.others)
        assert min(np.linalg.norm(one[:2, 3] - T[:2, 3]) for one in told) < 0.01


def test_a_single_object_has_no_others(models, unseen):
    for poses in unseen[:4]:
        views = views_of(poses)
        assert all(localise(views, models[name]).others == () for name in ("block", "cup"))


def test_one_view_is_enough_and_none_is_an_error(models, unseen):
    views = views_of(unseen[1])
    estimate = localise({"front": views["front"]}, models["cup"])
    assert estimate.status == "found"
    assert np.linalg.norm(estimate.T_world_obj[:2, 3] - unseen[1]["cup"][:2, 3]) < 0.01
    with pytest.raises(ObservationError, match="no camera views"):
        localise({}, models["cup"])


def test_mirrored_images_of_a_mirrored_camera_give_the_same_pose(models, unseen):
    for name in ("block", "cup"):
        views = views_of(unseen[0])
        mirrored = {
            key: dataclasses.replace(
                view,
                image=np.ascontiguousarray(view.image[:, ::-1]),
                camera=dataclasses.replace(
                    view.camera, fx=-view.camera.fx, cx=view.camera.width - 1 - view.camera.cx
                ),
            )
            for key, view in views.items()
        }
        plain, turned = localise(views, models[name]), localise(mirrored, models[name])
        assert turned.status == plain.status == "found"
        np.testing.assert_allclose(turned.T_world_obj[:3, 3], plain.T_world_obj[:3, 3], atol=1e-3)
        np.testing.assert_allclose(turned.T_world_obj[:3, :3], plain.T_world_obj[:3, :3], atol=0.01)


def test_covariance_is_positive_and_knows_what_cannot_be_seen(models, unseen):
    for name in ("block", "cup"):
        estimate = localise(views_of(unseen[2]), models[name])
        assert (np.linalg.eigvalsh(estimate.covariance) > 0).all()
        assert np.sqrt(estimate.covariance[0, 0]) < 0.005
    assert np.sqrt(estimate.covariance[3, 3]) == pytest.approx(np.pi / np.sqrt(3))


def test_malformed_views_are_refused(models, unseen):
    view = views_of(unseen[0])["front"]
    with pytest.raises(ObservationError, match="uint8"):
        localise({"front": dataclasses.replace(view, image=view.image.astype(float))}, models["cup"])
    with pytest.raises(ObservationError, match="rigid"):
        localise({"front": dataclasses.replace(view, T_world_cam=np.zeros((4, 4)))}, models["cup"])


def test_nothing_to_learn_from_is_an_error():
    with pytest.raises(DatasetError, match="nothing to learn"):
        learn_objects([], np.random.default_rng(0))


def test_store_round_trip(models):
    data, arrays = store.to_parts(models["block"])
    back = store.from_parts(json.loads(json.dumps(data)), arrays, "test")
    for field in dataclasses.fields(back):
        assert np.array_equal(getattr(back, field.name), getattr(models["block"], field.name))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("version", 2),
        ("name", ""),
        ("spacing", float("nan")),
        ("height", "0"),
        ("yaw_period", -1.0),
        ("spacing", True),
    ],
)
def test_store_refuses_bad_numbers(models, field, value):
    data, arrays = store.to_parts(models["block"])
    with pytest.raises(MemoryFormatError, match="test"):
        store.from_parts(data | {field: value}, arrays, "test")


@pytest.mark.parametrize("spoil", ["missing", "shape", "dtype", "nan", "few"])
def test_store_refuses_bad_arrays(models, spoil):
    data, arrays = store.to_parts(models["block"])
    points = arrays["points"]
    if spoil == "missing":
        del arrays["points"]
    else:
        bad = {
            "shape": points[:, :2],
            "dtype": points.astype(float),
            "nan": points * np.float32("nan"),
            "few": points[:3],
        }
        arrays["points"] = bad[spoil]
    with pytest.raises(MemoryFormatError, match="points"):
        store.from_parts(data, arrays, "test")
