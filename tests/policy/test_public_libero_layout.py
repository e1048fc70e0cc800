"""A dataset in the layout of the public LIBERO dataset is learned from as any other is.

Two cameras called image and image2, motors called roll, pitch and yaw that are an axis-angle, two grippers,
images instead of videos, and a card that says 10 frames per second.
"""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from tests.policy.conftest import NAME
from tests.policy.lerobot_commands import CALIBRATION

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.training import dataset_processor, memory_of, open_demonstrations, training_set

PUBLIC = "local/public_layout"
CAMERAS = {
    "observation.images.front": "observation.images.image",
    "observation.images.wrist": "observation.images.image2",
}
MOTORS = ["x", "y", "z", "roll", "pitch", "yaw"]
EPISODES = [0, 1]


def features(size: int) -> dict[str, Any]:
    image = {"dtype": "image", "shape": (size, size, 3), "names": ["height", "width", "channel"]}
    return {
        **dict.fromkeys(CAMERAS.values(), image),
        "observation.state": {
            "dtype": "float32", "shape": (8,), "names": {"motors": [*MOTORS, "gripper", "gripper"]},
        },
        "action": {"dtype": "float32", "shape": (7,), "names": {"motors": [*MOTORS, "gripper"]}},
    }  # fmt: skip


def copy_in_public_layout(tiny_dataset: Path, root: Path) -> None:
    source = LeRobotDataset(NAME, root=tiny_dataset, episodes=EPISODES, video_backend="pyav")
    public = LeRobotDataset.create(
        PUBLIC, fps=10, features=features(128), root=root, robot_type="panda", use_videos=False
    )
    last = source[0]["episode_index"]
    for i in range(len(source)):
        frame = source[i]
        if frame["episode_index"] != last:
            public.save_episode()
            last = frame["episode_index"]
        pictures = {
            ours: np.asarray((frame[key] * 255).round().to(torch.uint8).permute(1, 2, 0))
            for key, ours in CAMERAS.items()
        }
        vectors = {key: frame[key].numpy() for key in ("observation.state", "action")}
        public.add_frame({**pictures, **vectors, "task": frame["task"]})
    public.save_episode()
    public.finalize()


@pytest.fixture(scope="session")
def public_meta(make_once, tiny_dataset: Path) -> LeRobotDatasetMetadata:
    root = make_once("public_layout", lambda folder: copy_in_public_layout(tiny_dataset, folder))
    return LeRobotDatasetMetadata(PUBLIC, root=root)


@pytest.fixture(scope="session")
def calibrations(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The two cameras under their own names and under the public dataset's."""
    document, folder = json.loads(CALIBRATION.read_text()), tmp_path_factory.mktemp("cameras")
    named = {"own": {key: key for key in CAMERAS}, "public": CAMERAS}
    for name, keys in named.items():
        cameras = {new: document["cameras"][key] for key, new in keys.items()}
        (folder / f"{name}.json").write_text(json.dumps({**document, "cameras": cameras}))
    return {name: folder / f"{name}.json" for name in named}


def config(calibration: Path, **changes: Any) -> OpenSPMConfig:
    return OpenSPMConfig(device="cpu", push_to_hub=False, cameras=str(calibration), **changes)


PUBLIC_ROTATION = {"rotation": "axis_angle"}


def told(entry: MemoryEntry) -> list[tuple[Any, ...]]:
    return [(pose.phase, pose.anchor, pose.closed, pose.n_steps) for pose in entry.key_poses]


def test_the_same_key_poses_are_mined_whatever_names_and_rate_the_card_gives(
    public_meta, tiny_meta, calibrations
):
    ours, theirs = (
        config(calibrations["own"], memory_episodes=EPISODES),
        config(calibrations["public"], **PUBLIC_ROTATION),
    )
    own = memory_of(dataset_processor(tiny_meta, ours).mine(), ours)
    mined = dataset_processor(public_meta, theirs).mine()
    found = memory_of(mined, theirs)
    assert len(found.entries) == len(own.entries) == len(EPISODES)
    for entry, same in zip(own.entries, found.entries, strict=True):
        assert told(entry) == told(same)
        np.testing.assert_allclose(
            [pose.T_obj_ee for pose in entry.key_poses],
            [pose.T_obj_ee for pose in same.key_poses],
            atol=1e-6,
        )
    conditions, chunks = training_set(mined, found.robot, theirs).draw(torch.arange(9), 1, training=False)
    assert torch.isfinite(conditions).all()
    assert torch.isfinite(chunks).all()


def test_its_names_alone_would_be_euler_angles(public_meta, calibrations):
    read = {}
    for kind, options in (("named", {}), ("meant", PUBLIC_ROTATION)):
        demonstrations = open_demonstrations(public_meta, config(calibrations["public"], **options))
        read[kind] = demonstrations.episodes([0])[0].T_world_ee
    assert not np.allclose(read["named"], read["meant"], atol=1e-3)


@pytest.mark.parametrize(("rate", "warned"), [(20.0, True), (10.0, False), (None, False)])
def test_a_card_with_another_rate_than_the_robots_is_explained(
    public_meta, calibrations, caplog, rate, warned
):
    chosen = config(calibrations["public"], control_hz=rate, memory_episodes=[0], **PUBLIC_ROTATION)
    with caplog.at_level(logging.WARNING):
        dataset_processor(public_meta, chosen).key_poses()
    told_of_it = [r.getMessage() for r in caplog.records if "frames per second" in r.getMessage()]
    assert len(told_of_it) == warned
    assert all("10 frames per second" in text and "counts steps" in text for text in told_of_it)


def test_a_rate_must_be_positive():
    with pytest.raises(ValueError, match="control_hz"):
        OpenSPMConfig(control_hz=0.0)
