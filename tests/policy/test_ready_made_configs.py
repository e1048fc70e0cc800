"""The files in configs/ are read by LeRobot's own command lines."""

import sys
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_openspm.configuration_openspm import OpenSPMConfig, SegmenterConfig

CONFIGS = Path(__file__).parents[2] / "configs"


def read(monkeypatch: pytest.MonkeyPatch, kind: type, name: str, *options: str) -> Any:
    """The configuration that a LeRobot command makes of a file and options."""
    monkeypatch.setattr(sys, "argv", ["lerobot", f"--config_path={CONFIGS / name}", *options])

    def command(cfg: Any) -> Any:
        return cfg

    command.__annotations__["cfg"] = kind
    return parser.wrap()(command)()


@pytest.mark.parametrize("robot", ["tabletop", "libero"])
def test_training(robot: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    name = f"openspm_{robot}_train.yaml"
    nested = "--policy.judge.type=annotations"
    config = read(monkeypatch, TrainPipelineConfig, name, f"--output_dir={tmp_path}/run", nested)
    assert isinstance(config.policy, OpenSPMConfig)
    assert config.policy.judge.type == "annotations"
    assert config.policy.push_to_hub is False
    assert (CONFIGS.parent / str(config.policy.cameras)).is_file()
    assert config.policy.control_hz == (20 if robot == "libero" else None)


def test_evaluation(monkeypatch: pytest.MonkeyPatch, checkpoint: Path):
    options = ("--policy.perception=given", '--policy.segmenter.labels={"bowl": 3}')
    path = f"--policy.path={checkpoint}"
    config = read(monkeypatch, EvalPipelineConfig, "openspm_libero_eval.yaml", path, *options)
    assert (config.env.type, config.env.task) == ("libero", "libero_goal")
    assert (config.eval.n_episodes, config.eval.batch_size, config.seed) == (50, 1, 1000)
    assert isinstance(config.policy, OpenSPMConfig)
    assert config.policy.segmenter == SegmenterConfig(labels={"bowl": 3})
