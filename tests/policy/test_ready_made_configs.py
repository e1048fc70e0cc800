"""The files in configs/ are read by LeRobot's own command lines."""

import sys
from pathlib import Path

import pytest
from lerobot.configs import parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_openspm.configuration_openspm import OpenSPMConfig

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.mark.parametrize("robot", ["tabletop", "libero"])
def test_training(robot: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    given = [f"--config_path={CONFIGS}/openspm_{robot}_train.yaml", f"--output_dir={tmp_path}/run"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *given])

    @parser.wrap()
    def read(cfg: TrainPipelineConfig) -> TrainPipelineConfig:
        return cfg

    config = read()
    assert isinstance(config.policy, OpenSPMConfig)
    assert config.policy.push_to_hub is False
    assert (CONFIGS.parent / str(config.policy.cameras)).is_file()
    assert config.policy.control_hz == (20 if robot == "libero" else None)


def test_evaluation(monkeypatch: pytest.MonkeyPatch, checkpoint: Path):
    given = [f"--config_path={CONFIGS}/openspm_libero_eval.yaml", f"--policy.path={checkpoint}"]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *given])

    @parser.wrap()
    def read(cfg: EvalPipelineConfig) -> EvalPipelineConfig:
        return cfg

    config = read()
    assert (config.env.type, config.env.task) == ("libero", "libero_goal")
    assert (config.eval.n_episodes, config.eval.batch_size, config.seed) == (50, 1, 1000)
    assert isinstance(config.policy, OpenSPMConfig)
