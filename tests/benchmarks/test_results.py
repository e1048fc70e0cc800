"""A result is written beside what it was measured on."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.figures import FIGURES
from benchmarks.results import PROVENANCE, code_version, command_line, machine, run, write

from benchmarks import results
from lerobot_openspm.errors import OpenSPMError


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where results go."""
    monkeypatch.setattr(results, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(results, "is_published", lambda *_: True)
    return tmp_path / "results"


def test_a_result_says_what_it_was_measured_on(folder: Path):
    content = write("speed", {"seed": 5, "n": 3, "median_ms": 1.5})
    assert json.loads((folder / "speed.json").read_text()) == content
    assert list(content) == [*PROVENANCE, "median_ms"]
    assert (content["seed"], content["n"], content["median_ms"]) == (5, 3, 1.5)
    assert set(content["machine"]) == {"cpu", "cores", "threads", "python", "packages"}
    assert content["machine"]["packages"]["numpy"] == np.__version__
    head = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True
    )
    assert head.stdout.startswith(content["commit"])


@pytest.mark.parametrize(
    ("measured", "message"),
    [({"n": 3}, r"missing \['seed'\]"), ({"seed": 0, "n": 3, "commit": "x"}, r"already given \['commit'\]")],
)
def test_a_result_without_its_number_or_with_a_made_up_origin_is_refused(folder, measured, message):
    with pytest.raises(OpenSPMError, match=message):
        write("speed", measured)
    assert not folder.exists()


def test_what_was_taken_with_other_options_does_not_replace_the_published_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(results, "RESULTS", tmp_path / "published")
    monkeypatch.setattr(results, "TRIALS", tmp_path / "trials")
    typed = FIGURES["tracking"].command.split()[3:]
    for options, folder in ((typed, "published"), ([*typed, "--episodes=2"], "trials")):
        words = ["benchmarks/tracking.py", *options]
        monkeypatch.setattr(sys, "argv", words)
        monkeypatch.setattr(sys, "orig_argv", ["python", "-m", "benchmarks.tracking", *options])
        write("tracking", {"seed": 0, "n": 1})
        assert (tmp_path / folder / "tracking.json").is_file()
        (tmp_path / folder / "tracking.json").unlink()
    assert list(tmp_path.rglob("*.json")) == []


@dataclass
class Options:
    """Options of a measure."""

    entries: int = 3

    def __post_init__(self) -> None:
        if self.entries < 1:
            raise ValueError("entries must be at least 1")


def test_a_benchmark_prints_its_result_last_and_tells_a_mistake_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "argv", ["counting.py", "--entries=5"])
    run(Options, lambda options: {"n": 2, "entries": options.entries})
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {"n": 2, "entries": 5}
    monkeypatch.setattr(sys, "argv", ["counting.py", "--entries=0"])
    with pytest.raises(SystemExit, match="counting: entries must be at least 1"):
        run(Options, dict)


@pytest.mark.parametrize(
    ("started", "arguments", "expected"),
    [
        (
            ["/usr/bin/python3", "-m", "benchmarks.libero.few_shot", "--demos=3"],
            ["/home/me/openspm/benchmarks/libero/few_shot.py", "--demos=3"],
            "python -m benchmarks.libero.few_shot --demos=3",
        ),
        (
            ["/venv/bin/python", "/venv/bin/openspm", "demo", "-m", "two words"],
            ["/venv/bin/openspm", "demo", "-m", "two words"],
            "openspm demo -m 'two words'",
        ),
    ],
)
def test_the_command_is_told_as_it_was_typed(started, arguments, expected):
    assert command_line(started, arguments) == expected


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder from which the benchmarks seem to be run."""
    (tmp_path / "src/lerobot_openspm").mkdir(parents=True)
    (tmp_path / "src/lerobot_openspm/__init__.py").write_text("")
    monkeypatch.setattr(results, "ROOT", tmp_path)
    return tmp_path


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=t", "-c", "user.email=t@example.org")
    done = subprocess.run(
        ["git", *identity, *arguments], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_changes_of_code_are_told_and_of_results_are_not(checkout: Path):
    assert code_version() == (None, None)
    git(checkout, "init", "-q")
    git(checkout, "add", ".")
    git(checkout, "commit", "-qm", "first")
    commit = git(checkout, "rev-parse", "--short=12", "HEAD")
    assert code_version() == (commit, False)
    (checkout / "benchmarks/results").mkdir(parents=True)
    (checkout / "benchmarks/results/speed.json").write_text("{}")
    (checkout / "README.md").write_text("faster")
    assert code_version() == (commit, False)
    for name in ("src/lerobot_openspm/new.py", "scripts/libero_assets.txt", "Makefile", "pyproject.toml"):
        (checkout / name).parent.mkdir(exist_ok=True)
        (checkout / name).write_text("")
        assert code_version() == (commit, True), name
        (checkout / name).unlink()


def test_the_threads_are_those_of_this_process(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(get_num_threads=lambda: 3))  # pyright: ignore
    assert machine()["threads"] == 3
    # Those of the processes that it started, if they measured.
    assert machine(1)["threads"] == 1
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    assert machine()["threads"] == 5
    assert machine()["python"] == ".".join(map(str, sys.version_info[:3]))
