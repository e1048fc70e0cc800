"""Policies are trained on a dataset that says what was mined of it: this one, and any other."""

from pathlib import Path

import pytest
from lerobot.datasets import LeRobotDatasetMetadata
from tests.memory.memory_files import names
from tests.policy.conftest import NAME
from tests.policy.lerobot_commands import (
    call_lerobot,
    pretrained,
    run_command,
    train_arguments,
    training_options,
)
from tests.policy.test_learning import new_config

from lerobot_openspm.mining import processor
from lerobot_openspm.modeling_openspm import OpenSPMPolicy


def test_training_on_it_reads_the_key_poses_and_remembers_the_same(
    annotated_dataset: Path, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delattr(processor, "find_key_poses")
    meta = LeRobotDatasetMetadata(NAME, root=annotated_dataset)
    policy = OpenSPMPolicy(new_config(meta), dataset_meta=meta)
    policy.save_pretrained(tmp_path / "again")
    for name in names(checkpoint):
        assert (tmp_path / "again" / name).read_bytes() == (checkpoint / name).read_bytes(), name


@pytest.mark.slow
def test_lerobot_train_on_it_leaves_the_same_memory(
    annotated_dataset: Path, checkpoint: Path, tmp_path: Path
):
    options = training_options(annotated_dataset, tmp_path / "run", 10)
    call_lerobot("lerobot-train", *train_arguments(*options))
    for name in names(checkpoint):
        assert (pretrained(tmp_path / "run") / name).read_bytes() == (checkpoint / name).read_bytes(), name


@pytest.mark.slow
def test_another_policy_trains_on_it(annotated_dataset: Path, tmp_path: Path):
    done = run_command(
        "lerobot-train", "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--policy.pretrained_backbone_weights=null", "--policy.chunk_size=10", "--policy.n_action_steps=10",
        "--policy.dim_model=64", "--policy.dim_feedforward=64", "--policy.n_encoder_layers=1",
        f"--dataset.repo_id={NAME}", f"--dataset.root={annotated_dataset}", "--dataset.video_backend=pyav",
        "--batch_size=2", "--steps=2", "--save_freq=2", "--num_workers=0", "--wandb.enable=false",
        f"--output_dir={tmp_path / 'act'}",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-4000:]
    assert (tmp_path / "act/checkpoints/last/pretrained_model/model.safetensors").is_file()
