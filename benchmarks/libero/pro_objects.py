"""LIBERO-PRO's object classes, run from its unpacked files beside the installed LIBERO.

Its tasks with other objects name classes such as `yellow_plate`, which stock LIBERO does not know.
"""

from __future__ import annotations

import functools
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

MODULES = ("hope_objects", "google_scanned_objects", "articulated_objects", "turbosquid_objects")
# Only LIBERO-PRO's assets hold it, not those of LIBERO that the Hub has.
ITS_OWN = "articulated_objects/yellow_cabinet.xml"


@functools.cache
def register_objects(envs: Path, assets: Path) -> None:
    """Make LIBERO-PRO's classes known to LIBERO in this process; LIBERO's own classes stay as they are.

    Args:
        envs: LIBERO-PRO's folder `envs`.
        assets: The meshes and textures.

    Raises:
        FileNotFoundError: The classes or their meshes are not there.
    """
    if not (assets / ITS_OWN).is_file():
        raise FileNotFoundError(
            f"{assets} has no {ITS_OWN}: these are LIBERO's meshes without LIBERO-PRO's; remove that folder "
            "and run, in a checkout: python scripts/libero_assets.py"
        )
    # Imports all of LIBERO's objects, too, so that none of them registers itself with LIBERO-PRO's registry.
    from libero.libero.envs import base_object as ours  # pyright: ignore[reportMissingImports]

    # The modules register themselves where they import the registry from, some classes more than once; only
    # LIBERO-PRO's registry permits that.
    theirs = _module(envs / "base_object.py")
    sys.modules[ours.__name__] = theirs
    try:
        modules = [_module(envs / "objects" / f"{name}.py") for name in MODULES]
    finally:
        sys.modules[ours.__name__] = ours
    for module in modules:
        # Where its classes look for meshes; what LIBERO's configuration says of it may lead nowhere.
        vars(module)["absolute_path"] = assets
    for name in ("OBJECTS_DICT", "VISUAL_CHANGE_OBJECTS_DICT"):
        known = getattr(ours, name)
        known.update({**getattr(theirs, name), **known})


def _module(file: Path) -> ModuleType:
    """Run a file as a module that nothing else can import.

    Raises:
        FileNotFoundError: It is not there.
    """
    spec = importlib.util.spec_from_file_location(f"libero_pro_{file.stem}", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
