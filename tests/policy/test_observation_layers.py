"""Masks and depth of an observation reach the views, checked."""

import numpy as np
import pytest
import torch
from lerobot.envs.utils import preprocess_observation

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.configuration import TabletopEnvConfig
from lerobot_openspm.envs.tabletop.recording import Tabletop
from lerobot_openspm.errors import ObservationError
from lerobot_openspm.geometry.camera import cameras_from_dict
from lerobot_openspm.geometry.vector_layout import parse_layout
from lerobot_openspm.perception.observation import split_batch
from lerobot_openspm.perception.segmentation.given import GivenSegmenter
from lerobot_openspm.processor_openspm import make_openspm_pre_post_processors

SIZE = 128
CAMERAS = cameras_from_dict(Tabletop().calibration(SIZE, SIZE), "tabletop")
LAYOUT = parse_layout(
    ("x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right"), "state"
)


@pytest.fixture(scope="module")
def raw():
    """Two environments' first observation as the tabletop gives it."""
    config = TabletopEnvConfig(
        "push_plate", masks=True, depth=True, observation_height=SIZE, observation_width=SIZE
    )
    ((env,),) = (envs.values() for envs in config.create_envs(2).values())
    observation, _ = env.reset(seed=[0, 1])
    env.close()
    return observation


@pytest.fixture
def batch(raw):
    """What the policy gets of it, by LeRobot's own steps."""
    preprocess, _ = make_openspm_pre_post_processors(OpenSPMConfig(device="cpu"))
    return preprocess(preprocess_observation(raw) | {"task": ["push the plate"] * 2})


def views_of(batch, row=0):
    return split_batch(batch, LAYOUT)[row].views(CAMERAS)


def test_masks_and_depth_reach_the_views_of_their_environment(raw, batch):
    for row in range(2):
        for key, view in views_of(batch, row).items():
            name = key.rpartition(".")[2]
            assert view.labels.dtype == np.int32
            assert view.depth.dtype == np.float32
            np.testing.assert_array_equal(view.labels, raw[f"masks.{name}"][row, 0])
            np.testing.assert_array_equal(view.depth, raw[f"depth.{name}"][row, 0])
    assert views_of(batch)["observation.images.front"].labels.max() == len(scene.OBJECT_NAMES)


def test_given_masks_are_what_the_environment_gave(raw, batch):
    views = views_of(batch, row=1)
    found = GivenSegmenter(scene.OBJECT_LABELS).segment(views, scene.OBJECT_NAMES)
    for key in views:
        labels = raw[f"masks.{key.rpartition('.')[2]}"][1, 0]
        for name, number in scene.OBJECT_LABELS.items():
            shown = [one.mask for one in found[name][key]]
            assert len(shown) == (number in labels)
            assert all(np.array_equal(mask, labels == number) for mask in shown)


def test_they_are_optional_camera_by_camera(batch):
    given = {key: value for key, value in batch.items() if "masks" not in key and "depth.side" not in key}
    views = views_of(given)
    assert all(view.labels is None for view in views.values())
    assert [key for key, view in views.items() if view.depth is None] == ["observation.images.side"]


MASKS, DEPTH = "observation.masks.front", "observation.depth.front"


def one_value(value):
    def change(layer):
        changed = layer.clone()
        changed[0, 0, 5, 7] = value
        return changed

    return change


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        (MASKS, lambda x: x[..., :100], r"masks\.front' has shape \(1, 128, 100\), expected \(1, 128, 128\)"),
        (MASKS, lambda x: x.repeat(1, 2, 1, 1), r"has shape \(2, 128, 128\)"),
        (MASKS, lambda x: x[:, 0], r"Tensor of shape \(2, 128, 128\), expected a tensor of \(2, 1, height"),
        (MASKS, lambda x: x[:1], r"shape \(1, 1, 128, 128\), expected a tensor of \(2, 1"),
        (MASKS, lambda x: [3], "is a list of shape"),
        (MASKS, one_value(0.5), "no numbers of objects.*do not normalise or interpolate"),
        (MASKS, one_value(-1.0), "from -1 to 7 that are no numbers"),
        (MASKS, one_value(1e20), r"to 1e\+20 that are no numbers"),
        (MASKS, one_value(torch.nan), "masks.front' holds NaN"),
        (DEPTH, lambda x: x[..., :100, :], r"depth\.front' has shape \(1, 100, 128\)"),
        (DEPTH, one_value(torch.inf), "depth.front' holds NaN or infinite.*0 where nothing is known"),
        (DEPTH, one_value(-0.1), "at least -0.1, expected metres"),
        (DEPTH, lambda x: (x * 1000).to(torch.int32), "is of int32.*divide millimetres by 1000"),
    ],
)
def test_a_layer_that_does_not_fit_is_refused(batch, key, change, message):
    with pytest.raises(ObservationError, match=message):
        views_of(batch | {key: change(batch[key])})


def test_a_layer_of_a_camera_that_is_not_looked_through_is_no_matter(batch):
    assert len(views_of(batch | {"observation.masks.roof": torch.zeros(2, 1, 4, 4)})) == 3


def test_integers_are_taken_as_they_are(batch):
    given = batch | {MASKS: batch[MASKS].to(torch.uint8)}
    expected = views_of(batch)["observation.images.front"].labels
    np.testing.assert_array_equal(views_of(given)["observation.images.front"].labels, expected)
