"""The trained policy in this process, and observations recorded for it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from tests.policy.lerobot_commands import CALIBRATION

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.modeling_openspm import OpenSPMPolicy

NAME = "local/openspm_tabletop"
STEPS = 8

Frame = dict[str, Any]


@pytest.fixture(autouse=True)
def one_thread():
    """Several workers share the cores, and threads that wait for one another cost more than they save."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def load(checkpoint: Path) -> Callable[..., OpenSPMPolicy]:
    """Load the trained policy, with options as the command line would give them."""

    def load(path: Path = checkpoint, dataset_meta: Any = None, **options: Any) -> OpenSPMPolicy:
        config = OpenSPMConfig.from_pretrained(path)
        for name, value in {"cameras": str(CALIBRATION), **options}.items():
            setattr(config, name, value)
        return OpenSPMPolicy.from_pretrained(path, config=config, dataset_meta=dataset_meta)

    return load


@pytest.fixture
def policy(load: Callable[..., OpenSPMPolicy]) -> OpenSPMPolicy:
    """The trained policy, fresh from its checkpoint."""
    return load()


@pytest.fixture(scope="session")
def tiny_meta(tiny_dataset: Path) -> LeRobotDatasetMetadata:
    """Metadata of the dataset that the checkpoint was trained on."""
    return LeRobotDatasetMetadata(NAME, root=tiny_dataset)


@pytest.fixture(scope="session")
def recorded(tiny_dataset: Path, tiny_meta: LeRobotDatasetMetadata) -> list[list[Frame]]:
    """The first observations of every episode of the tiny dataset, and the instruction with each."""
    dataset = LeRobotDataset(NAME, root=tiny_dataset, video_backend="pyav")
    wanted = ("observation.", "task")
    starts = tiny_meta.episodes["dataset_from_index"]
    episodes = [[dataset[int(start) + i] for i in range(STEPS)] for start in starts]
    return [
        [{k: v for k, v in f.items() if k.startswith(wanted) and k != "task_index"} for f in e]
        for e in episodes
    ]


def batch_of(frames: list[Frame]) -> dict[str, Any]:
    """Observations of several environments as lerobot-eval hands them over."""
    return {
        key: torch.stack([f[key] for f in frames]) if key != "task" else [f[key] for f in frames]
        for key in frames[0]
    }


def act(policy: OpenSPMPolicy, episodes: list[list[Frame]]) -> torch.Tensor:
    """Actions ``(t, b, 7)`` on recorded observations, from a reset on."""
    policy.reset()
    with torch.inference_mode():
        return torch.stack([policy.select_action(batch_of(list(f))) for f in zip(*episodes, strict=True)])
