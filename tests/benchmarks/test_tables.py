"""The page of results says what the committed JSON files say, and what has not been measured."""

import json
from pathlib import Path

import pytest
from benchmarks.libero import tables as libero_tables

from benchmarks import markdown, memory_tables, perception_tables, tables

MACHINE = {"commit": "0123456789ab", "machine": {"cores": 2, "processor": "x86_64"}}
RATE = {"success": 0.5, "n": 4, "interval": [0.15, 0.85], "mean_steps": 100.0}


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of results."""
    for module in (markdown, libero_tables):
        monkeypatch.setattr(module, "RESULTS", tmp_path)
    return tmp_path


def put(folder: Path, name: str, **content) -> None:
    (folder / f"{name}.json").write_text(json.dumps({**MACHINE, **content}))


def put_main_result(folder: Path, **content) -> None:
    put(folder, "libero_goal", **RATE, demonstrations=10, mine_and_train_s=200, note="", **content)


def page(monkeypatch: pytest.MonkeyPatch, folder: Path) -> str:
    monkeypatch.setattr(tables, "PAGE", folder / "page.md")
    tables.write_page()
    return (folder / "page.md").read_text()


def test_the_committed_page_is_made_of_the_committed_results(tmp_path, monkeypatch):
    committed = tables.PAGE.read_text()
    assert page(monkeypatch, tmp_path) == committed, "run: python -m benchmarks.tables"


def test_what_is_not_measured_says_so_and_how_to_measure_it(results, monkeypatch):
    text = page(monkeypatch, results)
    parts = [
        *libero_tables.libero_parts(), *perception_tables.perception_parts(), *memory_tables.memory_parts()
    ]  # fmt: skip
    assert text.count("Not measured") == 6 + len(parts) - 3  # but for the introductions
    assert "`execution.json` is missing; run `python -m benchmarks.figures`" in text
    assert "`libero_goal.json` is missing; run `python -m benchmarks.libero.run`" in text


def test_failures_are_told_apart_by_rule(results, monkeypatch):
    failed = [
        {"task": task, "state": state, "reason": "gave up at lift", "attempts": 2, "off_mm": off}
        for task, state, off in (
            ("push_the_plate", 1, 1.0),
            ("put_the_bowl", 2, 2.0),
            ("put_the_bowl", 3, 30.0),
            ("push_the_plate", 4, None),
        )
    ]
    put_main_result(results, per_task={"put_the_bowl": RATE}, failed=failed)
    text = page(monkeypatch, results)
    for category, n in (("perception", 2), ("small tolerances", 1), ("geometric constraints", 1)):
        assert f"| {category} | {n} |" in text
    assert "2 of 4 failed episodes failed in acting" in text
    assert "put the bowl, state 3: gave up at lift" in text


def test_the_curve_of_few_demonstrations_ends_with_the_main_result(results, monkeypatch):
    for n in (3, 1):
        put(results, f"libero_few_shot_{n}", **RATE, demonstrations=n, mine_and_train_s=9)
    put_main_result(results, per_task={}, failed=[])
    rows = [line for line in page(monkeypatch, results).splitlines() if "| 9 |" in line or "| 200 |" in line]
    assert [row.split("|")[1].strip() for row in rows] == ["1", "3", "10"]
