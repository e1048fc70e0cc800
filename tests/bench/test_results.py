"""A result is written beside what it was measured on."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_openspm.bench import results
from lerobot_openspm.bench.results import PROVENANCE, code_version, command_line, machine, write_result
from lerobot_openspm.errors import OpenSPMError


def test_a_result_says_what_it_was_measured_on(tmp_path: Path):
    path = tmp_path / "deeper" / "speed.json"
    content = write_result(path, {"seed": 5, "n": 3, "median_ms": 1.5})
    assert json.loads(path.read_text()) == content
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
def test_a_result_without_its_number_or_with_a_made_up_origin_is_refused(tmp_path, measured, message):
    with pytest.raises(OpenSPMError, match=message):
        write_result(tmp_path / "speed.json", measured)
    assert not (tmp_path / "speed.json").exists()


@pytest.mark.parametrize(
    ("started", "arguments", "expected"),
    [
        (
            ["/usr/bin/python3", "-m", "benchmarks.libero.few_shot", "--demos=3"],
            ["/home/me/openspm/benchmarks/libero/few_shot.py", "--demos=3"],
            "python -m benchmarks.libero.few_shot --demos=3",
        ),
        (
            ["/venv/bin/python", "/venv/bin/openspm", "bench", "language", "-m", "two words"],
            ["/venv/bin/openspm", "bench", "language", "-m", "two words"],
            "openspm bench language -m 'two words'",
        ),
    ],
)
def test_the_command_is_told_as_it_was_typed(started, arguments, expected):
    assert command_line(started, arguments) == expected


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with one commit, from which the package seems to be run."""
    package = tmp_path / "src" / "lerobot_openspm"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    monkeypatch.setattr(results.lerobot_openspm, "__file__", str(package / "__init__.py"))
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
    # Installed in somebody else's repository, the package is not part of it.
    assert code_version() == (None, None)
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
