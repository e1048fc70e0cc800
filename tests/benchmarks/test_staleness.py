"""Quoted figures are found, and what has changed since they were measured."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from subprocess import CalledProcessError
from types import SimpleNamespace
from typing import Any

import pytest
from benchmarks.figures import FIGURES, PACKAGE, Figure
from benchmarks.results import PROVENANCE, write
from benchmarks.stages import EnvironmentOption
from benchmarks.staleness import ROOT, Quote, origin, quotes, read_result

from benchmarks import calibration, figures, results, tables
from lerobot_openspm.errors import OpenSPMError

CODE = '"""Moves."""\n\n\ndef speed():\n    """How fast."""\n    return 1  # m/s\n'


class Checkout:
    """A repository with one measured result."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.git("init", "-q")
        self.commit("src/move.py", CODE)
        self.measure()

    def git(self, *arguments: str) -> str:
        identity = ("-c", "user.name=t", "-c", "user.email=t@example.org")
        done = subprocess.run(
            ["git", *identity, *arguments], cwd=self.root, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    def commit(self, name: str, text: str) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        self.git("add", ".")
        self.git("commit", "-qm", f"Change {name}")

    def measure(self, name: str = "speed", **changed: object) -> None:
        told = {
            "commit": self.git("rev-parse", "--short=12", "HEAD"),
            "dirty": False,
            "command": "python -m src.move",
            "success": 0.5,
        }
        self.commit(f"benchmarks/results/{name}.json", json.dumps(told | changed))

    def origin(self):
        return origin("speed", ["src", "configs"], self.root)


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_a_result_is_current_until_what_it_measures_changes(checkout: Checkout):
    assert checkout.origin().problem is None
    checkout.commit("docs/page.md", "words")
    assert checkout.origin().problem is None
    checkout.commit("src/move.py", CODE.replace("return 1", "return 2"))
    (change,) = checkout.origin().changes
    assert change.endswith("Change src/move.py")
    assert checkout.origin().problem == "stale by 1 changes"


def test_a_result_of_other_options_is_not_the_published_one(checkout: Checkout):
    expected = "python -m src.move --n=50 --k=2"
    for options, is_published in (("--k=2 --n=50", True), ("--n=5", False), ("", False)):
        checkout.measure(command=f"python -m src.move {options}")
        problem = origin("speed", ["src", "configs"], checkout.root, expected).problem
        assert (problem is None) is is_published, problem


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("src/move.py", CODE.replace("How fast", "How quickly").replace("  # m/s", "  # metres per second")),
        ("src/README.md", "words"),
    ],
)
def test_words_make_nothing_stale(checkout: Checkout, name: str, text: str):
    checkout.commit(name, text)
    assert checkout.origin().problem is None


@pytest.mark.parametrize("name", ["src/move.py", "src/other.py"])
def test_code_that_is_not_committed_makes_stale(checkout: Checkout, name: str):
    (checkout.root / name).write_text(CODE.replace("return 1", "return 2"))
    assert checkout.origin().changes == (f"not in a commit of its own: {name}",)


def test_a_merge_that_kept_the_other_code_makes_stale(checkout: Checkout):
    checkout.git("checkout", "-qb", "side")
    checkout.commit("src/move.py", CODE.replace("return 1", "return 2"))
    checkout.measure()
    checkout.git("checkout", "-q", "-")
    checkout.commit("docs/page.md", "words")
    checkout.git("merge", "-q", "--no-ff", "--no-commit", "side")
    checkout.commit("src/move.py", CODE)
    # No commit since changed the code.
    assert checkout.origin().changes == ("not in a commit of its own: src/move.py",)


def test_a_shallow_clone_says_that_it_is(checkout: Checkout, tmp_path: Path):
    shallow = tmp_path / "shallow"
    checkout.commit("docs/page.md", "words")
    checkout.git("clone", "-q", "--depth=1", f"file://{checkout.root}", str(shallow))
    missing = origin("speed", ["src"], shallow).missing
    assert "this clone is shallow, run: git fetch --unshallow" in str(missing)
    assert "shallow" not in str(origin("speed", ["src"], checkout.root).missing)


def test_a_change_that_was_taken_back_makes_nothing_stale(checkout: Checkout):
    checkout.commit("src/move.py", CODE.replace("return 1", "return 2"))
    checkout.commit("src/move.py", CODE)
    assert checkout.origin().problem is None


