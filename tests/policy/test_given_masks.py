"""From demonstrations to success on the tabletop with masks from a segmenter instead of learned colours."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.envs.utils import preprocess_observation
from tests.memory.memory_files import edit_header
from tests.policy.conftest import NAME
from tests.policy.lerobot_commands import CALIBRATION

from lerobot_openspm.configuration_openspm import OpenSPMConfig, SegmenterConfig
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.env import TabletopEnv
from lerobot_openspm.errors import MemoryFormatError, PerceptionError
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.signals import Episode
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.objects.box.model import BoxModel
from lerobot_openspm.types import View

LABELS = {noun: scene.OBJECT_LABELS[noun] for noun in ("bowl", "plate", "stove")}
TUNING_SEED = 2_100_000


@pytest.fixture(scope="module")
def start_labels(tiny_dataset: Path) -> list[dict[str, np.ndarray]]:
    """The true masks of every demonstration's first frame, by camera, from the initial state of its seed."""
    document = json.loads((tiny_dataset / "meta/openspm_collect.json").read_text())
    env = TabletopEnv(masks=True, observation_height=128, observation_width=128)
    found = []
    for episode in document["episodes"]:
        observation, _ = env.reset(seed=episode["seed"])
        found.append({name: observation[f"masks.{name}"][0] for name in scene.CAMERA_NAMES})
    env.close()
    return found


@pytest.fixture(scope="module")
def masked_demonstrations(start_labels: list[dict[str, np.ndarray]]) -> Iterator[None]:
    """The dataset as if its first frames had been recorded with masks."""
    read = Demonstrations.views

    def views(
        self: Demonstrations, episode: Episode, frame: int, cameras: dict[str, Camera]
    ) -> dict[str, View]:
        labels = start_labels[episode.index]
        return {
            key: replace(view, labels=labels[key.rpartition(".")[2]])
            for key, view in read(self, episode, frame, cameras).items()
        }

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Demonstrations, "views", views)
        yield


def given_masks(checkpoint: Path) -> OpenSPMConfig:
    config = PreTrainedConfig.from_pretrained(checkpoint)
    assert isinstance(config, OpenSPMConfig)
    config.perception, config.segmenter = "given", SegmenterConfig(labels=LABELS, shape="box")
    config.cameras, config.memory_update = str(CALIBRATION), "rebuild"
    return config


@pytest.fixture(scope="module")
def mined(
    checkpoint: Path,
    tiny_dataset: Path,
    masked_demonstrations: None,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A checkpoint with the trained flow model and a memory mined anew from masks."""
    folder = tmp_path_factory.mktemp("given")
    config, meta = given_masks(checkpoint), LeRobotDatasetMetadata(NAME, root=tiny_dataset)
    old = relabelled(checkpoint, folder / "old")
    OpenSPMPolicy.from_pretrained(old, config=config, dataset_meta=meta).save_pretrained(folder / "mined")
    return folder / "mined"


@pytest.fixture
def policy(mined: Path) -> OpenSPMPolicy:
    return OpenSPMPolicy.from_pretrained(mined, config=PreTrainedConfig.from_pretrained(mined))


def relabelled(checkpoint: Path, copy: Path) -> Path:
    """A copy of a checkpoint whose memory says that it was made from masks, so that it may be rebuilt."""
    copy.mkdir()
    for path in checkpoint.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    edit_header(copy, lambda header: header.update(segmentation="given", shape="box"))
    return copy


def succeeds(policy: OpenSPMPolicy, task: str, seed: int) -> bool:
    env = TabletopEnv(task, masks=True, observation_height=128, observation_width=128)
    observation, info = env.reset(seed=seed)
    policy.reset()
    while info["status"] == "running":
        one = {key: value[None] for key, value in observation.items() if key != "pixels"}
        one["pixels"] = {key: image[None] for key, image in observation["pixels"].items()}
        batch = preprocess_observation(one) | {"task": [env.task_description]}
        with torch.inference_mode():
            observation, _, _, _, info = env.step(policy.select_action(batch)[0].numpy())
    env.close()
    return bool(info["is_success"])


def test_given_masks_are_learned_as_boxes(policy: OpenSPMPolicy):
    memory = policy.memory
    assert memory is not None
    assert (memory.segmentation, memory.shape) == ("given", "box")
    assert {name: type(model) for name, model in memory.objects.items()} == dict.fromkeys(LABELS, BoxModel)
    assert len(memory.entries) == 6


@pytest.mark.slow
def test_the_tabletop_is_solved_with_given_masks(policy: OpenSPMPolicy):
    assert sum(succeeds(policy, "bowl_on_plate", TUNING_SEED + i) for i in range(3)) >= 2


def test_without_masks_in_the_observation_the_option_is_named(policy: OpenSPMPolicy):
    env = TabletopEnv("bowl_on_plate", observation_height=128, observation_width=128)
    observation, _ = env.reset(seed=TUNING_SEED)
    env.close()
    one = {"pixels": {key: image[None] for key, image in observation["pixels"].items()}}
    batch = preprocess_observation(one | {"agent_pos": observation["agent_pos"][None]})
    with pytest.raises(PerceptionError, match=r"observation\.masks\.front.*--env\.masks=true"):
        policy.select_action(batch | {"task": [env.task_description]})


def test_a_memory_of_masks_is_not_read_as_one_of_colours(mined: Path):
    config = PreTrainedConfig.from_pretrained(mined)
    assert isinstance(config, OpenSPMConfig)
    assert read_memory(mined).segmentation == "given"
    config.perception, config.segmenter = "demonstrations", SegmenterConfig()
    with pytest.raises(MemoryFormatError, match=r"perception=given, got --policy\.perception=demonstrations"):
        OpenSPMPolicy.from_pretrained(mined, config=config)
    config.perception, config.segmenter = "given", SegmenterConfig(labels=LABELS)
    with pytest.raises(MemoryFormatError, match=r"shape=box, got --policy\.segmenter\.shape=demonstr"):
        OpenSPMPolicy.from_pretrained(mined, config=config)


def test_a_phrase_without_a_label_is_named(
    checkpoint: Path, tiny_dataset: Path, masked_demonstrations: None, tmp_path: Path
):
    config, meta = given_masks(checkpoint), LeRobotDatasetMetadata(NAME, root=tiny_dataset)
    config.segmenter.labels = {"bowl": 1}
    with pytest.raises(PerceptionError, match="no label is given for 'plate'"):
        OpenSPMPolicy.from_pretrained(
            relabelled(checkpoint, tmp_path / "old"), config=config, dataset_meta=meta
        )
