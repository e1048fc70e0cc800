"""scripts/find_python.sh on machines whose PATH promises more than it keeps."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "find_python.sh"
BASE = Path(sys._base_executable).resolve()  # type: ignore[attr-defined]


def find(
    home: Path, *folders: Path, python: str = "", pyenv: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the script with nothing on PATH but `folders` and the shell's own tools."""
    tools = home / "tools"
    tools.mkdir(exist_ok=True)
    for tool in ("bash", "env", "cat", "head"):
        if not (tools / tool).exists():
            (tools / tool).symlink_to(
                next(p for p in (Path("/bin", tool), Path("/usr/bin", tool)) if p.exists())
            )
    env = {"PATH": os.pathsep.join(map(str, [*folders, tools])), "HOME": str(home), "PYTHON": python}
    env |= {"PYENV_ROOT": str(pyenv)} if pyenv else {}
    return subprocess.run([SCRIPT], env=env, capture_output=True, text=True, check=False)


def program(path: Path, body: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    """A folder as pyenv makes it: the names are there, running them fails."""
    for name in ("python3.12", "python3.13"):
        program(tmp_path / "shims" / name, f'echo "pyenv: {name}: command not found" >&2; exit 127')
    return tmp_path / "shims"


def test_a_shim_that_fails_is_passed_over(tmp_path: Path, broken: Path):
    program(tmp_path / "later" / "python3", f'exec "{BASE}" "$@"')
    done = find(tmp_path, broken, tmp_path / "later")
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).resolve() == BASE


def test_an_older_python_is_passed_over(tmp_path: Path):
    program(tmp_path / "old" / "python3.12", "exit 3")
    program(tmp_path / "later" / "python", f'exec "{BASE}" "$@"')
    done = find(tmp_path, tmp_path / "old", tmp_path / "later")
    assert Path(done.stdout.strip()).resolve() == BASE


def test_pyenv_versions_are_found_behind_their_shims(tmp_path: Path, broken: Path):
    program(tmp_path / ".pyenv/versions/3.12.9/bin/python3.12", f'exec "{BASE}" "$@"')
    done = find(tmp_path, broken)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).resolve() == BASE


def test_pyenv_may_be_installed_elsewhere(tmp_path: Path, broken: Path):
    program(tmp_path / "tools/pyenv/versions/3.13.1/bin/python3.13", f'exec "{BASE}" "$@"')
    assert find(tmp_path, broken).returncode == 1
    done = find(tmp_path, broken, pyenv=tmp_path / "tools/pyenv")
    assert Path(done.stdout.strip()).resolve() == BASE


def test_uv_is_asked_first(tmp_path: Path, broken: Path):
    program(tmp_path / "uv" / "uv", f'test "$1 $2" = "python find" && echo "{BASE}"')
    done = find(tmp_path, tmp_path / "uv", broken)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).resolve() == BASE


def test_the_named_python_is_taken(tmp_path: Path, broken: Path):
    named = program(tmp_path / "mine" / "my-python", f'exec "{BASE}" "$@"')
    done = find(tmp_path, broken, python=str(named))
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).resolve() == BASE


def test_no_other_is_tried_when_the_named_one_fails(tmp_path: Path, broken: Path):
    program(tmp_path / "good" / "python3", f'exec "{BASE}" "$@"')
    done = find(tmp_path, tmp_path / "good", python=str(broken / "python3.12"))
    assert done.returncode == 1
    assert done.stdout == ""
    assert f"PYTHON={broken / 'python3.12'} cannot be used" in done.stderr
    assert "Python 3.12 or 3.13" in done.stderr


def test_nothing_that_works_says_what_to_install(tmp_path: Path, broken: Path):
    done = find(tmp_path, broken)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("No working Python 3.12 or 3.13")
    for way in ("uv python install 3.12", "apt-get install", "pyenv install 3.12", "make setup PYTHON="):
        assert way in done.stderr
