"""Whether a result is still what the code does: what it was measured on, and what has changed since."""

from __future__ import annotations

import ast
import functools
import json
import re
import shlex
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from benchmarks.results import ROOT

# A quoted figure is marked where it stands: the result's name and the key in it.
MARK = re.compile(r"<!-- figure: (\w+)\.(\w+) -->")


@dataclass(frozen=True)
class Quote:
    """A figure that a page quotes: where it stands, the result's name, the key in it."""

    page: str
    line: int
    name: str
    key: str


@dataclass(frozen=True)
class Origin:
    """What is known of where a result comes from.

    Attributes:
        commit: What it was measured on, if known.
        missing: Why it cannot be taken again as it is, or None.
        changes: What has changed since in what it measures, by commits where these are known.
    """

    commit: str | None
    missing: str | None
    changes: tuple[str, ...] = ()

    @property
    def problem(self) -> str | None:
        """Why it is not current, or None."""
        return self.missing or (f"stale by {len(self.changes)} changes" if self.changes else None)


def quotes(root: Path = ROOT) -> list[Quote]:
    """Every figure that README and the docs quote."""
    pages = [path for path in (root / "README.md", *sorted((root / "docs").glob("*.md"))) if path.is_file()]
    return [
        Quote(str(page.relative_to(root)), number, *found.groups())
        for page in pages
        for number, line in enumerate(page.read_text().splitlines(), 1)
        for found in MARK.finditer(line)
    ]


def read_result(name: str, root: Path = ROOT) -> dict[str, Any] | None:
    """A result file's content; None if there is none."""
    path = root / "benchmarks/results" / f"{name}.json"
    return json.loads(path.read_text()) if path.is_file() else None


def origin(
    name: str, paths: Sequence[str] | None, root: Path = ROOT, expected_command: str | None = None
) -> Origin:
    """Where a result comes from, and whether what it measures has changed.

    Args:
        name: The result's name.
        paths: Git's names (pathspecs) of the code that it measures; None if nobody knows how to take it.
        root: The checkout.
        expected_command: The command line that takes the published figure; None if any will do.
    """
    result = read_result(name, root)
    if result is None:
        return Origin(None, "no result file")
    commit, command = result.get("commit"), result.get("command")
    if paths is None:
        return Origin(commit, "benchmarks/figures.py names no command that takes it")
    if not command or not _is_there(command, root):
        return Origin(commit, f"its command is gone: {command}")
    if expected_command is not None and _options(command) != _options(expected_command):
        return Origin(commit, f"taken with other options: {command}, expected {expected_command}")
    if not commit or not _git(root, "merge-base", commit, "HEAD").startswith(commit):
        is_shallow = _git(root, "rev-parse", "--is-shallow-repository").strip() == "true"
        way_out = "; this clone is shallow, run: git fetch --unshallow" if is_shallow else ""
        return Origin(commit, f"its commit {commit} is not in this history{way_out}")
    if result.get("dirty") is not False:
        return Origin(commit, "measured with changes that were not committed")
    return Origin(commit, None, tuple(changes(commit, paths, root)))


def _options(command: str) -> set[str]:
    """The words of a command line; their order changes no figure."""
    return set(shlex.split(command))


def _is_there(command: str, root: Path) -> bool:
    """Whether the module of a command line still exists."""
    match shlex.split(command):
        case ["python", "-m", module, *_]:
            return (root / f"{module.replace('.', '/')}.py").is_file()
        case _:
            return False


def changes(commit: str, paths: Sequence[str], root: Path = ROOT) -> Iterator[str]:
    """What has changed since in files whose code is another now; comments and docstrings are no code."""
    names = [
        *_git(root, "diff", "--name-only", "--no-renames", commit, "--", *paths).splitlines(),
        *_git(root, "ls-files", "--others", "--exclude-standard", "--", *paths).splitlines(),
    ]
    changed = [name for name in names if _committed_code(root, commit, name) != _present_code(root, name)]
    if changed:
        commits = _git(root, "log", "--format=%h %s", f"{commit}..HEAD", "--", *changed).splitlines()
        # There is no commit for a change that is uncommitted, or that came in with a merge.
        yield from commits or [f"not in a commit of its own: {', '.join(changed)}"]


@functools.cache
def _committed_code(root: Path, commit: str, name: str) -> str:
    return _code(name, _git(root, "show", f"{commit}:{name}"))


def _present_code(root: Path, name: str) -> str:
    path = root / name
    return _code(name, path.read_text() if path.is_file() else "")


def _code(name: str, text: str) -> str:
    """What a file does, without what only people read; empty if it is not there."""
    match Path(name).suffix:
        case ".py":
            return _without_docstrings(text)
        case ".yaml" | ".yml":
            return repr(yaml.safe_load(text))
        case ".md":
            return ""
        case _:
            return text


def _without_docstrings(text: str) -> str:
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            and ast.get_docstring(node, clean=False) is not None
        ):
            node.body = node.body[1:]
    return ast.dump(tree)


def _git(root: Path, *arguments: str) -> str:
    """What git prints; empty where it fails."""
    done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=False)
    return done.stdout if done.returncode == 0 else ""
