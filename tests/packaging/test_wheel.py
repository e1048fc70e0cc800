"""The built wheel in a clean environment: LeRobot finds it by its Name, quickly and without MuJoCo."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest

pytestmark = pytest.mark.slow  # what builds and installs it is slow, and seldom changes

ROOT = Path(__file__).parents[2]
NAME = "lerobot_policy_openspm"

PROBE = """
import importlib.metadata, json, sys, time
import lerobot.scripts.lerobot_train  # what the command line has imported before it looks for plugins
from lerobot.configs import PreTrainedConfig
from lerobot.utils.import_utils import register_third_party_plugins

before = set(sys.modules)
started_s = time.process_time()
register_third_party_plugins()
spent_s = time.process_time() - started_s
added = set(sys.modules) - before
print(json.dumps({
    "choices": sorted(PreTrainedConfig.get_known_choices()),
    "face": getattr(sys.modules.get("lerobot_policy_openspm"), "__file__", None),
    "package": getattr(sys.modules.get("lerobot_openspm"), "__file__", None),
    "names": [d.metadata["Name"] for d in importlib.metadata.distributions()
              if "openspm" in (d.metadata["Name"] or "").lower()],
    "mujoco": sorted(name for name in added if name.split(".")[0] == "mujoco"),
    "spent_s": spent_s,
}))
"""


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command away from this checkout's import path; return what it printed."""
    env = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel as `python -m build` makes it, with the build backend that is installed already."""
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, ROOT, cwd=out)
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def clean_python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of an environment with the wheel and links to all that is installed here but this project."""
    home = tmp_path_factory.mktemp("clean")
    links = home / "dependencies"
    links.mkdir()
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if NAME not in entry.name:  # neither the metadata nor the .pth of the editable installation
            (links / entry.name).symlink_to(entry)
    venv.create(home / "venv", symlinks=True)
    python = home / "venv" / "bin" / "python"
    site = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=home).strip()
    Path(site, "dependencies.pth").write_text(f"{links}\n")
    run(
        sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=home
    )
    return python


@pytest.fixture(scope="module")
def discovered(clean_python: Path) -> dict[str, Any]:
    """What LeRobot's plugin discovery finds and imports in the clean environment."""
    home = clean_python.parents[2]
    return json.loads(run(clean_python, "-c", PROBE, cwd=home).splitlines()[-1])


def test_wheel_holds_both_packages_and_the_licence(wheel: Path):
    names = ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {
        "lerobot_openspm",
        "lerobot_policy_openspm",
        f"{NAME}-0.1.0.dist-info",
    }
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert "lerobot_openspm/language/lexicon.yaml" in names
    assert "lerobot_openspm/cli/templates/report.html" in names  # what `openspm demo` reads


def test_name_keeps_its_underscores(discovered: dict[str, Any]):
    assert discovered["names"] == [NAME]


def test_lerobot_discovers_the_policy_from_the_wheel(discovered: dict[str, Any], clean_python: Path):
    assert "openspm" in discovered["choices"]
    site = str(clean_python.parents[1])
    assert discovered["face"].startswith(site)
    assert discovered["package"].startswith(site)


def test_discovery_is_quick_and_leaves_mujoco_alone(discovered: dict[str, Any]):
    assert discovered["mujoco"] == []
    # Processor time, so that a busy machine does not matter.
    assert discovered["spent_s"] < 1.0
