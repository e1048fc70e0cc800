"""Teaching on the tabletop, on the tests' small dataset."""

import json
from pathlib import Path

import pytest
from benchmarks.stages import EnvironmentOption
from benchmarks.teach import TeachConfig, main

from benchmarks import results, teach
from lerobot_openspm.errors import DatasetError
from lerobot_openspm.memory.memory import read_memory


def config(root: Path, output: Path, task: str = "all") -> TeachConfig:
    made = TeachConfig(EnvironmentOption(task=task), 1, 2_000_000, 1)
    made.dataset.root, made.output = str(root), str(output)
    return made


def test_mistakes_are_told():
    with pytest.raises(ValueError, match="episodes and workers must be at least 1, got 0"):
        TeachConfig(episodes=0)
    with pytest.raises(ValueError, match="unknown openspm_tabletop task juggle"):
        EnvironmentOption(task="juggle")


def test_too_few_demonstrations_are_refused(tiny_dataset: Path, tmp_path: Path):
    with pytest.raises(DatasetError, match="holds 0 demonstrations of bowl_on_stove, expected at least 3"):
        main(config(tiny_dataset, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_teaching_is_measured_and_goes_on_where_it_was(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    monkeypatch.setattr(results, "is_published", lambda *_: True)
    monkeypatch.setattr(teach, "OPTIONS", ("--steps=20",))
    output = tmp_path / "out"
    options = config(tiny_dataset, output, "turn_on_stove")
    result = main(options)
    assert list(result["demonstrations"]) == ["1", "3"]
    assert result["n"] == 1
    assert 0 < result["teach_s"] < 60
    # The policy that is taught has never seen the task. In its first demonstration no stove is found, because
    # the images are small, so one is not enough; three are.
    nine = output / "without_turn_on_stove/checkpoints/last/pretrained_model"
    memory = read_memory(nine)
    assert {entry.language for entry in memory.entries} == {"put the bowl on the plate"}
    assert set(memory.objects) == {"bowl", "plate"}
    taught = [read_memory(output / f"taught_turn_on_stove_{n}").entries for n in (1, 3)]
    assert [len(entries) for entries in taught] == [3, 6]
    failed, learned = result["lessons"]
    assert "the objects they belong to were found in none" in failed["error"]
    assert (learned["error"], learned["objects_learned"]) == (None, ["stove"])
    weights = [folder / "model.safetensors" for folder in (nine, output / "taught_turn_on_stove_1")]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    log = output / "episodes.jsonl"
    lines = log.read_text().splitlines()
    assert [json.loads(line)["demonstrations"] for line in lines] == [1, 3]
    before = weights[0].stat().st_mtime_ns
    log.write_text(f'{lines[0]}\n{{"torn')
    again = main(options)
    assert (again["demonstrations"], again["lessons"]) == (result["demonstrations"], result["lessons"])
    assert weights[0].stat().st_mtime_ns == before
