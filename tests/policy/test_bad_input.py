"""Each mistake is one error of ours that says what was got and what to do."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from tests.memory.memory_files import edit_header, names
from tests.policy.conftest import Frame, batch_of
from tests.policy.lerobot_commands import call_lerobot, train_arguments, training_options
from tests.policy.test_learning import new_config

from lerobot_openspm.configuration_openspm import OpenSPMConfig, SegmenterConfig
from lerobot_openspm.errors import (
    CalibrationError,
    DatasetError,
    LayoutError,
    MemoryFormatError,
    ObservationError,
    OpenSPMError,
    PerceptionError,
)
from lerobot_openspm.geometry.camera import cameras_to_dict
from lerobot_openspm.memory.schema import VERSION
from lerobot_openspm.modeling_openspm import OpenSPMPolicy

FRONT = "observation.images.front"


def without(key: str) -> Callable[[dict], dict]:
    return lambda batch: {k: v for k, v in batch.items() if k != key}


def replaced(key: str, change: Callable[[Any], Any]) -> Callable[[dict], dict]:
    return lambda batch: batch | {key: change(batch[key])}


def first_is_nan(values: torch.Tensor) -> torch.Tensor:
    return torch.where(torch.arange(values.numel()).view(values.shape) == 0, torch.nan, values)


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (without(FRONT), ObservationError, "no camera 'observation.images.front'.*--policy.cameras"),
        (replaced(FRONT, lambda x: x[..., :100]), CalibrationError, "128"),
        (replaced(FRONT, lambda x: x[:, :1]), ObservationError, r"shape \(1, 128, 128\), expected \(3"),
        (replaced(FRONT, first_is_nan), ObservationError, "camera 'observation.images.front'.*NaN"),
        (replaced("observation.state", first_is_nan), ObservationError, "'observation.state' is not finite"),
        (replaced("observation.state", lambda x: x[:, :7]), LayoutError, "expected a last axis of 8"),
        (without("observation.state"), ObservationError, "no 'observation.state'; it has"),
        (without("task"), ObservationError, "no 'task', the instruction"),
    ],
)
def test_a_bad_observation_is_refused(
    policy: OpenSPMPolicy,
    recorded: list[list[Frame]],
    spoil: Callable[[dict], dict],
    error: type[OpenSPMError],
    message: str,
):
    batch = batch_of([recorded[0][0]])
    with pytest.raises(error, match=message):
        policy.select_action(spoil(batch))
    # A mistake leaves nothing behind.
    policy.reset()
    assert torch.isfinite(policy.select_action(batch)).all()


@pytest.mark.parametrize(
    ("task", "why"),
    [
        ("juggle the eggs", "no verb I know"),
        ("", "expected one like"),
        ("put the fork on the plate", "it knows: put the bowl"),
    ],
)
def test_an_instruction_that_is_refused_does_not_end_the_other_episodes(
    policy: OpenSPMPolicy, recorded: list[list[Frame]], task: str, why: str
):
    alone = policy.select_action(batch_of([recorded[0][0]]))
    policy.reset()
    batch = batch_of([recorded[0][0], recorded[0][0]])
    actions = policy.select_action(batch | {"task": [batch["task"][0], task]})
    assert torch.equal(actions[:1], alone)
    assert [one.controller.state.status.value for one in policy.episodes] == ["running", "not_understood"]
    assert torch.count_nonzero(actions[1, :6]) == 0
    assert why in policy.episodes[1].controller.state.refusal


@pytest.mark.parametrize(
    "spoil",
    [
        replaced("observation.state", lambda x: x[0]),
        replaced("task", lambda tasks: tasks[:1]),
        replaced("task", lambda _: [None, None]),
    ],
    ids=["no batch axis", "fewer tasks than rows", "a task that is no text"],
)
def test_a_malformed_batch_is_refused(
    policy: OpenSPMPolicy, recorded: list[list[Frame]], spoil: Callable[[dict], dict]
):
    with pytest.raises(OpenSPMError):
        policy.select_action(spoil(batch_of([recorded[0][0], recorded[3][0]])))


@pytest.fixture
def copy(checkpoint: Path, tmp_path: Path) -> Path:
    """A checkpoint to spoil."""
    return Path(shutil.copytree(checkpoint, tmp_path / "checkpoint"))


@pytest.mark.parametrize("index", range(2))
def test_a_checkpoint_without_its_memory_is_refused(
    load: Callable[..., OpenSPMPolicy], copy: Path, index: int
):
    name = names(copy)[index]
    (copy / name).unlink()
    with pytest.raises(MemoryFormatError, match=f"no memory at .*{name}.*pull the whole checkpoint"):
        load(copy)


@pytest.mark.parametrize("index", range(2))
def test_a_truncated_memory_is_refused(load: Callable[..., OpenSPMPolicy], copy: Path, index: int):
    name = names(copy)[index]
    (copy / name).write_bytes((copy / name).read_bytes()[:-100])
    with pytest.raises(MemoryFormatError, match=f"{name}.*truncated.*train or pull it again"):
        load(copy)


SHORT_LAYOUT = {"names": ["x", "y", "z", "gripper"], "rotation": "none"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": VERSION + 1}, f"got version {VERSION + 1}, expected {VERSION}; upgrade"),
        ({"version": VERSION - 1}, f"got version {VERSION - 1}, expected {VERSION}; train again"),
        ({"format": "something"}, "something.*expected format 'openspm-memory'"),
        ({"segmentation": "given"}, "perception=given, got --policy.perception=demonstrations"),
        ({"objects": {}}, "got `object` - at `.*objects`"),
        ({"objects": [3]}, r"got `int` - at `.*objects\[0\]`"),
        ({"robot": None}, "got `null` - at `.*robot`"),
        ({"arrays": ""}, "at `.*arrays`"),
        (
            {
                "layouts": {
                    what: {"names": ["x", "y", "z", "gripper"], "rotation": "none"}
                    for what in ("state", "action")
                }
            },
            r"'layouts': the memory's state is \['x', 'y', 'z', 'gripper'\].*the configuration's.*robots",
        ),
    ],
)
def test_a_changed_memory_is_refused(
    load: Callable[..., OpenSPMPolicy], copy: Path, change: dict, message: str
):
    edit_header(copy, lambda header: header.update(change))
    with pytest.raises(MemoryFormatError, match=message):
        load(copy)


def test_a_checkpoint_loads_from_any_folder(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    policy = OpenSPMPolicy.from_pretrained(copy)
    assert policy.memory is not None
    assert len(policy.memory.cameras) == 3


def test_a_path_that_is_no_checkpoint_is_named():
    with pytest.raises(FileNotFoundError, match="no checkpoint folder at /nowhere/at/all"):
        OpenSPMPolicy.from_pretrained("/nowhere/at/all")


def test_nothing_is_saved_without_a_memory(policy: OpenSPMPolicy, tmp_path: Path):
    policy.memory = None
    with pytest.raises(MemoryFormatError, match="this policy has no memory"):
        policy.save_pretrained(tmp_path / "out")
    assert not (tmp_path / "out/memory.json").exists()


@pytest.fixture
def oracle(tiny_meta: LeRobotDatasetMetadata) -> OpenSPMPolicy:
    config = new_config(tiny_meta, perception="oracle", memory_episodes=[0])
    return OpenSPMPolicy(config, dataset_meta=tiny_meta)


def test_the_oracle_needs_the_poses(oracle: OpenSPMPolicy, recorded: list[list[Frame]]):
    batch = batch_of([recorded[0][0]])
    with pytest.raises(ObservationError, match=r"perception=oracle needs.*--env\.object_poses=true"):
        oracle.select_action(batch)
    oracle.reset()
    poses = torch.tensor([0.5, 0, 0, 1, 0, 0, 0]).tile(7)[None]
    assert torch.isfinite(oracle.select_action(batch | {"observation.object_poses": poses})).all()


@pytest.mark.slow
def test_the_oracle_needs_as_many_poses_as_were_recorded(oracle: OpenSPMPolicy, recorded: list[list[Frame]]):
    with pytest.raises(ObservationError, match="object_poses"):
        oracle.select_action(batch_of([recorded[0][0]]) | {"observation.object_poses": torch.zeros(1, 5)})


def test_training_without_a_calibration_says_how_to_give_one(tiny_dataset: Path, tmp_path: Path):
    output = tmp_path / "run"
    message = "mining needs the cameras' calibration, got none; pass --policy.cameras=FILE"
    options = (*training_options(tiny_dataset, output), "--policy.cameras=null")
    with pytest.raises(CalibrationError, match=message):
        call_lerobot("lerobot-train", *train_arguments(*options))
    assert not list(output.rglob("memory.*"))


def record_by_hand(root: Path, task: str, frames: int = 40) -> LeRobotDatasetMetadata:
    """A hand that comes down, always open, and goes nowhere."""
    names = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z"]
    features = {
        key: {"dtype": "float32", "shape": (len(n),), "names": n}
        for key, n in (
            ("observation.state", [*names, "finger_left", "finger_right"]),
            ("action", [*names, "gripper"]),
        )
    }
    image = {"dtype": "image", "shape": (128, 128, 3), "names": ["height", "width", "channels"]}
    cameras = {f"observation.images.{name}": image for name in ("front", "side", "wrist")}
    dataset = LeRobotDataset.create(
        "local/hand", fps=20, features=features | cameras, root=root, use_videos=False
    )
    for i in range(frames):
        state = np.array([0.45, 0.0, 0.5 - 0.003 * i, np.pi, 0, 0, 0.04, -0.04], np.float32)
        action = np.array([0, 0, -0.1, 0, 0, 0, -1], np.float32)
        pictures = {key: np.zeros((128, 128, 3), np.uint8) for key in cameras}
        dataset.add_frame({"observation.state": state, "action": action, "task": task} | pictures)
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDatasetMetadata("local/hand", root=root)


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        ("put the bowl on the plate", "no key poses in the 1 episodes of dataset local/hand"),
        ("...", "its task '...' says nothing"),
    ],
)
def test_a_dataset_in_which_nothing_is_touched_is_refused(tmp_path: Path, task: str, reason: str):
    meta = record_by_hand(tmp_path / "data", task)
    with pytest.raises(DatasetError, match=reason):
        OpenSPMPolicy(new_config(meta), dataset_meta=meta)


@pytest.fixture
def calibration(tiny_dataset: Path, tmp_path: Path) -> Path:
    """The calibration of the dataset, to spoil."""
    return Path(shutil.copy(tiny_dataset / "meta/openspm_cameras.json", tmp_path / "cameras.json"))


def test_a_dataset_without_the_calibrated_camera_is_refused(
    tiny_meta: LeRobotDatasetMetadata, calibration: Path
):
    data = json.loads(calibration.read_text())
    data["cameras"]["observation.images.roof"] = data["cameras"].pop(FRONT)
    calibration.write_text(json.dumps(data))
    config = new_config(tiny_meta)
    config.cameras = str(calibration)
    message = r"cameras\.json: cameras\['observation\.images\.roof'\] has no images.*images\.front"
    with pytest.raises(CalibrationError, match=message):
        OpenSPMPolicy(config, dataset_meta=tiny_meta)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 640, "height": 480}, r"cameras\['observation\.images\.front'\] 'width' and 'height'.*480"),
        ({"T_mount_cam": np.diag([1.0, 1.0, 1.1, 1.0]).tolist()}, "front.*'T_mount_cam' is not a rigid"),
        ({"fx": 0.0}, "front.*focal lengths must be positive"),
    ],
)
def test_a_calibration_that_cannot_be_is_refused_when_it_is_loaded(
    checkpoint: Path, calibration: Path, change: dict, message: str
):
    data = json.loads(calibration.read_text())
    data["cameras"][FRONT] |= change
    calibration.write_text(json.dumps(data))
    config = OpenSPMConfig.from_pretrained(checkpoint)
    config.cameras = str(calibration)
    with pytest.raises(CalibrationError, match=r"/cameras\.json: .*" + message):
        OpenSPMPolicy.from_pretrained(checkpoint, config=config)


def test_the_calibration_of_a_checkpoint_is_its_memorys_or_the_one_that_is_given(
    load: Callable[..., OpenSPMPolicy], checkpoint: Path, calibration: Path
):
    own = load(checkpoint, cameras=None).require_memory().cameras
    data = cameras_to_dict(own)
    data["cameras"][FRONT]["fx"] += 1.0
    calibration.write_text(json.dumps(data))
    given = load(checkpoint, cameras=str(calibration)).require_memory().cameras
    assert given[FRONT].fx == own[FRONT].fx + 1.0


def test_an_object_that_perception_does_not_know_is_refused_when_it_is_loaded(
    checkpoint: Path, tmp_path: Path
):
    shutil.copytree(checkpoint, tmp_path / "changed")
    name = json.loads((checkpoint / "memory.json").read_bytes())["objects"][0]["name"]
    edit_header(tmp_path / "changed", lambda header: header["objects"].pop(0))
    with pytest.raises(MemoryFormatError, match=rf"memory\.json: entries have key poses at '{name}'"):
        OpenSPMPolicy.from_pretrained(tmp_path / "changed")


def test_sam3d_that_nobody_said_where_to_find_is_an_error(
    tiny_meta: LeRobotDatasetMetadata, calibration: Path
):
    config = new_config(tiny_meta)
    config.perception, config.segmenter = "given", SegmenterConfig(labels={"bowl": 1}, shape="sam3d")
    config.cameras = str(calibration)
    with pytest.raises(PerceptionError, match=r"sam3d_python is None.*\.segmenter\.sam3d_python=PYTHON"):
        OpenSPMPolicy(config, dataset_meta=tiny_meta)


def test_weights_that_are_not_there_are_an_error_when_the_policy_is_made(
    tiny_meta: LeRobotDatasetMetadata, calibration: Path, tmp_path: Path
):
    config = new_config(tiny_meta)
    config.perception, config.segmenter.weights = "sam3", [str(tmp_path / "nowhere")]
    config.cameras = str(calibration)
    with pytest.raises(PerceptionError, match="nowhere"):
        OpenSPMPolicy(config, dataset_meta=tiny_meta)
