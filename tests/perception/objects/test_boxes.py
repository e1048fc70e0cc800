"""Learning the boxes of drawn objects from cues and masks, and finding them again."""

from dataclasses import replace

import numpy as np
import pytest
from tests.perception.builders import examples, localise
from tests.perception.drawn_masks import (
    LABELS,
    body,
    instances_of,
    labels_of,
    masked_views,
    segmenter,
    turned_yaw,
)
from tests.perception.drawn_world import demonstration, draw_pose, draw_poses

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.base import Appearance, ObjectShape
from lerobot_openspm.perception.objects.box.learn import learn_boxes
from lerobot_openspm.perception.objects.box.model import BoxModel
from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.objects.mask_association import touched
from lerobot_openspm.perception.objects.shape.model import ShapeModel
from lerobot_openspm.perception.pipeline import detect
from lerobot_openspm.types import ContactCue, Segmentation

NAMES = ("block", "cup")


def masked_demonstration(rng, only=None):
    """A demonstration whose first frame comes with labels."""
    state = rng.bit_generator.state
    poses = draw_poses(rng)
    rng.bit_generator.state = state
    return replace(demonstration(rng), views=masked_views(poses, only=only))


@pytest.fixture(scope="module")
def scenes():
    rng = np.random.default_rng(1)
    return [masked_demonstration(rng) for _ in range(6)]


@pytest.fixture(scope="module")
def models(scenes):
    return learn_boxes(examples(NAMES, scenes, (), segmenter(), "box"))


@pytest.fixture(scope="module")
def unseen():
    rng = np.random.default_rng(2)
    return [draw_poses(rng) for _ in range(12)]


def test_size_support_plane_and_symmetry_are_learned(models):
    for name in NAMES:
        assert models[name].size == pytest.approx(body(name, np.eye(4)).size, abs=0.003)
        assert models[name].height == pytest.approx(0.0, abs=0.003)
        assert models[name].typical_overlap > 0.85
    assert models["block"].yaw_period == pytest.approx(np.pi)
    assert models["cup"].yaw_period == 0


@pytest.mark.parametrize("name", NAMES)
def test_objects_are_found_within_millimetres(models, unseen, name):
    errors, turns = [], []
    for poses in unseen:
        views = masked_views(poses)
        found = localise(views, models[name], instances_of(views, name))
        assert found.status == "found"
        assert found.confidence > 0.9
        errors.append(np.linalg.norm(found.T_world_obj[:2, 3] - poses[name][:2, 3]))
        turns.append(turned_yaw(found.T_world_obj, poses[name], np.pi))
    assert np.mean(errors) < 0.0015
    assert max(errors) < 0.004
    if name == "block":
        assert np.rad2deg(np.mean(turns)) < 1.5


def test_one_demonstration_is_enough(scenes, unseen):
    learned = learn_boxes(examples(NAMES, scenes[:1], (), segmenter(), "box"))
    assert learned["block"].yaw_period == pytest.approx(2 * np.pi)  # nothing showed that it looks alike
    for poses in unseen[:4]:
        views = masked_views(poses)
        for name in NAMES:
            found = localise(views, learned[name], instances_of(views, name))
            assert np.linalg.norm(found.T_world_obj[:2, 3] - poses[name][:2, 3]) < 0.004


def test_one_camera_is_enough_where_the_plane_is_known(models, unseen):
    errors = []
    for poses in unseen:
        views = masked_views(poses, only=("front",))
        found = localise(views, models["block"], instances_of(views, "block"))
        errors.append(np.linalg.norm(found.T_world_obj[:2, 3] - poses["block"][:2, 3]))
    assert np.mean(errors) < 0.003


