"""From demonstrations to success with nothing but the defaults: the pipeline that a user runs."""

import json
from pathlib import Path

import pytest
from tests.policy.lerobot_commands import REPOSITORY

from lerobot_openspm.cli import pipeline
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.collection import CollectConfig, SimulatorConfig, collect
from lerobot_openspm.envs.seeds import TUNING_SEED_START

# Something carried, and something turned. Nobody is tuned on these seeds.
TASKS = ("bowl_on_plate", "turn_on_stove")
EPISODES, SEED = 4, TUNING_SEED_START + 801_000


@pytest.mark.slow
def test_the_default_perception_and_a_trained_flow_model_solve_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Recorded, mined and trained as `openspm demo` does it, and run by lerobot-eval from pixels alone."""
    monkeypatch.chdir(REPOSITORY)
    root = tmp_path / "dataset"
    collect(
        CollectConfig(
            SimulatorConfig(task=",".join(TASKS)), episodes=5, root=str(root), repo_id=pipeline.REPO_ID
        )
    )
    checkpoint, _ = pipeline.train(root, tmp_path / "train")
    config = OpenSPMConfig.from_pretrained(checkpoint)
    defaults = OpenSPMConfig()
    assert (config.perception, config.segmenter.shape) == ("demonstrations",) * 2
    assert (config.execution, config.tracking) == (defaults.execution, defaults.tracking)
    training = json.loads((checkpoint / "train_config.json").read_text())
    assert training["steps"] == 3000
    episodes = pipeline.evaluate(checkpoint, tmp_path / "evaluation", EPISODES, SEED, tasks=TASKS)
    failed = [(episode.task, episode.seed, episode.status) for episode in episodes if not episode.success]
    # Of eight episodes that succeed in 98 of 100 cases, three fail once in 2,500 times.
    assert len(failed) <= 2, failed
    for task in TASKS:
        assert any(episode.success for episode in episodes if episode.task == task), failed