def test_comments_of_a_configuration_are_words_and_its_values_are_not(checkout: Checkout):
    checkout.commit("configs/train.yaml", "steps: 3\n")
    checkout.measure()
    checkout.commit("configs/train.yaml", "# few\nsteps: 3\n")
    assert checkout.origin().problem is None
    checkout.commit("configs/train.yaml", "steps: 4\n")
    # Both commits touch what has changed.
    assert checkout.origin().problem == "stale by 2 changes"


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"dirty": True}, "changes that were not committed"),
        ({"command": None}, "its command is gone"),
        ({"command": "python -m src.gone"}, "its command is gone: python -m src.gone"),
        ({"command": "openspm bench speed"}, "its command is gone"),
        ({"commit": "0123456789ab"}, "0123456789ab is not in this history"),
    ],
)
def test_what_cannot_be_taken_again_says_why(checkout: Checkout, changed: dict[str, Any], reason: str):
    checkout.measure(**changed)
    assert reason in str(checkout.origin().missing)


def test_a_missing_result_and_one_that_nobody_can_take(checkout: Checkout):
    assert origin("other", ["src"], checkout.root).missing == "no result file"
    assert "names no command" in str(origin("speed", None, checkout.root).missing)


def test_quotes_are_found_where_they_stand(tmp_path: Path):
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("fast:\n1 m/s <!-- figure: speed.mean --> <!-- figure: speed.n -->\n")
    (tmp_path / "docs/a.md").write_text("<!-- figure: reach.max -->")
    found = [(quote.page, quote.line, quote.name, quote.key) for quote in quotes(tmp_path)]
    assert found == [
        ("README.md", 2, "speed", "mean"), ("README.md", 2, "speed", "n"), ("docs/a.md", 1, "reach", "max")
    ]  # fmt: skip


def report(root: Path, *options: str) -> tuple[dict[str, int], int]:
    """What the script counts in a checkout, and its exit code."""
    script = "scripts/stale_figures.py"
    done = subprocess.run(
        [sys.executable, script, *options], cwd=root, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
    )  # fmt: skip
    assert done.stdout, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.returncode


def test_the_report_counts_what_the_pages_quote(checkout: Checkout):
    checkout.commit("scripts/stale_figures.py", (ROOT / "scripts/stale_figures.py").read_text())
    code = f"{PACKAGE}/memory/stored_entries.py"
    checkout.commit(code, CODE)
    checkout.commit("benchmarks/memory.py", CODE)
    assert report(checkout.root, "--check") == ({"quoted": 0, "stale": 0, "unreproducible": 0}, 0)
    checkout.commit("README.md", "<!-- figure: memory.n -->")
    checkout.measure("memory", command=FIGURES["memory"].command, n=3)
    assert report(checkout.root, "--check") == ({"quoted": 1, "stale": 0, "unreproducible": 0}, 0)
    checkout.commit("docs/a.md", "<!-- figure: memory.gone --> <!-- figure: language.n -->")
    assert report(checkout.root, "--check") == ({"quoted": 3, "stale": 0, "unreproducible": 2}, 1)
    checkout.commit("docs/a.md", "")
    checkout.commit(code, CODE.replace("return 1", "return 2"))
    assert report(checkout.root, "--check") == ({"quoted": 1, "stale": 1, "unreproducible": 0}, 1)
    assert report(checkout.root)[1] == 0


def complaints(name: str, result: dict[str, Any]) -> list[str]:
    """What a published result does not say of where it comes from."""
    machine = {"cpu", "cores", "threads", "python", "packages"}
    # No path of the machine it was measured on.
    command = result.get("command") or "/"
    return [
        what
        for what, is_wrong in (
            ("provenance", not set(PROVENANCE) <= set(result)),
            ("machine", set(result.get("machine", ())) != machine),
            ("command", re.search(r"(^|[ =])/", command) is not None),
            ("name", name not in FIGURES),
        )
        if is_wrong
    ]


def test_published_results_say_where_they_come_from():
    for path in (ROOT / "benchmarks/results").glob("*.json"):
        assert complaints(path.stem, json.loads(path.read_text())) == [], path


@pytest.mark.parametrize(
    ("name", "changed", "found"),
    [
        ("memory", {}, []),
        ("speed", {}, ["name"]),
        ("memory", {"command": "python -m benchmarks.memory --output=/home/me"}, ["command"]),
        ("memory", {"command": None}, ["command"]),
        ("memory", {"machine": {"cpu": "Some CPU"}}, ["machine"]),
    ],
)
def test_a_result_that_does_not_say_where_it_comes_from_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, changed: dict[str, Any], found: list[str]
):
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    monkeypatch.setattr(results, "is_published", lambda *_: True)
    written = write("memory", {"seed": None, "n": 3})
    assert complaints(name, {**written, "command": FIGURES["memory"].command, **changed}) == found
    del written["date"]
    assert "provenance" in complaints(name, {**written, **changed})


