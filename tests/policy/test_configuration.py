from dataclasses import replace
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import make_policy_config
from lerobot.utils.constants import ACTION, OBS_STATE
from scipy.spatial.transform import Rotation

from lerobot_openspm.cli.mine import MineConfig
from lerobot_openspm.configuration_openspm import JudgeConfig, OpenSPMConfig, SegmenterConfig
from lerobot_openspm.errors import LayoutError
from lerobot_openspm.perception.observation import split_batch

FINGERS = ["finger_left", "finger_right"]


def config(**options: Any) -> OpenSPMConfig:
    return OpenSPMConfig(device="cpu", push_to_hub=False, **options)


@pytest.mark.parametrize("name", ["perception", "memory_update", "conditioning", "execution", "rotation"])
def test_an_unknown_choice_is_named_with_the_known_ones(name: str):
    with pytest.raises(ValueError, match=rf"{name} is 'telepathy', expected one of \w+, "):
        config(**{name: "telepathy"})


LABELS = {"bowl": 1, "wine bottle": 4}


def masks(**options: Any) -> dict[str, Any]:
    return {"segmenter": SegmenterConfig(**options)}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (masks(shape="box"), "shape is 'box', but perception 'demonstrations' has no masks.*perception=sam3"),
        ({"perception": "oracle", **masks(shape="box")}, "'box', but perception 'oracle' has no masks"),
        ({"perception": "given"}, "segmenter.labels is None.*--policy.segmenter.labels='"),
        ({"perception": "sam3", **masks(labels=LABELS)}, "'sam3', segmenter.labels is {'bowl'"),
        (masks(labels=LABELS), "'demonstrations', segmenter.labels is {'bowl'"),
        (masks(weights=["one"]), "are for perception sam3 and grounded_sam2, got 'demonstrations'"),
    ],
)
def test_options_that_make_no_sense_together_are_refused(options: dict[str, Any], words: str):
    with pytest.raises(ValueError, match=words):
        config(**options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"shape": "telepathy"}, "segmenter.shape is 'telepathy', expected one of demonstrations, box"),
        ({"sam3d_python": "python"}, "are for shape 'sam3d', got 'demonstrations'"),
        ({"labels": {"bowl": 0}}, r"segmenter.labels\['bowl'\] is 0, expected .* 1 on"),
        ({"labels": {"bowl": True}}, r"segmenter.labels\['bowl'\] is True"),
    ],
)
def test_options_of_a_segmenter_are_checked(options: dict[str, Any], words: str):
    with pytest.raises(ValueError, match=words):
        SegmenterConfig(**options)


@pytest.mark.parametrize("shape", ["demonstrations", "box"])
def test_a_segmenter_goes_with_either_shape(shape: str):
    assert config(perception="given", **masks(labels=LABELS, shape=shape)).segmenter.shape == shape
    assert config(perception="grounded_sam2", **masks(shape=shape)).segmenter.shape == shape


def test_nested_options_are_read_from_a_command_line(capsys: pytest.CaptureFixture[str]):
    options = [
        "--policy.perception=given",
        '--policy.segmenter.labels={"bowl": 1, "wine bottle": 4}',
        "--policy.judge.type=openai",
        "--policy.judge.model_id=tiny-vl",
    ]
    policy = draccus.parse(MineConfig, args=options).policy
    assert policy.segmenter == SegmenterConfig(labels=LABELS)
    assert policy.judge == JudgeConfig("openai", model_id="tiny-vl")
    with pytest.raises(SystemExit):
        draccus.parse(MineConfig, args=["--policy.judge.type=telepathy"])
    assert "judge.type: invalid choice: 'telepathy' (choose from 'none', 'openai'" in capsys.readouterr().err


def test_a_configuration_is_saved_and_read_as_it_is(tmp_path: Path):
    """Through LeRobot's config.json, and its command line on top, with options that are not given."""
    saved = config(
        perception="given", **masks(labels=LABELS, shape="box"), memory_episodes=[0, 2],
        judge=JudgeConfig("openai", "http://localhost:8000/v1", "tiny-vl"), state_layout=["x", "y", "z"],
    )  # fmt: skip
    saved.save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == saved
    options = ["--judge.confidence=0.9", "--segmenter.labels=null", "--perception=sam3"]
    changed = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=options)
    assert isinstance(changed, OpenSPMConfig)
    assert changed.judge == replace(saved.judge, confidence=0.9)
    assert (changed.perception, changed.segmenter) == ("sam3", SegmenterConfig(shape="box"))
    assert changed.memory_episodes == [0, 2]


def test_lerobots_factory_makes_it_by_name():
    made = make_policy_config("openspm", device="cpu", execution="open_loop", push_to_hub=False)
    assert made == config(execution="open_loop")


@pytest.mark.parametrize("steps", [0, -1, 6])
def test_no_more_actions_are_executed_than_a_chunk_has(steps: int):
    with pytest.raises(ValueError, match=rf"n_action_steps is {steps}, expected 1 to chunk_size \(5\)"):
        config(n_action_steps=steps)


@pytest.mark.parametrize("name", ["num_inference_steps", "samples_per_frame", "hand_radius_m", "control_hz"])
@pytest.mark.parametrize("value", [0, -1, float("nan")])
def test_what_must_be_positive_is(name: str, value: float):
    with pytest.raises(ValueError, match=f"{name} is {value}, expected more than 0"):
        config(**{name: value})


@pytest.mark.parametrize("name", ["noise_seed", "reach_margin_m", "min_clearance_m"])
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
