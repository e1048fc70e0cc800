"""Imports go one way, over every room.

geometry <- types <- language <- memory <- perception <- mining <- flow <- control <- policy <- bench <- cli;
calibration needs geometry alone, envs stand beside. "policy" is LeRobot's three modules and their helpers,
which lie directly in the package. The benchmarks import the package, and nothing in it imports them.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from scripts.house import cycles

SRC = Path(__file__).parents[2] / "src"
PACKAGE = "lerobot_openspm"
FACE = "lerobot_policy_openspm"
BASICS = ("errors", "files")
# What each room may import of ours besides itself and the basics.
ALLOWED = {
    "geometry": set(),
    "types": {"geometry"},
    "calibration": {"geometry"},
    "language": {"geometry", "types"},
    "memory": {"geometry", "types", "language"},
    "perception": {"geometry", "types"},
    "mining": {"geometry", "types", "language", "perception", "memory"},
    "flow": {"geometry", "types", "memory", "mining"},
    "control": {"geometry", "types", "language", "perception", "memory", "flow"},
    "policy": {"geometry", "types", "language", "perception", "memory", "mining", "flow", "control"},
}
BELOW_CLI = {*ALLOWED, "envs", "bench"}
ALLOWED |= {
    "envs": {"geometry"},
    "bench": {"perception", "policy"},
    "cli": BELOW_CLI,
}
LEAVES = {"envs", "cli", "bench"}
# Still to be undone. A line whose import is gone has to go too.
NOT_YET = {
    ("memory", "perception"),
}
KNOTS_NOT_YET = (
    {f"{PACKAGE}.bench", f"{PACKAGE}.cli"},
    {f"{PACKAGE}.memory", f"{PACKAGE}.perception"},
)
PURE = ("geometry", "calibration", "language", "memory", "control")


def part_of(module: str) -> str:
    """Return the part that a module of ours belongs to: a folder's name, "basics", "policy" or "face"."""
    names = module.split(".")
    if names[0] == FACE:
        return "face"
    if len(names) > 1 and (SRC / PACKAGE / names[1]).is_dir():
        return names[1]
    if names[1:2] == ["types"]:
        return "types"
    return "basics" if names[1:2] in ([name] for name in BASICS) else "policy"


def imported(tree: ast.AST, module: str, *, top_only: bool = False) -> Iterator[str]:
    """Yield the dotted names that a module imports, anywhere or only when it is itself imported."""
    for node in _run_at_import(tree) if top_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".")[: -node.level]
                base = ".".join([*package, base] if base else package)
            # `from package import part` names a part by its alias.
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _run_at_import(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        yield node
        yield from _run_at_import(node)


def modules() -> dict[str, ast.Module]:
    """Return every module of ours by its dotted name (a package's is `package.__init__`)."""
    found = {}
    for package in (PACKAGE, FACE):
        for path in sorted((SRC / package).rglob("*.py")):
            name = ".".join(path.relative_to(SRC).with_suffix("").parts)
            found[name] = ast.parse(path.read_text(encoding="utf-8"))
    return found


MODULES = modules()


def ours(module: str) -> Iterator[tuple[str, str]]:
    """Yield (imported name, its part) for a module's imports of ours from other parts."""
    for name in imported(MODULES[module], module):
        if name.split(".")[0] in (PACKAGE, FACE) and part_of(name) not in (part_of(module), "basics"):
            yield name, part_of(name)


@pytest.mark.parametrize("part", sorted(ALLOWED))
def test_a_part_imports_only_what_lies_below_it(part: str):
    wrong = [
        f"{module} imports {name}"
        for module in MODULES
        if part_of(module) == part
        for name, target in ours(module)
        if target not in ALLOWED[part] and (part, target) not in NOT_YET
    ]
    assert wrong == []


def test_what_is_not_yet_undone_is_still_there():
    found = {(part_of(module), target) for module in MODULES for _, target in ours(module)}
    assert found >= NOT_YET


def test_the_package_imports_no_benchmarks():
    wrong = [
        f"{module} imports {name}" for module, tree in MODULES.items() for name in imported(tree, module)
    ]
    assert [line for line in wrong if "imports benchmarks" in line] == []


def test_only_the_cli_imports_envs_and_bench():
    allowed = {(FACE + ".__init__", f"{PACKAGE}.envs.tabletop.configuration")}
    wrong = [
        f"{module} imports {name}"
        for module in MODULES
        if part_of(module) not in LEAVES
        for name, target in ours(module)
        if target in LEAVES and (module, name.rpartition(".")[0]) not in allowed
    ]
    assert wrong == []


@pytest.mark.parametrize("module", BASICS)
def test_the_basics_import_nothing_of_ours_but_the_errors(module: str):
    name = f"{PACKAGE}.{module}"
    found = [n for n in imported(MODULES[name], name) if n.startswith((PACKAGE, FACE))]
    assert [n for n in found if not n.startswith(f"{PACKAGE}.errors")] == []
    assert module != "errors" or found == []


def test_acting_imports_no_mining():
    found, left = set(), ["lerobot_openspm.modeling_openspm"]
    while left:
        name = left.pop()
        if name in MODULES and name not in found:
            found.add(name)
            names = list(imported(MODULES[name], name, top_only=True))
            left += [*names, *(one.rpartition(".")[0] for one in names)]
    assert "lerobot_openspm.flow.network" in found
    assert [name for name in found if part_of(name) == "mining"] == []


@pytest.mark.parametrize("part", PURE)
def test_the_method_needs_neither_lerobot_nor_mujoco(part: str):
    wrong = [
        f"{module} imports {name}"
        for module, tree in MODULES.items()
        if part_of(module) == part
        for name in imported(tree, module, top_only=True)
        if name.split(".")[0] in ("lerobot", "mujoco")
    ]
    assert wrong == []


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("from lerobot_openspm import control", ["lerobot_openspm.control"]),
        ("from ..control import executor", ["lerobot_openspm.control.executor"]),
        ("def f():\n    import mujoco", []),
        ("try:\n    import mujoco\nexcept ImportError:\n    pass", ["mujoco"]),
    ],
)
def test_the_reader_of_imports(code: str, expected: list[str]):
    assert list(imported(ast.parse(code), "lerobot_openspm.memory.entry", top_only=True)) == expected


def test_no_rooms_and_no_modules_import_each_other_in_a_circle():
    found = cycles(sorted((SRC / PACKAGE).rglob("*.py")))
    assert [knot for knot in found if knot not in KNOTS_NOT_YET] == []
