"""Masks from what the demonstrations taught."""

from dataclasses import replace

import numpy as np
import pytest
from tests.perception.builders import model, patch_model
from tests.perception.segmentation.backends import LABELS, PHRASES, Backend, demonstrations

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.objects.model import ObjectModel
from lerobot_openspm.perception.segmentation.learned import LearnedSegmenter


@pytest.fixture
def learned(drawn_objects: dict[str, ObjectModel]) -> Backend:
    return demonstrations(drawn_objects)


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("phrase", PHRASES)
def test_the_mask_is_the_objects(learned, phrase):
    for camera, instances in learned.segmenter.segment(learned.views, [phrase])[phrase].items():
        truth = learned.views[camera].labels == LABELS[phrase]
        assert overlap(instances[0].mask, truth) > 0.85, camera
        assert instances[0].confidence > 0.7, camera


def test_a_few_pixels_of_the_right_colour_are_less_sure_than_the_object(learned):
    view = learned.views["front"]
    block = view.labels == LABELS["block"]
    colour = np.median(view.image[block], axis=0).astype(np.uint8)
    image = view.image.copy()
    image[4:9, 140:145] = colour
    instances = learned.segmenter.segment({"front": replace(view, image=image)}, ["block"])["block"]["front"]
    assert len(instances) == 2
    assert overlap(instances[0].mask, block) > 0.85
    assert instances[1].mask[5:8, 141:144].all()
    assert instances[1].confidence < 0.2


def test_an_object_known_by_patches_has_no_mask(learned):
    objects = {"cup": model("cup"), "stove": patch_model("stove")}
    message = "'stove' is known by patches .*no mask of it; there are masks of cup. .*more than 3 cm apart"
    with pytest.raises(PerceptionError, match=message):
        LearnedSegmenter(objects).segment(learned.views, ["cup", "stove"])


def test_what_was_not_taught_is_named_with_what_was(learned):
    message = "taught no 'mug'; there are masks of block, cup. Record demonstrations that.*or grounded_sam2"
    with pytest.raises(PerceptionError, match=message):
        learned.segmenter.segment(learned.views, ["block", "mug"])
    with pytest.raises(PerceptionError, match="masks of nothing"):
        LearnedSegmenter({}).segment(learned.views, ["block"])
