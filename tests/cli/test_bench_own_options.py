"""A measure that is a module with options of its own."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from lerobot_openspm.bench.results import PROVENANCE, ResultOption
from lerobot_openspm.cli import bench


@dataclass
class Options(ResultOption):
    """Options of a measure."""

    entries: int = 3


@pytest.fixture
def _counting(monkeypatch: pytest.MonkeyPatch) -> None:
    module = SimpleNamespace(Options=Options, measure=lambda options: {"n": 2, "entries": options.entries})
    monkeypatch.setitem(sys.modules, "some_measure", module)  # pyright: ignore[reportArgumentType]
    monkeypatch.setitem(bench.ON_THEIR_OWN, "counting", "some_measure")


@pytest.mark.usefixtures("_counting")
def test_a_measure_has_its_own_options(capsys: pytest.CaptureFixture[str]):
    bench.main(["counting", "--entries=5"])
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {"n": 2, "entries": 5}
    with pytest.raises(SystemExit):
        bench.main(["counting", "--episodes=5"])


@pytest.mark.usefixtures("_counting")
def test_what_is_printed_can_be_kept_with_its_origin(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "counting.json"
    bench.main(["counting", f"--result={path}"])
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    kept = json.loads(path.read_text())
    assert {key: kept[key] for key in printed} == printed
    # Nothing is drawn in it, so it has no seed.
    assert kept["seed"] is None
    assert set(PROVENANCE) <= set(kept)