def test_the_yaw_stays_within_half_a_period_of_the_demonstrations(models):
    model = replace(models["block"], yaw_centre=0.4)
    for yaw in np.linspace(-np.pi, np.pi, 9):
        poses = {"block": se3.from_yaw([0.0, -0.1, 0.0], yaw)}
        views = masked_views(poses)
        found = localise(views, model, instances_of(views, "block")).T_world_obj
        assert abs(se3.yaw_of(found) - 0.4) <= np.pi / 2 + 1e-9
        assert turned_yaw(found, poses["block"], np.pi) < np.deg2rad(4)
    assert se3.yaw_of(localise(views, models["cup"], instances_of(views, "block")).T_world_obj) == 0


def test_moving_everything_moves_the_answer(models):
    poses = draw_poses(np.random.default_rng(5))
    T_moved = se3.from_yaw([0.3, -0.2, 0.0], 0.8)
    moved = {name: T_moved @ T for name, T in poses.items()}
    here, there = masked_views(poses), masked_views(moved, T_moved)
    for name in NAMES:
        one = localise(here, models[name], instances_of(here, name))
        two = localise(there, models[name], instances_of(there, name))
        assert (T_moved @ one.T_world_obj)[:3, 3] == pytest.approx(two.T_world_obj[:3, 3], abs=5e-4)


def two_blocks():
    rng = np.random.default_rng(7)
    poses = {
        "block": draw_pose(rng, (-0.1, -0.2), (0.1, -0.15)),
        "cup": draw_pose(rng, (-0.1, 0.15), (0.1, 0.2)),
    }
    views = masked_views(poses)
    both = {name: body("block", T) for name, T in poses.items()}
    found = {}
    for camera, view in views.items():
        labels = labels_of(view, both)
        found[camera] = tuple(Segmentation(labels == LABELS[name], 0.9) for name in NAMES)
    return views, poses, found


def test_two_equally_good_instances_are_ambiguous(models):
    views, poses, found = two_blocks()
    estimate = localise(views, models["block"], found)
    assert estimate.status == "ambiguous"
    assert len(estimate.others) == 1
    for T in poses.values():
        told = (estimate.T_world_obj, *estimate.others)
        assert min(np.linalg.norm(one[:2, 3] - T[:2, 3]) for one in told) < 0.004


def test_a_part_that_is_segmented_too_is_no_second_object(models):
    poses = draw_poses(np.random.default_rng(7))
    views = masked_views(poses, only=("front",))
    (whole,) = instances_of(views, "block")["front"]
    part = whole.mask.copy()
    part[:, np.flatnonzero(part.any(0))[-1]] = False
    estimate = localise(views, models["block"], {"front": (whole, Segmentation(part, 0.8))})
    assert estimate.status == "found"


def test_of_two_instances_the_one_of_the_right_size_is_taken(models):
    poses = draw_poses(np.random.default_rng(7))
    views = masked_views(poses)
    block, wrong = instances_of(views, "block"), instances_of(views, "distractor")
    found = {camera: (*wrong[camera], *block[camera]) for camera in views}
    estimate = localise(views, models["block"], found)
    assert estimate.status == "found"
    assert np.linalg.norm(estimate.T_world_obj[:2, 3] - poses["block"][:2, 3]) < 0.004


def test_the_instance_that_the_hand_touched_is_learned():
    views, poses, found = two_blocks()
    for name in NAMES:
        cue = ContactCue("block", poses[name][:3, 3] + [0, 0, 0.04], "grasp")
        chosen = touched(views, found, [cue], 0.0)
        index = NAMES.index(name)
        assert all(chosen[camera] is found[camera][index] for camera in views)
        above = ContactCue("block", poses[name][:3, 3] + [0, 0, 0.2], "release")
        assert touched(views, found, [above], 0.0) == chosen
    nowhere = ContactCue("block", np.array([0.0, 0.4, 0.0]), "grasp")
    assert touched(views, found, [nowhere], 0.0) == {}


@pytest.mark.parametrize("found", [{}, {"front": ()}])
def test_without_masks_nothing_is_found(models, unseen, found):
    estimate = localise(masked_views(unseen[0]), models["block"], found)
    assert estimate.status == "not_found"
    assert estimate.confidence == 0
    assert estimate.covariance[0, 0] >= 1


