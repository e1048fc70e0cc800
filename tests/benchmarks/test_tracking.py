"""Disturbed episodes, on the tests' small checkpoint."""

import json
from pathlib import Path

import pytest
from benchmarks.tracking import TrackingConfig, jobs_of, main

from benchmarks import results
from lerobot_openspm.errors import OpenSPMError


def config(checkpoint: Path, output: Path, task: str, **options: int) -> TrackingConfig:
    """The options of a short measurement."""
    made = TrackingConfig(output=str(output), **options)
    made.policy.path, made.env.task = str(checkpoint), task
    return made


def test_mistakes_are_told():
    with pytest.raises(ValueError, match="figure is 'weather', expected one of tracking, cameras"):
        TrackingConfig(figure="weather")
    with pytest.raises(ValueError, match="episodes and workers must be at least 1"):
        TrackingConfig(episodes=0)


def test_a_checkpoint_that_is_not_there_is_told(tmp_path: Path):
    with pytest.raises(
        FileNotFoundError, match=r"no checkpoint of this policy at .*nowhere: .* pass --policy.path=FOLDER"
    ):
        config(tmp_path / "nowhere", tmp_path, "all").checkpoint()


def test_a_task_in_which_nothing_can_be_dropped_is_refused(tmp_path: Path):
    with pytest.raises(OpenSPMError, match="nothing can be displaced there, expected some of bowl_on_plate"):
        jobs_of(config(tmp_path, tmp_path, "turn_on_stove"))


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_tracking_is_measured_and_goes_on_where_it_was(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int
):
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    monkeypatch.setattr(results, "is_published", lambda *_: True)
    options = config(
        checkpoint, tmp_path / "out", "bowl_on_plate", episodes=1, seed=2_000_008, workers=workers
    )
    result = main(options)
    successes = {f"success_{name}" for name in result["conditions"]}
    assert successes <= set(result)
    assert list(result["conditions"]) == ["displaced", "dropped", "displaced_untracked", "dropped_untracked"]
    assert result["n"] == 1
    log = tmp_path / "out" / "episodes.jsonl"
    lines = log.read_text().splitlines()
    assert len(lines) == 4
    assert all(json.loads(line)["disturbed_at"] is not None for line in lines)
    log.write_text("\n".join(lines[:3]) + '\n{"torn')
    assert main(options)["conditions"] == result["conditions"]
