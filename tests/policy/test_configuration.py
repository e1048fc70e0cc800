from typing import Any

import draccus
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_STATE
from scipy.spatial.transform import Rotation

from lerobot_openspm.cli.mine import MineConfig
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import LayoutError
from lerobot_openspm.perception.observation import split_batch

FINGERS = ["finger_left", "finger_right"]


def config(**options: Any) -> OpenSPMConfig:
    return OpenSPMConfig(device="cpu", push_to_hub=False, **options)


@pytest.mark.parametrize(
    "name",
    ["perception", "segmentation", "shape", "memory_update", "conditioning", "execution", "state_rotation"],
)
def test_an_unknown_choice_is_named_with_the_known_ones(name: str):
    with pytest.raises(ValueError, match=rf"{name} is 'telepathy', expected one of \w+, "):
        config(**{name: "telepathy"})


LABELS = {"bowl": 1, "wine bottle": 4}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"shape": "box"}, "shape is 'box', but without a segmenter.*segmentation=sam3"),
        ({"sam3d_python": "python"}, "are for shape 'sam3d', got 'demonstrations'"),
        ({"segmentation": "sam3", "perception": "oracle"}, "'sam3', but perception=oracle"),
        ({"segmentation": "given"}, "mask_labels is None.*--policy.mask_labels='"),
        ({"segmentation": "sam3", "mask_labels": LABELS}, "'sam3', mask_labels is {'bowl'"),
        ({"mask_labels": LABELS}, "'demonstrations', mask_labels is {'bowl'"),
        (
            {"segmentation": "given", "mask_labels": {"bowl": 0}},
            r"mask_labels\['bowl'\] is 0, expected .* 1 on",
        ),
        ({"segmentation": "given", "mask_labels": {"bowl": True}}, r"mask_labels\['bowl'\] is True"),
    ],
)
def test_options_that_make_no_sense_together_are_refused(options: dict[str, Any], words: str):
    with pytest.raises(ValueError, match=words):
        config(**options)


@pytest.mark.parametrize("shape", ["demonstrations", "box"])
def test_a_segmenter_goes_with_either_shape(shape: str):
    assert config(segmentation="given", mask_labels=LABELS, shape=shape).mask_labels == LABELS
    assert config(segmentation="grounded_sam2", shape=shape).shape == shape


def test_labels_are_read_from_a_command_line():
    options = ["--policy.segmentation=given", '--policy.mask_labels={"bowl": 1, "wine bottle": 4}']
    assert draccus.parse(MineConfig, args=options).policy.mask_labels == LABELS


@pytest.mark.parametrize("steps", [0, -1, 6])
def test_no_more_actions_are_executed_than_a_chunk_has(steps: int):
    with pytest.raises(ValueError, match=rf"n_action_steps is {steps}, expected 1 to chunk_size \(5\)"):
        config(n_action_steps=steps)


@pytest.mark.parametrize(
    "name",
    ["hidden_dim", "num_inference_steps", "samples_per_frame", "residual_m", "passing_rad", "max_jump_m"],
)
@pytest.mark.parametrize("value", [0, -1])
def test_what_must_be_positive_is(name: str, value: int):
    with pytest.raises(ValueError, match=f"{name} is {value}, expected more than 0"):
        config(**{name: value})


@pytest.mark.parametrize(
    "name", ["perturbation_m", "max_corrections", "max_attempts", "reach_margin_m", "weight_geometric"]
)
def test_what_must_not_be_negative_is_not(name: str):
    assert getattr(config(**{name: 0}), name) == 0
    with pytest.raises(ValueError, match=f"{name} is -1, expected 0 or more"):
        config(**{name: -1})


def features(state: int = 8, action: int = 7, cameras: int = 1) -> dict[str, Any]:
    images = {
        f"observation.images.{i}": PolicyFeature(FeatureType.VISUAL, (3, 64, 64)) for i in range(cameras)
    }
    return {
        "input_features": images | {OBS_STATE: PolicyFeature(FeatureType.STATE, (state,))},
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (action,))},
    }


