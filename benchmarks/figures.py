"""Every published figure: the command that takes it, and the code that it measures.

    python -m benchmarks.figures                     # take all, unless current
    python -m benchmarks.figures tracking libero_goal   # take these, unless current

Those on LIBERO are left out of all where it is not installed. A figure `NAME` is kept as
``benchmarks/results/NAME.json``. A command that takes hours goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import logging
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.staleness import origin

from lerobot_openspm.bench.results import MEASURED_CODE, code_version
from lerobot_openspm.cli.pipeline import LIBERO_ASSETS, RECORDED_BY
from lerobot_openspm.errors import OpenSPMError

logger = logging.getLogger(__name__)

PACKAGE = "src/lerobot_openspm"
# What a policy does with its default options. Backends that need a download are not part of any figure.
POLICY = (
    *(
        f"{PACKAGE}/{room}"
        for room in ("control", "flow", "geometry", "language", "memory", "mining", "perception")
    ),
    f":(glob){PACKAGE}/*.py",
    f":(exclude){PACKAGE}/search.py",
    f":(exclude){PACKAGE}/perception/objects/sam3d",
    f":(exclude){PACKAGE}/mining/phase_labels",
    f":(exclude,glob){PACKAGE}/perception/segmentation/*sam*.py",
)
RECORDING = {
    simulator: tuple(f":(glob){PACKAGE}/{pattern}" for pattern in patterns)
    for simulator, patterns in RECORDED_BY.items()
}
TABLETOP = (
    *POLICY,
    *RECORDING["openspm_tabletop"],
    *(f"{PACKAGE}/cli/{name}.py" for name in ("pipeline", "demo")),
    "configs/openspm_tabletop_train.yaml",
    "configs/cameras/openspm_tabletop.json",
)
LIBERO = (
    *POLICY,
    *RECORDING["libero"],
    str(LIBERO_ASSETS),
    f"{PACKAGE}/cli/pipeline.py",
    *(f"{PACKAGE}/bench/{name}.py" for name in ("episode", "libero")),
    "configs/openspm_libero_train.yaml",
    "configs/cameras/libero.json",
    "benchmarks/common.py",
    "benchmarks/libero/episode.py",
    "benchmarks/libero/evaluate.py",
    "benchmarks/libero/stages.py",
)
TRACKING = (
    f"{PACKAGE}/cli/bench.py",
    *(f"{PACKAGE}/bench/{name}.py" for name in ("tracking", "tabletop", "episode")),
)
ALONG = (
    f"{PACKAGE}/cli/bench.py",
    *(
        f"{PACKAGE}/bench/{name}.py"
        for name in ("perception", "truth", "object_frames", "episode", "tabletop")
    ),
)
KEY_POSES = (
    *(f"{PACKAGE}/{room}" for room in ("geometry", "mining")),
    f"{PACKAGE}/types.py",
    f"{PACKAGE}/memory/robot.py",
    f"{PACKAGE}/envs/unsteady.py",
    *(
        f"{PACKAGE}/bench/{name}.py"
        for name in ("key_poses", "recording", "contact_events", "contact_sensor")
    ),
)
LANGUAGE = (
    *(f"{PACKAGE}/{room}" for room in ("control", "geometry", "language", "memory", "mining")),
    f"{PACKAGE}/types.py",
    f"{PACKAGE}/bench/language.py",
    f"{PACKAGE}/bench/taught_words.py",
    f"{PACKAGE}/bench/instructions",
)
ACCURACY = ("benchmarks/libero/accuracy.py", f"{PACKAGE}/bench/object_frames.py")
CALIBRATION = (
    *(f"{PACKAGE}/{room}" for room in ("calibration", "geometry")),
    f"{PACKAGE}/types.py",
    *(f"{PACKAGE}/mining/{name}.py" for name in ("columns", "dataset", "signals")),
    f"{PACKAGE}/memory/robot.py",
    *(f"{PACKAGE}/cli/{name}.py" for name in ("calibrate", "pipeline")),
    *(f"benchmarks/{name}.py" for name in ("calibration", "common")),
)
NOISE = "benchmarks.measurement_noise"
NOISE_PATHS = ("benchmarks/measurement_noise.py", "benchmarks/common.py")
# As `make libero` types it.
LIBERO_GOAL = "--demos=10 --states=50 --tasks=0-9"
NEW_TASKS = (
    "open_the_middle_drawer_of_the_cabinet",
    "put_the_bowl_on_the_plate",
    "put_the_cream_cheese_in_the_bowl",
    "turn_on_the_stove",
)


@dataclass(frozen=True)
class Figure:
    """How a figure is taken.

    Attributes:
        command: The command line, from the root of the checkout; what it wrote says with what it was run.
        paths: Git's names (pathspecs) of the code whose change makes the figure stale.
        simulator: The one whose default checkpoint it measures; "" if it makes its own.
    """

    command: str
    paths: tuple[str, ...]
    simulator: str = ""


def _bench(what: str, name: str, paths: tuple[str, ...], options: str = "", simulator: str = "") -> Figure:
    options = f" {options}" if options else ""
    command = f"openspm bench {what}{options} --result=benchmarks/results/{name}.json"
    return Figure(command, paths, simulator)


def _tabletop(comparison: str) -> Figure:
    own = ("benchmarks/tabletop.py", "benchmarks/common.py")
    return Figure(f"python -m benchmarks.tabletop {comparison}", (*TABLETOP, *own))


def _libero(script: str, *own: str, options: str = "") -> Figure:
    module = f"benchmarks/libero/{script}.py"
    return Figure(f"python -m benchmarks.libero.{script} {options}".strip(), (*LIBERO, module, *own))


FIGURES: dict[str, Figure] = {
    "tabletop": Figure(
        "openspm demo --demos=10 --episodes=20 --result=benchmarks/results/tabletop.json", TABLETOP
    ),
    **{name: _tabletop(name) for name in ("execution", "oracle", "conditioning", "compound", "two_bowls")},
    "perception_tabletop": _bench(
        "perception", "perception_tabletop", (*TABLETOP, *ALONG), simulator="openspm_tabletop"
    ),
    **{
        name: _bench(name, name, (*TABLETOP, *own, *TRACKING), simulator="openspm_tabletop")
        for name, own in {"tracking": (), "cameras": (), "teach": (f"{PACKAGE}/bench/teach.py",)}.items()
    },
    "keyposes_tabletop": _bench(
        "keyposes", "keyposes_tabletop", (*KEY_POSES, *RECORDING["openspm_tabletop"]),
        "--env.type=openspm_tabletop --seed=30000",
    ),
    "language": _bench("language", "language", LANGUAGE),
    "memory": _bench(
        "memory", "memory",
        (f"{PACKAGE}/memory", f"{PACKAGE}/language", f"{PACKAGE}/geometry", f"{PACKAGE}/types.py",
         f":(glob){PACKAGE}/bench/synthetic_*.py", f"{PACKAGE}/bench/memory.py"),
    ),
    "measurement_noise": Figure(f"python -m {NOISE}", (*TABLETOP, *ALONG, *NOISE_PATHS), "openspm_tabletop"),
    "measurement_noise_libero": Figure(
        f"python -m {NOISE} --env.type=libero", (*LIBERO, *ALONG, *NOISE_PATHS), "libero"
    ),
    "libero_goal": _libero("run", *ACCURACY, options=LIBERO_GOAL),
    "libero_accuracy": _libero("run", *ACCURACY, options=LIBERO_GOAL),
    "libero_few_shot_3": _libero("few_shot", options="--demos=3"),
    "libero_few_shot_1": _libero("few_shot", options="--demos=1 --states=10"),
    "libero_ablations": _libero(
        "ablations", "benchmarks/libero/geometric_guess.py", "benchmarks/libero/guessed_key_poses.py",
        f"{PACKAGE}/mining/phase_labels",
    ),
    **{f"libero_new_task_{task}_3": _libero("new_task", options=f"--task={task}") for task in NEW_TASKS},
    "libero_losses": _libero("losses"),
    "libero_latency": _libero("latency"),
    "libero_equality": _libero("equality"),
    "perception_libero": _bench(
        "perception", "perception_libero", (*LIBERO, *ALONG), "--env.type=libero", "libero"
    ),
    "keyposes_libero": _bench(
        "keyposes", "keyposes_libero", (*KEY_POSES, *RECORDING["libero"], str(LIBERO_ASSETS)),
        "--env.type=libero --seed=30000",
    ),
    "calibration": Figure(
        "python -m benchmarks.calibration", (*CALIBRATION, *RECORDING["openspm_tabletop"])
    ),
    "calibration_libero": Figure(
        "python -m benchmarks.calibration --env.type=libero",
        (*CALIBRATION, *RECORDING["libero"], str(LIBERO_ASSETS)),
    ),
}  # fmt: skip


def takeable() -> list[str]:
    """All figures, but for those on LIBERO where that is not installed; which these are is told."""
    if importlib.util.find_spec("libero") is not None:
        return list(FIGURES)
    left_out = [name for name, figure in FIGURES.items() if needs_libero(figure)]
    logger.warning("LIBERO is not installed; run: make libero-setup. Left out: %s", ", ".join(left_out))
    return [name for name in FIGURES if name not in left_out]


def needs_libero(figure: Figure) -> bool:
    """Whether a figure is taken on LIBERO, which is installed apart."""
    return "libero" in figure.command


def take(name: str) -> None:
    """Run a figure's command, unless its result is current. One that fails leaves the others to be taken.

    The default checkpoint that it measures is made first, unless there is one by the present code.
    """
    figure = FIGURES[name]
    problem = origin(name, figure.paths, expected_command=figure.command).problem
    if problem is None:
        logger.info("%s is current", name)
        return
    logger.info("%s (%s): %s", name, problem, figure.command)
    try:
        if figure.simulator:
            make_checkpoint(figure.simulator)
        program, *arguments = shlex.split(figure.command)
        subprocess.run([str(Path(sys.executable).with_name(program)), *arguments], check=True)
    except (subprocess.CalledProcessError, OpenSPMError, OSError, RuntimeError, ImportError) as error:
        logger.error("%s failed: %s", name, error)


def make_checkpoint(simulator: str) -> None:
    """Record and train as `make demo` and `make libero` do, unless that is done."""
    if simulator == "libero":
        from benchmarks.libero.stages import dataset, policy

        policy(dataset(), "train")
    else:
        from benchmarks import common

        common.policy()


def main(names: list[str]) -> dict[str, str]:
    """Take the figures, then write the pages that quote them. Returns what is wrong with each, or "current".

    Raises:
        OpenSPMError: There are changes that are not committed, so that no result could say what it is of.
    """
    from benchmarks import tables

    _, dirty = code_version()
    if dirty is not False:
        raise OpenSPMError(
            f"figures are taken of a commit; commit the changes under {', '.join(MEASURED_CODE)}"
        )
    for name in names:
        take(name)
    tables.write_pages()
    return {
        name: origin(name, FIGURES[name].paths, expected_command=FIGURES[name].command).problem or "current"
        for name in names
    }


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of: {', '.join(FIGURES)}")
    chosen = parser.parse_args().names or takeable()
    if unknown := sorted(set(chosen) - set(FIGURES)):
        parser.error(f"no figures {', '.join(unknown)}; expected some of {', '.join(FIGURES)}")
    try:
        taken = main(chosen)
    except OpenSPMError as error:
        parser.error(str(error))
    print(json.dumps(taken))
    sys.exit(int(set(taken.values()) != {"current"}))
