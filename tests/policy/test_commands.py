"""LeRobot's command lines with this policy, as a user types them."""

import json
import shutil
from pathlib import Path

import pytest
from tests.memory.memory_files import names
from tests.policy.lerobot_commands import call_lerobot, pretrained, train_arguments, training_options

from lerobot_openspm.memory.io import read_memory

BOWL, STOVE = "put the bowl on the plate", "turn on the stove"
PUSH = "push the plate to the front of the stove"


def sources(checkpoint: Path) -> list[tuple[str, str]]:
    """Instruction and dataset of every entry of a checkpoint's memory."""
    return [(e.language, e.source) for e in read_memory(checkpoint).entries]


def train(*options: str) -> None:
    """Run lerobot-train in this process."""
    call_lerobot("lerobot-train", *train_arguments(*options))


def evaluate(checkpoint: Path, output: Path, *options: str) -> tuple[dict, list[dict]]:
    """Run lerobot-eval for two short episodes; returns its summary and the environment's log."""
    log = output / "episodes.jsonl"
    output.mkdir()
    call_lerobot(
        "lerobot-eval", f"--policy.path={checkpoint}", "--policy.device=cpu", "--env.type=openspm_tabletop",
        "--env.task=turn_on_stove", "--env.observation_height=128", "--env.observation_width=128",
        "--env.episode_length=30", f"--env.episode_log={log}", "--eval.n_episodes=2", "--eval.batch_size=2",
        f"--output_dir={output / 'eval'}", *options,
    )  # fmt: skip
    summary = json.loads((output / "eval/eval_info.json").read_text())
    return summary, [json.loads(line) for line in log.read_text().splitlines()]


def test_training_leaves_a_whole_checkpoint(checkpoint: Path):
    found = {path.name for path in checkpoint.iterdir()}
    assert found >= {
        "config.json", "model.safetensors", *names(checkpoint),
        "policy_preprocessor.json", "policy_postprocessor.json", "train_config.json",
    }  # fmt: skip
    assert not [name for name in found if name.startswith(".") or name.endswith((".pkl", ".bin", ".pt"))]
    assert sorted(sources(checkpoint)) == [(BOWL, f"local/openspm_tabletop#{i}") for i in (0, 1, 2)] + [
        (STOVE, f"local/openspm_tabletop#{i}") for i in (3, 4, 5)
    ]


# Asynchronous environments are processes of their own, which take long to start.
@pytest.mark.parametrize("asynchronous", ["false", pytest.param("true", marks=pytest.mark.slow)])
def test_evaluation_writes_its_results_and_the_episode_log(
    checkpoint: Path, tmp_path: Path, asynchronous: str
):
    summary, episodes = evaluate(checkpoint, tmp_path / "run", f"--eval.use_async_envs={asynchronous}")
    assert summary["overall"]["n_episodes"] == 2
    assert [set(episode) for episode in episodes] == [{"task", "seed", "steps", "success", "status"}] * 2
    assert {episode["task"] for episode in episodes} == {"turn_on_stove"}
    assert len({episode["seed"] for episode in episodes}) == 2
    assert all(episode["steps"] <= 30 for episode in episodes)


def test_resuming_goes_on_with_the_same_memory(training_run: Path, tmp_path: Path):
    output = tmp_path / "run"
    shutil.copytree(training_run, output, symlinks=True)
    before = {name: (pretrained(output) / name).read_bytes() for name in names(pretrained(output))}
    steps = json.loads((pretrained(output) / "train_config.json").read_text())["steps"] + 10
    train(
        f"--config_path={pretrained(output) / 'train_config.json'}", "--resume=true", f"--steps={steps}",
        f"--save_freq={steps}", f"--output_dir={output}",
    )  # fmt: skip
    assert (output / "checkpoints/last").resolve().name == f"{steps:06d}"
    assert {name: (pretrained(output) / name).read_bytes() for name in before} == before


def test_fine_tuning_appends_another_dataset(checkpoint: Path, other_dataset: Path, tmp_path: Path):
    output = tmp_path / "run"
    train(
        *training_options(other_dataset, output, 10), f"--policy.path={checkpoint}",
        "--policy.memory_update=append", "--dataset.repo_id=local/other", "--policy.push_to_hub=false",
    )  # fmt: skip
    assert sorted(sources(pretrained(output))) == sorted(
        [*sources(checkpoint), (PUSH, "local/other#0"), (PUSH, "local/other#1")]
    )


@pytest.mark.slow
def test_the_oracle_ablation_trains_and_evaluates(tiny_dataset: Path, tmp_path: Path):
    output = tmp_path / "run"
    train(*training_options(tiny_dataset, output, 10), "--policy.perception=oracle")
    assert read_memory(pretrained(output)).perception == "oracle"
    summary, _ = evaluate(pretrained(output), tmp_path / "eval", "--env.object_poses=true")
    assert summary["overall"]["n_episodes"] == 2
