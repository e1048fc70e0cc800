"""What `openspm demo` and the tabletop's comparisons keep as figures; their stages are stood in for."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import common, tabletop
from lerobot_openspm.bench import results
from lerobot_openspm.bench.results import PROVENANCE
from lerobot_openspm.cli import demo
from lerobot_openspm.cli.pipeline import THREADS, Episode

EPISODES = [Episode("a", 1000, 100, True, "done"), Episode("b", 1000, 300, False, "no_progress")]


@pytest.fixture(autouse=True)
def stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "_threads", lambda: 7)

    def collect(root: Path, demos: int) -> dict[str, Any]:
        root.mkdir(parents=True, exist_ok=True)
        return {"frames": 200, "episodes": 2}

    for module in (demo, tabletop, common):
        monkeypatch.setattr(module, "collect_dataset", collect)
    for module in (demo, common):
        monkeypatch.setattr(module, "train", lambda *_: (Path("checkpoint"), float("nan")))
    for module in (demo, tabletop):
        monkeypatch.setattr(module, "evaluate", lambda *_, **__: EPISODES)
    monkeypatch.setattr(demo, "write_report", lambda *_: Path("report/index.html"))


def test_the_demo_keeps_its_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    options = [f"--output={tmp_path / 'demo'}", f"--result={tmp_path / 'tabletop.json'}", "--demos=4"]
    demo.main(options)
    kept = json.loads((tmp_path / "tabletop.json").read_text())
    assert set(PROVENANCE) <= set(kept)
    assert (kept["success"], kept["n"], kept["seed"], kept["demonstrations"]) == (0.5, 2, 1000, 4)
    assert kept["per_task"] == {"a": 1.0, "b": 0.0}
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["success"] == 0.5
    assert kept["machine"]["threads"] == THREADS
    # How long a training took that was resumed is not known; the whole took as long as it took.
    assert kept["train_s"] is None
    assert kept["total_s"] >= 0


def test_the_time_of_a_demo_that_kept_stages_is_not_told(tmp_path: Path):
    (tmp_path / "demo/demos_10").mkdir(parents=True)
    demo.main([f"--output={tmp_path / 'demo'}", f"--result={tmp_path / 'tabletop.json'}"])
    assert json.loads((tmp_path / "tabletop.json").read_text())["total_s"] is None


@pytest.mark.parametrize(
    ("name", "runs", "seed"),
    [
        ("execution", ["closed_loop_trc", "closed_loop", "open_loop"], 1000),
        ("oracle", ["oracle"], 1000),
        ("conditioning", ["equivariant", "paper"], 1000),
        ("two_bowls", ["two_bowls"], 11_000),
    ],
)
def test_a_comparison_keeps_all_its_runs(
    name: str, runs: list[str], seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    tabletop.main(name)
    kept = json.loads((tmp_path / f"{name}.json").read_text())
    assert set(PROVENANCE) <= set(kept)
    assert list(kept["runs"]) == runs
    assert (kept["n"], kept["seed"]) == (2, seed)
    assert kept["machine"]["threads"] == THREADS
    assert kept["runs"][runs[0]]["failed"] == [["b", 1000, "no_progress"]]