def test_something_quite_different_is_not_found(models, unseen):
    views = masked_views(unseen[0])
    huge = {camera: (Segmentation(np.ones_like(v.labels, bool), 1.0),) for camera, v in views.items()}
    assert localise(views, models["block"], huge).status == "not_found"


def test_what_is_never_seen_near_the_hints_is_left_out(scenes):
    away = [
        replace(s, cues=tuple(replace(h, point_world=h.point_world + np.array([0, 0.5, 0])) for h in s.cues))
        for s in scenes
    ]
    learned = learn_objects(away, np.random.default_rng(0), segmenter=segmenter(), source="box")
    assert learned.models == {}
    assert "the segmenter shows it in no picture" in learned.left_out["block"]


def test_learning_chooses_by_segmenter_and_shape(scenes, unseen):
    boxes = learn_objects(scenes, np.random.default_rng(0), segmenter=segmenter(), source="box").models
    assert {name: type(model) for name, model in boxes.items()} == dict.fromkeys(NAMES, BoxModel)
    shapes = learn_objects(scenes, np.random.default_rng(0), segmenter=segmenter()).models
    for name, model in shapes.items():
        assert isinstance(model, ShapeModel)
        assert model.log_odds is None, name
    for models in (boxes, shapes):
        errors = []
        for poses in unseen[:6]:
            views = masked_views(poses)
            for name, found in detect(views, models, segmenter()).items():
                assert found.status == "found"
                errors.append(np.linalg.norm(found.T_world_obj[:2, 3] - poses[name][:2, 3]))
        assert np.mean(errors) < 0.003


def test_a_segmenter_is_asked_once_for_all_objects(models, unseen, scenes):
    asked = []

    class Counting:
        def segment(self, views, phrases):
            asked.append(list(phrases))
            return segmenter().segment(views, phrases)

    detect(masked_views(unseen[0]), models, Counting())
    detect(masked_views(unseen[0]), {}, Counting())
    assert asked == [list(NAMES)]
    learn_boxes(examples(NAMES, scenes[:2], (), Counting(), "box"))
    assert asked == [list(NAMES)] * 3


def test_what_was_learned_from_masks_is_not_sought_without(models, unseen):
    views = masked_views(unseen[0])
    with pytest.raises(PerceptionError, match="'block' was learned from a segmenter's masks"):
        localise(views, models["block"])
    shaped = ShapeModel("cup", None, np.zeros((8, 3), np.float32), 0.01, 0.0, 0.0, 0.0, 0.0, 0.9)
    with pytest.raises(PerceptionError, match="'cup' was learned from a segmenter's masks"):
        localise(views, shaped)


class Told:
    """A shape backend that knows how large things truly are, and remembers what it was asked for."""

    def __init__(self):
        self.asked = []

    def describe(self, objects: list[Appearance]):
        return [self._shape(one) for one in objects]

    def _shape(self, one: Appearance):
        labels = one.view.labels[one.segmentation.mask]
        name = next(name for name in NAMES if (labels == LABELS[name]).mean() > 0.5)
        self.asked.append(name)
        foot = np.append(one.points_world[:, :2].mean(axis=0), 0.0)
        return ObjectShape(se3.from_yaw(foot, 0.0), np.asarray(body(name, np.eye(4)).size, float), 0.9)


def test_a_shape_backend_tells_the_size_once_per_object_and_the_masks_the_rest(scenes, unseen):
    told = Told()
    models = learn_boxes(examples(NAMES, scenes, (), segmenter(), "sam3d", told))
    assert sorted(told.asked) == sorted(NAMES)
    for name in NAMES:
        assert models[name].size == pytest.approx(body(name, np.eye(4)).size, abs=1e-9)
    assert models["cup"].yaw_period == 0
    assert models["block"].yaw_period == pytest.approx(np.pi)
    views = masked_views(unseen[0])
    for name in NAMES:
        found = localise(views, models[name], instances_of(views, name))
        assert np.linalg.norm(found.T_world_obj[:2, 3] - unseen[0][name][:2, 3]) < 0.004
