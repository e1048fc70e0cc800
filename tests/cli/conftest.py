"""`openspm` as a command line, called in this process."""

import sys
from collections.abc import Callable

import pytest

from lerobot_openspm.cli.main import main

Openspm = Callable[..., tuple[int, str, str]]


@pytest.fixture
def openspm(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Openspm:
    """Run a command line in this process; returns exit code, stdout and stderr."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["openspm", *arguments])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
            if isinstance(stop.code, str):
                print(stop.code, file=sys.stderr)
        out, err = capsys.readouterr()
        return code, out, err

    return run
