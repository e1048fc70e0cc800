import json
import logging
from pathlib import Path

import pytest

from lerobot_openspm.cli import pipeline
from lerobot_openspm.cli.pipeline import (
    EVALUATION_SEED,
    Episode,
    digest,
    discard_unless,
    mean_steps,
    rate,
    read_episodes,
    success,
)
from lerobot_openspm.envs.collection import SUMMARY_FILE, CollectConfig
from lerobot_openspm.envs.seeds import DEMO_SEED_START


def line(**changes: object) -> str:
    return json.dumps(
        {"task": "push_plate", "seed": 7, "steps": 80, "success": True, "status": "success", **changes}
    )


def test_rates_come_with_wilsons_interval():
    # The textbook case: 95 of 100 gives 0.888 to 0.978.
    assert rate(0, 0) == {"success": None, "n": 0, "interval": [0.0, 1.0]}
    assert rate(95, 100) == {"success": 0.95, "n": 100, "interval": [0.8882, 0.9785]}


def test_the_log_is_read_by_task_and_seed(tmp_path: Path):
    log = tmp_path / "episodes.jsonl"
    assert read_episodes(log, range(10)) == []
    log.write_text("\n".join([line(success=False, status="time_limit"), line(), line(seed=99)]) + "\n")
    # The same episode run again after an interruption counts once, as it went last.
    assert read_episodes(log, range(10)) == [Episode("push_plate", 7, 80, True, "success")]


def test_mean_steps_are_those_of_successes():
    won, lost = Episode("a", 0, 80, True, "success"), Episode("a", 1, 300, False, "time_limit")
    assert mean_steps([won, lost]) == 80
    assert mean_steps([lost]) is None


def test_a_result_is_kept_only_for_what_it_was_made_of(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    weights, output = tmp_path / "weights", tmp_path / "run" / "eval"
    weights.write_bytes(b"one")
    made_of = digest([weights], ["--policy.execution=open_loop"])
    discard_unless(output, made_of)
    output.mkdir()
    (output / "kept").touch()
    discard_unless(output, made_of)
    assert (output / "kept").exists()
    weights.write_bytes(b"two")
    with caplog.at_level(logging.INFO):
        discard_unless(output, digest([weights], ["--policy.execution=open_loop"]))
    assert not output.exists()
    assert "made of something else" in caplog.text
    assert digest([weights], []) != digest([weights], ["--a"])


def test_what_some_code_made_is_kept_until_that_code_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "package"
    package.mkdir()
    for name in ("__init__", "records", "measures"):
        (package / f"{name}.py").write_text("")
    monkeypatch.setattr(pipeline.lerobot_openspm, "__file__", str(package / "__init__.py"))

    def folder() -> Path:
        discard_unless(tmp_path / "out", digest([], [], ["records.py"]))
        (tmp_path / "out").mkdir(exist_ok=True)
        return tmp_path / "out"

    (folder() / "recording").touch()
    (package / "measures.py").write_text("changed")
    assert [path.name for path in folder().iterdir()] == ["recording"]
    (package / "records.py").write_text("changed")
    assert list(folder().iterdir()) == []


@pytest.fixture
def recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the one file of code that records, in place of the package; recording notes its text."""
    package = tmp_path / "package"
    package.mkdir()
    (package / "records.py").write_text("first")
    monkeypatch.setattr(pipeline.lerobot_openspm, "__file__", str(package / "__init__.py"))
    monkeypatch.setattr(pipeline, "LIBERO_ASSETS", tmp_path / "assets.txt")
    monkeypatch.setattr(pipeline, "RECORDED_BY", dict.fromkeys(pipeline.RECORDED_BY, ("records.py",)))

    def collect(config: CollectConfig) -> None:
        summary = Path(config.root or "") / SUMMARY_FILE
        if not summary.exists():
            summary.parent.mkdir(parents=True)
            summary.write_text((package / "records.py").read_text())

    monkeypatch.setattr(pipeline, "collect", collect)
    return package


def test_demonstrations_are_recorded_anew_when_the_code_that_records_changes(recorder: Path, tmp_path: Path):
    dataset, unfinished = tmp_path / "run/dataset", tmp_path / "run/dataset.partial"
    pipeline.collect_dataset(dataset, 1)
    unfinished.mkdir()
    (dataset / "kept").touch()
    pipeline.collect_dataset(dataset, 1)
    assert (dataset / "kept").exists()
    (recorder / "records.py").write_text("second")
    pipeline.collect_dataset(dataset, 1)
    assert not (dataset / "kept").exists()
    assert not unfinished.exists()
    assert (dataset / SUMMARY_FILE).read_text() == "second"


def test_demonstrations_are_kept_once_it_is_noted_what_recorded_them(recorder: Path, tmp_path: Path):
    dataset = tmp_path / "dataset"
    pipeline.collect_dataset(dataset, 1)
    (dataset / "kept").touch()
    noted = tmp_path / "dataset.sha256"
    noted.write_text(pipeline.recorded_by("openspm_tabletop"))
    pipeline.collect_dataset(dataset, 1)
    assert (dataset / "kept").exists()
    noted.unlink()
    pipeline.collect_dataset(dataset, 1)
    assert not (dataset / "kept").exists()


def test_liberos_assets_count_for_its_demonstrations_alone(recorder: Path, tmp_path: Path):
    before = {simulator: pipeline.recorded_by(simulator) for simulator in pipeline.RECORDED_BY}
    (tmp_path / "assets.txt").write_text("other assets")
    after = {simulator: pipeline.recorded_by(simulator) for simulator in pipeline.RECORDED_BY}
    assert before["openspm_tabletop"] == after["openspm_tabletop"]
    assert before["libero"] != after["libero"]


def test_a_folder_that_was_not_recorded_is_left_to_be_refused(recorder: Path, tmp_path: Path):
    (tmp_path / "dataset/meta").mkdir(parents=True)
    (tmp_path / "dataset/precious.txt").write_text("keep")
    with pytest.raises(FileExistsError):
        pipeline.collect_dataset(tmp_path / "dataset", 1)
    assert (tmp_path / "dataset/precious.txt").exists()


def test_success_is_told_for_all_and_for_each_task():
    episodes = [
        Episode("a", 1, 10, True, "done"),
        Episode("a", 2, 30, False, "lost"),
        Episode("b", 1, 20, True, "done"),
    ]
    told = success(episodes)
    assert (told["success"], told["n"], told["mean_steps"]) == (2 / 3, 3, 15.0)
    assert told["per_task"] == {"a": 0.5, "b": 1.0}
    assert told["failed"] == [["a", 2, "lost"]]
    assert success(episodes[1:2])["mean_steps"] is None


def test_the_demo_is_evaluated_on_evaluation_seeds():
    assert 0 <= EVALUATION_SEED < EVALUATION_SEED + 499 < DEMO_SEED_START