def test_the_code_that_figures_measure_exists():
    for path in {path for figure in FIGURES.values() for path in figure.paths}:
        named = path.replace("exclude,", "").replace(":(exclude)", "")
        assert git_files(named), f"nothing is called {path}"


def git_files(*paths: str) -> list[str]:
    """The committed files that git's names stand for."""
    listed = subprocess.run(
        ["git", "ls-files", "--", *paths], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return listed.stdout.splitlines()


def test_every_room_is_measured_by_some_figure():
    rooms = {path.parent.name for path in (ROOT / PACKAGE).glob("*/__init__.py")}
    assert unmeasured(rooms, FIGURES.values()) == set()
    without = [figure for name, figure in FIGURES.items() if "calibration" not in name]
    assert unmeasured(rooms, without) == {"calibration"}
    excluding = Figure("", (f"{PACKAGE}/flow", f":(exclude){PACKAGE}/flow"))
    assert unmeasured({"flow"}, [excluding]) == {"flow"}


def unmeasured(rooms: set[str], among: Iterable[Figure]) -> set[str]:
    """Folders of the package of which no figure's paths hold any code."""
    measured = {
        Path(name).relative_to(PACKAGE).parts[0]
        for figure in among
        for name in git_files(*figure.paths)
        if name.startswith(f"{PACKAGE}/") and not name.endswith("__init__.py")
    }
    return rooms - measured


def test_every_quoted_figure_is_in_its_result(checkout: Checkout):
    assert not_in_their_results(ROOT) == []
    checkout.commit("README.md", "<!-- figure: speed.success --> <!-- figure: speed.gone -->")
    assert [quote.key for quote in not_in_their_results(checkout.root)] == ["gone"]


def not_in_their_results(root: Path) -> list[Quote]:
    return [quote for quote in quotes(root) if quote.key not in (read_result(quote.name, root) or {})]


@pytest.fixture
def taking(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The programs that taking figures starts, of which tracking's fails; nothing is written."""
    started: list[str] = []

    def run(command: list[str], check: bool) -> None:
        started.append(" ".join([Path(command[0]).name, *command[1:]]))
        if check and "tracking" in started[-1]:
            raise CalledProcessError(1, command)

    monkeypatch.setattr(figures.subprocess, "run", run)
    monkeypatch.setattr(tables, "write_pages", lambda: None)
    monkeypatch.setattr(figures, "code_version", lambda: ("0123456789ab", False))
    problems: dict[str, str | None] = {
        "oracle": None, "tracking": "no result file", "execution": "stale by 2 changes",
    }  # fmt: skip
    monkeypatch.setattr(figures, "origin", lambda name, _, **__: SimpleNamespace(problem=problems[name]))
    return started


def test_what_is_current_is_not_taken_again_and_one_failure_does_not_stop_the_rest(taking: list[str]):
    told = figures.main(["tracking", "oracle", "execution"])
    commands = [FIGURES[name].command for name in ("tracking", "execution")]
    assert taking == commands
    assert told == {"tracking": "no result file", "oracle": "current", "execution": "stale by 2 changes"}


def test_no_figure_is_taken_of_changes_that_are_not_committed(
    taking: list[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(figures, "code_version", lambda: ("0123456789ab", True))
    with pytest.raises(OpenSPMError, match="commit the changes"):
        figures.main(["tracking"])
    assert taking == []


@pytest.mark.parametrize("installed", [True, False])
def test_without_names_all_figures_are_taken_and_those_left_out_are_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, installed: bool
):
    monkeypatch.setattr(figures, "find_spec", lambda name: name if installed else None)
    names = figures.takeable()
    assert {"calibration", "tabletop"} <= set(names)
    left_out = sorted(set(FIGURES) - set(names))
    assert ("calibration_libero" in left_out) is not installed
    assert left_out == sorted(name for name in FIGURES if "libero" in name and not installed)
    assert all(name in caplog.text for name in left_out)
    assert ("make libero-setup" in caplog.text) is not installed


@pytest.mark.parametrize("simulator", ["openspm_tabletop", "libero"])
def test_cameras_are_estimated_of_one_simulator_at_a_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, simulator: str
):
    recorded = []
    monkeypatch.setattr(EnvironmentOption, "dataset", lambda env: recorded.append(env.type))
    monkeypatch.setattr(calibration, "read", lambda *_: SimpleNamespace(cameras={}))
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    monkeypatch.setattr(results, "is_published", lambda *_: True)
    config = calibration.CalibrationConfig()
    config.env.type = simulator
    calibration.main(config)
    assert recorded == [simulator]
    (name,) = [path.stem for path in tmp_path.iterdir()]
    assert FIGURES[name].command.endswith("--env.type=libero") is (simulator == "libero")
