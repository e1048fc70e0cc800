"""Masks from what the demonstrations taught."""

from dataclasses import replace

import numpy as np
import pytest
from tests.perception.segmentation.backends import LABELS, PHRASES, Backend, moved_up, patches, shapes

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.perception.localise import localise
from lerobot_openspm.perception.segmentation.learned import LearnedSegmenter


@pytest.fixture
def by_shape() -> Backend:
    return shapes()


@pytest.fixture
def by_patches() -> Backend:
    return patches()


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("phrase", PHRASES)
def test_the_mask_is_the_objects(by_shape, phrase):
    for camera, instances in by_shape.segmenter.segment(by_shape.views, [phrase])[phrase].items():
        truth = by_shape.views[camera].labels == LABELS[phrase]
        assert overlap(instances[0].mask, truth) > 0.85, camera
        assert instances[0].confidence > 0.7, camera


def test_a_few_pixels_of_the_right_colour_are_less_sure_than_the_object(by_shape):
    view = by_shape.views["front"]
    block = view.labels == LABELS["block"]
    colour = np.median(view.image[block], axis=0).astype(np.uint8)
    image = view.image.copy()
    image[4:9, 140:145] = colour
    instances = by_shape.segmenter.segment({"front": replace(view, image=image)}, ["block"])["block"]["front"]
    assert len(instances) == 2
    assert overlap(instances[0].mask, block) > 0.85
    assert instances[1].mask[5:8, 141:144].all()
    assert instances[1].confidence < 0.2


def test_of_an_object_known_by_patches_the_disc_around_its_point(by_patches):
    objects = by_patches.segmenter._objects
    found = by_patches.segmenter.segment(by_patches.views, PHRASES)
    for phrase in PHRASES:
        estimate = localise(by_patches.views, objects[phrase])
        looked_for_in = {probe.camera for probe in objects[phrase].probes}
        assert {camera for camera, instances in found[phrase].items() if instances} == looked_for_in
        for camera in looked_for_in:
            (one,) = found[phrase][camera]
            view = by_patches.views[camera]
            uv, _ = project(view.camera, view.T_world_cam, estimate.T_world_obj[:3, 3])
            np.testing.assert_allclose((one.box[:2] + one.box[2:]) / 2, uv, atol=1)
            sizes = [max(patch.image.shape) for p in objects[phrase].probes for patch in p.patches]
            assert min(sizes) - 3 <= np.ptp(one.box[[0, 2]]) <= max(sizes) + 3
            assert one.confidence == estimate.confidence


def test_a_camera_elsewhere_gives_no_disc(by_patches):
    found = by_patches.segmenter.segment(moved_up(by_patches.views, 0.05), PHRASES)
    assert found == {phrase: dict.fromkeys(by_patches.views, ()) for phrase in PHRASES}


def test_what_was_not_taught_is_named_with_what_was(by_shape):
    message = "taught no 'mug'; they taught block, cup. Add demonstrations .*sam3 or grounded_sam2"
    with pytest.raises(PerceptionError, match=message):
        by_shape.segmenter.segment(by_shape.views, ["block", "mug"])
    with pytest.raises(PerceptionError, match="taught nothing"):
        LearnedSegmenter({}).segment(by_shape.views, ["block"])
