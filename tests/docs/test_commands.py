"""What README and the docs say to type can be typed.

Quick commands are run, in a folder laid out as the pages have it by then; of the others the command line is
read by the very parser that would read it.
"""

import argparse
import importlib.util
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import draccus
import pytest
from benchmarks.figures import FIGURES
from tests.docs.pages import OURS, REPOSITORY, THIRD_PARTY, Line, lines
from tests.policy.lerobot_commands import CALIBRATION

from lerobot_openspm.configuration_openspm import OpenSPMConfig

LINES = [*lines(), *(Line("benchmarks/figures.py", figure.command, True) for figure in FIGURES.values())]
RUN = (
    "openspm inspect",
    "openspm memory export",
    "openspm memory list",
    "openspm memory search",
    "openspm memory show",
    "openspm teach",
    "python scripts/stale_figures.py",
)
HAS_LIBERO = importlib.util.find_spec("libero") is not None


class Parsed(BaseException):
    """What a command's parser made of its line; nothing after it is done."""

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self.config = config


def ids(line: Line) -> str:
    return f"{line.page}: {line.typed[:60]}"


def of_ours(*programs: str) -> list[Line]:
    return [line for line in LINES if line.words[0] in programs]


def lay_out(folder: Path, checkpoint: Path, dataset: Path) -> None:
    """What the pages have made by the time of each command, and what their placeholders mean."""
    runs = ("outputs/train", "outputs/libero_train", "outputs/demo/demos_10/train")
    for name in ("CHECKPOINT", *(f"{run}/checkpoints/last/pretrained_model" for run in runs)):
        shutil.copytree(checkpoint, folder / name)
    for name in ("outputs/tabletop", "outputs/more", "outputs/libero_goal", "FOLDER"):
        (folder / name).symlink_to(dataset)
    (folder / "FILE").symlink_to(CALIBRATION)
    for name in ("benchmarks", "configs", "docs", "scripts", "src", "README.md"):
        (folder / name).symlink_to(REPOSITORY / name)


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The current folder, where the checkpoint has its configuration alone: enough to read command lines."""
    OpenSPMConfig(device="cpu", push_to_hub=False).save_pretrained(tmp_path / "checkpoint")
    lay_out(tmp_path, tmp_path / "checkpoint", tmp_path)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def trained_workplace(
    tmp_path: Path, checkpoint: Path, tiny_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The current folder, with a policy that was trained."""
    lay_out(tmp_path, checkpoint, tiny_dataset)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], Any]:
    """Call a program up to where it has parsed its command line; returns what it parsed."""
    depth = 0

    def outermost(original: Callable[..., Any]) -> Callable[..., Any]:
        def parse(*arguments: Any, **named: Any) -> Any:
            nonlocal depth
            depth += 1
            try:
                config = original(*arguments, **named)
            finally:
                depth -= 1
            # A configuration that is read on the way, such as a checkpoint's, belongs to the whole.
            if depth:
                return config
            raise Parsed(config)

        return parse

    monkeypatch.setattr(draccus, "parse", outermost(draccus.parse))
    parser_class = argparse.ArgumentParser

    def parse(words: list[str]) -> Any:
        program, *arguments = words
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", words)
            try:
                if program.endswith("python"):
                    patch.setattr(parser_class, "parse_args", outermost(parser_class.parse_args))
                    _run_python(arguments, patch)
                else:
                    (script,) = entry_points(group="console_scripts", name=program)
                    script.load()()
            except Parsed as parsed:
                return parsed.config
        raise AssertionError(f"{program} ran without having parsed {arguments}")

    return parse


def _run_python(arguments: list[str], patch: pytest.MonkeyPatch) -> None:
    if arguments[0] == "-m":
        patch.setattr(sys, "argv", arguments[1:])
        with warnings.catch_warnings():
            # Another test may have imported the module; it is run anew all the same.
            warnings.filterwarnings("ignore", "'.*' found in sys.modules", RuntimeWarning)
            runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
    else:
        patch.setattr(sys, "argv", arguments)
        patch.syspath_prepend(str(Path(arguments[0]).resolve().parent))  # as Python does itself
        runpy.run_path(arguments[0], run_name="__main__")


def test_the_pages_show_commands_of_every_kind():
    assert {line.words[0] for line in LINES} <= {*OURS, *THIRD_PARTY}
    assert {line.words[0] for line in LINES} >= {"make", "openspm", "lerobot-train", "lerobot-eval", "python"}
    assert len([line for line in LINES if line.typed.startswith(RUN) and not line.is_mention]) >= 8