def test_features_are_checked():
    names = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z"]
    layouts = {"state_layout": names + FINGERS, "action_layout": [*names, "gripper"]}
    config(**features(), **layouts).validate_features()
    with pytest.raises(ValueError, match=r"at least one camera, got input features \['observation.state'\]"):
        config(**features(cameras=0), **layouts).validate_features()
    with pytest.raises(ValueError, match=r"observation.state has 9 numbers, but its layout names 8: \['x'"):
        config(**features(state=9), **layouts).validate_features()
    with pytest.raises(ValueError, match=r"action has 4 numbers, but its layout names 7: \['x'"):
        config(**features(action=4), **layouts).validate_features()
    stateless = features()
    del stateless["input_features"][OBS_STATE]
    with pytest.raises(ValueError, match=r"needs 'observation\.state', got features"):
        config(**stateless, **layouts).validate_features()


def test_layouts_come_from_the_dataset_unless_given():
    found = config(action_layout=["x", "y", "z", "gripper"])
    names = {"motors": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]}
    found.set_dataset_feature_metadata({OBS_STATE: {"names": names}, ACTION: {"names": names}})
    state, action = found.layouts()
    assert (state.size, state.rotation_kind) == (7, "euler")
    assert (action.size, action.rotation_kind) == (4, "none")


def test_missing_names_say_which_option_to_set():
    with pytest.raises(LayoutError, match=r"set --policy\.state_layout"):
        config().layouts()
    with pytest.raises(LayoutError, match=r"set --policy\.action_layout"):
        config(state_layout=["x", "y", "z", "gripper"], action_layout=["joint_1", "joint_2"]).layouts()


@pytest.mark.parametrize("kind", ["none", "axis_angle", "quat", "euler"])
def test_every_way_of_writing_a_rotation_gives_the_same_hand(kind: str):
    rotation = Rotation.from_rotvec([[2.9, 0.3, -0.1], [0.2, -0.4, 0.5]])
    names, numbers = {
        "none": ([], np.zeros((2, 0))),
        "axis_angle": ([f"axis_angle_{a}" for a in "xyz"], rotation.as_rotvec()),
        "quat": ([f"quat_{a}" for a in "xyzw"], rotation.as_quat()),
        "euler": (["roll", "pitch", "yaw"], rotation.as_euler("xyz")),
    }[kind]
    layout = ["x", "y", "z", *names, *FINGERS]
    state_layout, action_layout = config(
        state_layout=layout, action_layout=[*layout[:-2], "gripper"]
    ).layouts()
    position, fingers = np.array([[0.5, 0.1, 0.2], [0.4, 0.0, 0.3]]), np.array([[0.04, -0.04], [0.01, -0.01]])
    states = torch.as_tensor(np.hstack([position, numbers, fingers]))
    hands = [o.hand for o in split_batch({OBS_STATE: states, "task": ["push it"] * 2}, state_layout)]
    expected = np.tile(np.eye(3), (2, 1, 1)) if kind == "none" else rotation.as_matrix()
    np.testing.assert_allclose([h.T_world_ee[:3, :3] for h in hands], expected, atol=1e-9)
    np.testing.assert_allclose([h.T_world_ee[:3, 3] for h in hands], position)
    np.testing.assert_allclose([h.opening for h in hands], [0.08, 0.02])
    actions = np.hstack([0.1 * position, [[0.1, 0.2, -0.3], [0, 0, 0.5]], [[1], [-1]]])
    vectors = action_layout.encode_actions(actions)
    assert vectors.shape == (2, action_layout.size)
    kept = np.delete(actions, [3, 4, 5], axis=1) if kind == "none" else actions
    decoded = action_layout.decode_actions(vectors)
    np.testing.assert_allclose(
        np.delete(decoded, [3, 4, 5], axis=1) if kind == "none" else decoded, kept, atol=1e-9
    )


def test_numbers_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="residual_m"):
        config(residual_m=float("nan"))
