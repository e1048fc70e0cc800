"""Poses along episodes against the simulator's, on the tests' small checkpoint."""

from pathlib import Path

import pytest
from benchmarks.perception import PerceptionConfig, main

from benchmarks import results
from lerobot_openspm.errors import DatasetError


@pytest.mark.slow
def test_perception_is_measured(
    checkpoint: Path, tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    monkeypatch.setattr(results, "is_published", lambda *_: True)
    config = PerceptionConfig(episodes=1, seed=2_000_000, workers=1, output=str(tmp_path / "out"))
    config.policy.path, config.dataset.root = str(checkpoint), str(tiny_dataset)
    config.env.task = "turn_on_stove"
    result = main(config)
    assert 0 < result["position_mm_mean"] <= result["position_mm_p95"] < 30
    assert 0 <= result["orientation_deg_mean"] < 10
    assert 0 < result["filter_us"] < 5000
    assert 0 < result["ms_per_observation"] < 5000
    assert result["n"] == result["variants"]["filtered"]["poses"] > 20
    assert list(result["objects"]) == ["stove"]
    assert (tmp_path / "perception_tabletop.json").is_file()
    config.dataset.root = str(tmp_path / "nothing")
    with pytest.raises(DatasetError, match=r"no dataset in .*nothing"):
        main(config)
