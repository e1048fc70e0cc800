"""Fixtures for every test. What is recorded and trained is made once per run."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from filelock import FileLock
from tests import properties  # noqa: F401 - loads Hypothesis' profile
from tests.hub.loopback_hub import LoopbackHub
from tests.policy.lerobot_commands import pretrained, run_command, train_arguments, training_options

from lerobot_openspm.envs.gl_backend import set_default_gl_backend

set_default_gl_backend()  # before any test imports mujoco


@pytest.fixture
def loopback_hub() -> Iterator[LoopbackHub]:
    """An empty Hub on 127.0.0.1; what talks to it runs in a subprocess with `loopback_hub.env(tmp_path)`."""
    with LoopbackHub().running() as hub:
        yield hub


@pytest.fixture(scope="session")
def make_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Make a folder once for all workers of a run; the others wait. Nobody may change what lies in it."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def make(name: str, maker: Callable[[Path], object]) -> Path:
        folder, done = base / name, base / f"{name}.done"
        with FileLock(base / f"{name}.lock"):
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                maker(folder)
                done.touch()
        return folder

    return make


def record(root: Path, task: str, episodes: int) -> None:
    """Record demonstrations in small images."""
    from lerobot_openspm.envs.collection import CollectConfig, SimulatorConfig, collect

    env = SimulatorConfig(task=task)
    collect(CollectConfig(env, episodes, str(root), height=128, width=128, workers=0))


@pytest.fixture(scope="session")
def tiny_dataset(make_once: Callable[..., Path]) -> Path:
    """Three demonstrations each of bowl_on_plate (episodes 0 to 2) and turn_on_stove (3 to 5), 128 px."""
    return make_once("tiny_dataset", lambda root: record(root, "bowl_on_plate,turn_on_stove", 3))


@pytest.fixture(scope="session")
def annotated_dataset(make_once: Callable[..., Path], tiny_dataset: Path) -> Path:
    """The tiny dataset with the columns and sub-tasks that mining gives it."""

    def annotate(root: Path) -> None:
        from lerobot.datasets import LeRobotDatasetMetadata

        from lerobot_openspm.configuration_openspm import OpenSPMConfig
        from lerobot_openspm.mining.annotate import write_annotated
        from lerobot_openspm.training import dataset_processor

        meta = LeRobotDatasetMetadata("local/openspm_tabletop", root=tiny_dataset)
        processor = dataset_processor(meta, OpenSPMConfig(device="cpu", push_to_hub=False))
        write_annotated(processor.demonstrations, processor.key_poses(), root)

    return make_once("mined_and_annotated", annotate)


@pytest.fixture(scope="session")
def other_dataset(make_once: Callable[..., Path]) -> Path:
    """Two demonstrations of push_plate, whose object the tiny dataset shows too."""
    return make_once("other_dataset", lambda root: record(root, "push_plate", 2))


@pytest.fixture(scope="session")
def training_run(make_once: Callable[..., Path], tiny_dataset: Path) -> Path:
    """Output folder of lerobot-train on the tiny dataset. Copy it to go on training."""

    def train(output: Path) -> None:
        done = run_command("lerobot-train", *train_arguments(*training_options(tiny_dataset, output)))
        assert done.returncode == 0, done.stderr[-4000:]

    return make_once("training_run", train)


@pytest.fixture(scope="session")
def checkpoint(training_run: Path) -> Path:
    """A trained policy's checkpoint folder. Copy it to change it."""
    return pretrained(training_run)
