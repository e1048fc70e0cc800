"""Masks that the observation brings."""

from dataclasses import replace

import numpy as np
import pytest
from tests.perception.segmentation.backends import LABELS, scene

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation.given import GivenSegmenter


@pytest.fixture(scope="module")
def views():
    return scene()


def test_a_mask_is_where_the_label_is(views):
    found = GivenSegmenter(LABELS).segment(views, list(LABELS))
    for phrase, number in LABELS.items():
        for camera, view in views.items():
            (one,) = found[phrase][camera]
            np.testing.assert_array_equal(one.mask, view.labels == number)
            assert one.confidence == 1


def test_two_names_may_mean_one_object(views):
    found = GivenSegmenter({"cup": 1, "blue cup": 1}).segment(views, ["cup", "blue cup"])
    np.testing.assert_array_equal(found["cup"]["side"][0].mask, found["blue cup"]["side"][0].mask)


def test_a_name_without_a_number_is_refused(views):
    with pytest.raises(PerceptionError, match=r"no label is given for 'mug'.*for block, cup\. Add its"):
        GivenSegmenter(LABELS).segment(views, ["mug"])


@pytest.mark.parametrize(
    ("camera", "field"),
    [("observation.images.front", "observation.masks.front"), ("front", "observation.masks.front")],
)
def test_a_view_without_labels_is_refused_with_the_field_it_lacks(views, camera, field):
    bare = {camera: replace(views["front"], labels=None)}
    with pytest.raises(PerceptionError, match=rf"the observation has no '{field}'.*--env\.masks=true"):
        GivenSegmenter(LABELS).segment(bare, ["cup"])


def test_labels_of_another_size_are_refused(views):
    small = {"front": replace(views["front"], labels=views["front"].labels[::2, ::2])}
    with pytest.raises(PerceptionError, match=r"masks\.front' has shape \(80, 80\), expected \(160, 160\)"):
        GivenSegmenter(LABELS).segment(small, ["cup"])
