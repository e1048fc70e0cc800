"""A measure that is a module with options of its own."""

import json
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from lerobot_openspm.cli import bench


@dataclass
class Options:
    """Options of a measure."""

    entries: int = 3


def test_a_measure_has_its_own_options(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    module = SimpleNamespace(Options=Options, measure=lambda options: {"entries": options.entries})
    monkeypatch.setitem(sys.modules, "some_measure", module)  # pyright: ignore[reportArgumentType]
    monkeypatch.setitem(bench.ON_THEIR_OWN, "counting", "some_measure")
    bench.main(["counting", "--entries=5"])
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {"entries": 5}
    with pytest.raises(SystemExit):
        bench.main(["counting", "--episodes=5"])