@pytest.mark.parametrize(
    "line",
    [
        # Those about LIBERO run with the other tests that need it installed.
        pytest.param(one, marks=pytest.mark.libero if "libero" in one.typed else ())
        for one in of_ours("openspm", "lerobot-train", "lerobot-eval", "python", ".venv/bin/python")
        if not one.is_mention and "-c" not in one.words
    ],
    ids=ids,
)  # fmt: skip
@pytest.mark.usefixtures("workplace")
def test_a_command_line_is_understood(line: Line, parse: Callable[[list[str]], Any]):
    if "libero" in line.typed and not HAS_LIBERO:
        pytest.skip("LIBERO is not installed")
    if "--help" in line.words:
        with pytest.raises(SystemExit) as stopped:
            parse(line.words)
        assert stopped.value.code == 0
        return
    assert parse(line.words) is not None


@pytest.mark.parametrize(
    "line", [one for one in of_ours("openspm") if one.is_mention], ids=ids
)  # fmt: skip
def test_a_command_that_is_named_exists(line: Line, parse: Callable[[list[str]], Any], capsys: Any):
    with pytest.raises(SystemExit) as stopped:
        parse([*line.words, "--help"])
    assert stopped.value.code == 0
    assert "--" in capsys.readouterr().out


@pytest.mark.parametrize("line", of_ours("make"), ids=ids)
def test_a_target_of_make_exists_and_its_variables_too(line: Line):
    known = re.findall(r"^(?:export )?([A-Z_]+) *\?=", (REPOSITORY / "Makefile").read_text(), re.M)
    assert {word.partition("=")[0] for word in line.words[1:] if "=" in word} <= set(known)
    done = subprocess.run(
        ["make", "-n", *line.words[1:]], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_what_pip_installs_of_ours_is_offered():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    ours = {(project["name"], page) for page in {line.page for line in LINES}} | {(".", "docs/libero.md")}
    named = {
        extra.removesuffix("]")
        for line in of_ours("pip")
        for package, bracket, extra in (word.partition("[") for word in line.words[2:])
        if bracket and (package, line.page) in ours
    }
    assert named == {"libero", "perception", "index", "text"} & set(project["optional-dependencies"])


def layout_option() -> str:
    """What the page says to type where a dataset's feature names do not tell its layout."""
    page = (REPOSITORY / "docs/own_data.md").read_text()
    (found,) = [word for word in page.split("`") if "state_layout=" in word]
    return " ".join(found.split())


@pytest.mark.parametrize("line", [one for one in of_ours("lerobot-train") if not one.is_mention], ids=ids)
@pytest.mark.usefixtures("workplace")
def test_a_layout_is_named_beside_any_command_that_trains(line: Line, parse: Callable[[list[str]], Any]):
    config = parse(Line(line.page, f"{line.typed} {layout_option()}", True).words)
    assert config.policy.state_layout[:3] == ["x", "y", "z"]
    assert config.policy.state_layout[-1] == "gripper"


@pytest.mark.slow
@pytest.mark.parametrize(
    "line", [one for one in LINES if one.typed.startswith(RUN) and not one.is_mention], ids=ids
)
@pytest.mark.usefixtures("trained_workplace")
def test_a_quick_command_does_what_it_says(line: Line):
    if "libero" in line.typed and not HAS_LIBERO:
        pytest.skip("LIBERO is not installed")
    assert shell(line.typed).strip()


def shell(line: str, cwd: Path | None = None) -> str:
    """Run a command line as it is typed in the project's environment; what it printed."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euc", line], capture_output=True, text=True, timeout=300, check=False, cwd=cwd,
        env=os.environ | {"PATH": path, "HF_HUB_OFFLINE": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


# What makes a command short; the last of two equal options counts.
SHORTER = {
    "openspm collect": " --env.task=bowl_on_plate --episodes=2",
    "lerobot-train": " --steps=2",
    "lerobot-eval": " --env.task=bowl_on_plate --eval.n_episodes=1 --eval.batch_size=1",
    "openspm inspect": "",
}


@pytest.mark.slow
def test_from_recording_to_evaluation_the_commands_of_the_readme_do_what_they_say(tmp_path: Path):
    page = [line for line in LINES if line.page == "README.md" and line.in_block]
    first = next(i for i, line in enumerate(page) if line.typed.startswith("openspm collect"))
    for line, (program, options) in zip(page[first:], SHORTER.items(), strict=False):
        assert line.typed.startswith(program)
        shell(line.typed + options, cwd=tmp_path)
    assert (tmp_path / "outputs/train/checkpoints/last/pretrained_model/memory.json").is_file()
    (told,) = (tmp_path / "outputs/eval").rglob("eval_info.json")
    assert json.loads(told.read_text())["overall"]["n_episodes"] == 1
