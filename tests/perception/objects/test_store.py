"""Objects known by boxes, or by shapes from a segmenter's masks, on disk and back."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.perception.builders import box_model, masked_model

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.perception.objects import store
from lerobot_openspm.perception.objects.box.model import BoxModel


def again(known):
    fields, arrays = store.to_parts(known)
    return store.from_parts(json.loads(json.dumps(fields)), arrays, "here")


@given(
    st.floats(0.01, 1.0), st.floats(0.1, 1.0), st.floats(0.001, 1.0), st.floats(-1, 1),
    st.sampled_from([0.0, np.pi / 2, np.pi, 2 * np.pi]), st.floats(-3, 3), st.floats(0, 1),
)  # fmt: skip
def test_a_box_comes_back_to_the_last_bit(side, share, tall, height, period, centre, overlap):
    size = np.array([side, side if period == 0 else side * share, tall])
    known = BoxModel("tea pot", size, height, period, centre, overlap)
    back = again(known)
    assert isinstance(back, BoxModel)
    assert back.size.tobytes() == size.tobytes()
    for field in ("name", "height", "yaw_period", "yaw_centre", "typical_overlap"):
        assert getattr(back, field) == getattr(known, field)


def test_a_shape_remembers_that_a_segmenter_finds_its_pixels():
    known = masked_model("mug")
    back = again(known)
    assert back.log_odds is None
    np.testing.assert_array_equal(back.points, known.points)
    assert "log_odds" not in store.to_parts(known)[1]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"size": None}, "'size'.*list of 3"),
        ({"size": [0.1, 0.05]}, "'size'.*list of 3"),
        ({"size": "large"}, "'size'.*list of 3"),
        ({"size": [0.1, 0.05, float("nan")]}, "'size' is nan"),
        ({"size": [0.1, 0.05, 0.0]}, "'size' is 0.0"),
        ({"size": [0.1, 0.05, True]}, "'size' is True"),
        ({"size": [100.0, 0.05, 0.1]}, "'size' is 100.0"),
        ({"size": [0.05, 0.1, 0.1]}, "long side first"),
        ({"yaw_period": 0.0}, "both alike for a yaw period of 0"),
        ({"yaw_period": -1.0}, "'yaw_period'"),
        ({"height": float("inf")}, "'height'"),
        ({"typical_overlap": 1.5}, "'typical_overlap'"),
        ({"yaw_centre": "north"}, "'yaw_centre'"),
        ({"kind": "sphere"}, "'sphere', expected one of surface, patches, shape, box"),
        ({"name": ""}, "'name'"),
        ({"version": 2}, "version 2"),
    ],
)
def test_a_spoilt_box_is_refused(changes, words):
    fields, arrays = store.to_parts(box_model("rack"))
    with pytest.raises(MemoryFormatError, match=rf"here: .*{words}"):
        store.from_parts(fields | changes, arrays, "here")


@pytest.mark.parametrize("field", ["size", "height", "yaw_period", "yaw_centre", "typical_overlap"])
def test_a_box_without_a_field_is_refused(field):
    fields, arrays = store.to_parts(box_model("rack"))
    del fields[field]
    with pytest.raises(MemoryFormatError, match=f"here: '{field}'"):
        store.from_parts(fields, arrays, "here")


@pytest.mark.parametrize(
    ("foreground", "words"), [("magic", "'magic'"), ("colours", "'log_odds' is missing")]
)
def test_a_shape_whose_pixels_nothing_finds_is_refused(foreground, words):
    fields, arrays = store.to_parts(masked_model("mug"))
    with pytest.raises(MemoryFormatError, match=words):
        store.from_parts(fields | {"foreground": foreground}, arrays, "here")


@pytest.mark.parametrize(("yaw_period", "sides", "box_period"), [
    (0.0, (0.1, 0.1), 0.0), (np.pi / 2, (0.1, 0.098), np.pi / 2), (2 * np.pi, (0.1, 0.1), np.pi / 2),
    (2 * np.pi, (0.12, 0.06), np.pi), (np.pi, (0.12, 0.06), np.pi),
])  # fmt: skip
def test_what_a_box_shows_of_the_yaw(yaw_period, sides, box_period):
    known = box_model("box", yaw_period, sides)
    assert known.box_period == pytest.approx(box_period)
    assert known.is_round == (yaw_period == 0)
