"""What README and the docs point to is there: links, files, and what is named behind a file."""

import ast
import re
from pathlib import Path

import pytest
from tests.docs.pages import BLOCK, PAGES, REPOSITORY

PACKAGE = REPOSITORY / "src" / "lerobot_openspm"
LINK = re.compile(r"\]\((?!https?:|#)([^)#]+)")
SPAN = re.compile(r"`([^`]+)`")
# `file.py`: `name`, `name` and `Class.name`
CITED = re.compile(r"`([\w/]+\.py)`: ((?:`[\w.]+`(?:, | and )?)+)")
# "caller ==>|"function: Type<br>function: Type"| callee"
ARROW = re.compile(r'^  (\w+) (?:-\.->|==>)\|"(.*)"\| (\w+)$', re.M)
PATH = re.compile(r"[\w/.]+/[\w.]*")
FOLDERS = (REPOSITORY, PACKAGE)
ROOTS = {path.name for folder in FOLDERS for path in folder.iterdir() if path.is_dir()} - {"outputs"}
PICTURE = REPOSITORY / "docs" / "architecture.md"


def text_of(page: Path) -> str:
    """A page without its blocks of code."""
    return BLOCK.sub("", page.read_text())


def found(cited: str) -> Path | None:
    """The file that a page cites, from the repository's root or from the package."""
    return next((root / cited for root in FOLDERS if (root / cited).exists()), None)


def defined(file: Path) -> set[str]:
    """Names of a file's functions, classes, methods as `Class.method`, and constants."""
    names = set[str]()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{one.name}" for one in node.body if isinstance(one, ast.FunctionDef)}
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path):
    assert [link for link in LINK.findall(text_of(page)) if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_are_named_are_there(page: Path):
    named = {span for span in SPAN.findall(text_of(page)) if PATH.fullmatch(span)}
    assert [one for one in sorted(named) if found(one) is None and one.partition("/")[0] in ROOTS] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_cited_behind_a_file_are_defined_in_it(page: Path):
    wrong = []
    for cited, names in CITED.findall(" ".join(text_of(page).split())):
        file = found(cited)
        known = defined(file) if file else set[str]()
        wrong += [f"{cited}: {name}" for name in SPAN.findall(names) if name not in known]
    assert wrong == []


def test_the_picture_names_rooms_and_functions_that_exist():
    arrows = ARROW.findall(PICTURE.read_text())
    assert len(arrows) >= 10
    for _, labels, callee in arrows:
        files = (
            [PACKAGE / f"{callee}.py"]
            if (PACKAGE / f"{callee}.py").exists()
            else (PACKAGE / callee).rglob("*.py")
        )
        known = {name.rpartition(".")[2] for file in files for name in defined(file)}
        assert {label.partition(":")[0] for label in labels.split("<br>")} <= known


def test_the_readme_is_read_in_five_minutes():
    assert len((REPOSITORY / "README.md").read_text().splitlines()) <= 100
