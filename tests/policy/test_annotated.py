"""Policies are trained on a dataset that says what was mined of it: this one, and any other."""

from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.datasets import LeRobotDatasetMetadata
from tests.memory.memory_files import names
from tests.policy.conftest import NAME
from tests.policy.lerobot_commands import run_command
from tests.policy.test_learning import new_config

from lerobot_openspm.mining import processor
from lerobot_openspm.mining.annotate import write_annotated
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.training import dataset_processor


@pytest.fixture(scope="module")
def annotated(make_once: Callable[..., Path], tiny_dataset: Path) -> Path:
    """The tiny dataset with the columns that mining gives it."""

    def annotate(root: Path) -> None:
        meta = LeRobotDatasetMetadata(NAME, root=tiny_dataset)
        mining = dataset_processor(meta, new_config(meta))
        write_annotated(mining.demonstrations, mining.key_poses(), root)

    return make_once("annotated_for_training", annotate)


def test_training_on_it_reads_the_key_poses_and_remembers_the_same(
    annotated: Path, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delattr(processor, "find_key_poses")
    meta = LeRobotDatasetMetadata(NAME, root=annotated)
    policy = OpenSPMPolicy(new_config(meta), dataset_meta=meta)
    policy.save_pretrained(tmp_path / "again")
    for name in names(checkpoint):
        assert (tmp_path / "again" / name).read_bytes() == (checkpoint / name).read_bytes(), name


@pytest.mark.slow
def test_another_policy_trains_on_it(annotated: Path, tmp_path: Path):
    done = run_command(
        "lerobot-train", "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--policy.pretrained_backbone_weights=null", "--policy.chunk_size=10", "--policy.n_action_steps=10",
        "--policy.dim_model=64", "--policy.dim_feedforward=64", "--policy.n_encoder_layers=1",
        f"--dataset.repo_id={NAME}", f"--dataset.root={annotated}", "--dataset.video_backend=pyav",
        "--batch_size=2", "--steps=2", "--save_freq=2", "--num_workers=0", "--wandb.enable=false",
        f"--output_dir={tmp_path / 'act'}",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-4000:]
    assert (tmp_path / "act/checkpoints/last/pretrained_model/model.safetensors").is_file()
