"""A figure's paths hold all the project's code that takes it, as told by what its modules import."""

import ast
import functools
import shlex
import subprocess
from collections.abc import Iterator

import pytest
from benchmarks.figures import FIGURES, PACKAGE, Figure, needs_libero
from benchmarks.staleness import ROOT

from lerobot_openspm.cli.pipeline import RECORDED_BY

# Imported, but not part of any figure: neither these nor what they import.
PASSED_OVER = (
    # How a result is told and kept, not what it is.
    *(f"{PACKAGE}/{name}.py" for name in ("errors", "files", "cli/main")),
    "benchmarks/results.py",
    "benchmarks/harness.py",
    # Backends that need a download, and what only asks one.
    *(
        f"{PACKAGE}/{name}"
        for name in (
            "search.py",
            "perception/objects/sam3d",
            "perception/segmentation/grounded_sam2",
            "perception/segmentation/sam3",
            "mining/phase_labels/",
        )
    ),
)
# What a figure of one simulator does not run of the other.
OTHER_SIMULATOR = {
    "openspm_tabletop": (f"{PACKAGE}/envs/libero/", "benchmarks/libero/"),
    "libero": tuple(
        f"{PACKAGE}/envs/tabletop/{name}.py"
        for name in ("experts", "placement", "scene", "tasks", "env", "recording")
    ),
}
# What a figure imports for types alone, or of which it uses only what keeps its folder, or reads a dataset.
OF_FIGURE = {
    "keyposes_": (f"{PACKAGE}/cli/",),
    "libero_experts": (f"{PACKAGE}/cli/",),
    "language": (f"{PACKAGE}/flow/", f"{PACKAGE}/perception/", f"{PACKAGE}/cli/"),
    "memory": (f"{PACKAGE}/perception/",),
    "calibration": (
        f"{PACKAGE}/training.py",
        f"{PACKAGE}/configuration_openspm.py",
        f"{PACKAGE}/mining/key_poses.py",
        f"{PACKAGE}/memory/entry.py",
        f"{PACKAGE}/perception/",
        f"{PACKAGE}/cli/options.py",
    ),
}


def missing(name: str, paths: tuple[str, ...]) -> set[str]:
    """Files that a figure imports beside those of the paths."""
    own = [left_out for figure, some in OF_FIGURE.items() if name.startswith(figure) for left_out in some]
    other = OTHER_SIMULATOR["libero" if needs_libero(FIGURES[name]) else "openspm_tabletop"]
    return closure(entry(FIGURES[name]), (*PASSED_OVER, *own, *other)) - covered(paths)


@pytest.mark.parametrize("name", FIGURES)
def test_what_a_figure_imports_lies_within_its_paths(name: str):
    assert missing(name, FIGURES[name].paths) == set()


@pytest.mark.parametrize("simulator", RECORDED_BY)
def test_what_records_demonstrations_is_what_they_are_kept_for(simulator: str):
    package = ROOT / PACKAGE
    found = {str(p.relative_to(ROOT)) for pattern in RECORDED_BY[simulator] for p in package.glob(pattern)}
    needed = closure(f"{PACKAGE}/envs/collection.py", PASSED_OVER + OTHER_SIMULATOR[simulator])
    assert needed - found == set()


def test_an_import_that_is_not_listed_is_seen():
    robot = f"{PACKAGE}/memory/robot.py"
    without = tuple(path for path in FIGURES["keyposes_libero"].paths if path != robot)
    assert missing("keyposes_libero", without) == {robot}


def entry(figure: Figure) -> str:
    """The module that a figure's command runs."""
    match shlex.split(figure.command):
        case ["python", "-m", module, *_]:
            return f"{module.replace('.', '/')}.py"
    raise AssertionError(figure.command)


def covered(paths: tuple[str, ...]) -> set[str]:
    listed = subprocess.run(
        ["git", "ls-files", "--", *paths], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(listed.stdout.splitlines())


def closure(first: str, passed_over: tuple[str, ...]) -> set[str]:
    """A module's file, and those of all modules of the project that it imports, however far down."""
    found, left = {first}, [first]
    while left:
        new = {name for name in imported(left.pop()) if not name.startswith(passed_over)} - found
        found |= new
        left += new
    return found


@functools.cache
def imported(name: str) -> frozenset[str]:
    """Files of the project's modules that a file imports anywhere but for its types alone."""
    names = set(_names(ast.parse((ROOT / name).read_text())))
    files = {
        f"{folder}{module.replace('.', '/')}.py"
        for module in names
        for folder in ([""] if module.startswith("benchmarks.") else ["src/"])
    }
    return frozenset(file for file in files if (ROOT / file).is_file())


def _names(node: ast.AST) -> Iterator[str]:
    match node:
        case ast.If(test=ast.Name("TYPE_CHECKING")):
            return
        case ast.Import(names):
            yield from (alias.name for alias in names)
        case ast.ImportFrom(module=str(module), names=names):
            yield module
            yield from (f"{module}.{alias.name}" for alias in names)
    for child in ast.iter_child_nodes(node):
        yield from _names(child)
