"""Every published figure: the command that takes it, and the code that it measures.

    python -m benchmarks.figures                     # take all, unless current
    python -m benchmarks.figures tracking libero_goal   # take these, unless current

Those on LIBERO are left out of all where it is not installed. A figure `NAME` is kept as
``benchmarks/results/NAME.json``. A command that takes hours goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import json
import logging
import shlex
import subprocess
import sys
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

from benchmarks.results import MEASURED_CODE, code_version
from benchmarks.staleness import origin
from lerobot_openspm.cli.pipeline import LIBERO_ASSETS, RECORDED_BY
from lerobot_openspm.errors import OpenSPMError

logger = logging.getLogger(__name__)

PACKAGE = "src/lerobot_openspm"


def _package(*names: str) -> tuple[str, ...]:
    return tuple(f"{PACKAGE}/{name}" for name in names)


def _benchmarks(*names: str) -> tuple[str, ...]:
    return tuple(f"benchmarks/{name}.py" for name in names)


# What a policy does with its default options. Backends that need a download are not part of any figure.
POLICY = (
    *_package("control", "flow", "geometry", "language", "memory", "mining", "perception"),
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
RECORDING["libero"] = (*RECORDING["libero"], str(LIBERO_ASSETS))
STAGES = _benchmarks("stages", "processes")
TABLETOP = (
    *POLICY,
    *RECORDING["openspm_tabletop"],
    *_package("cli/options.py", "cli/pipeline.py"),
    *STAGES,
    "configs/openspm_tabletop_train.yaml",
    "configs/cameras/openspm_tabletop.json",
)
EPISODES = _benchmarks("episodes", "harness", "worlds")
LIBERO = (
    *POLICY,
    *RECORDING["libero"],
    *EPISODES,
    *_package("cli/options.py", "cli/pipeline.py"),
    *STAGES,
    *_benchmarks(
        "libero/contacts",
        "libero/evaluate",
        "libero/failures",
        "libero/pro_objects",
        "libero/variants",
    ),
    "configs/openspm_libero_train.yaml",
    "configs/cameras/libero.json",
)
DISTURBED = (*TABLETOP, *EPISODES, *_benchmarks("disturbances", "tracking"))
ALONG = (*EPISODES, *_benchmarks("perception", "truth"), *_package("bench"))
KEY_POSES = (
    *_package("geometry", "mining", "types.py", "memory/robot.py"),
    *_benchmarks("key_poses", "recording", "contact_events", "contact_sensor", "harness", "unsteady"),
    *STAGES,
)
LANGUAGE = (
    *_package("control", "geometry", "language", "memory", "mining", "types.py"),
    *_benchmarks("language", "taught_words"),
    "benchmarks/instructions",
)
MEMORY = (*_package("geometry", "language", "memory", "types.py"), *_benchmarks("memory", "synthetic"))
CALIBRATION = (
    *_package(
        "calibration", "geometry", "types.py", "memory/robot.py", "cli/calibrate.py", "cli/pipeline.py"
    ),
    *_package(*(f"mining/{name}.py" for name in ("columns", "dataset", "signals"))),
    *_benchmarks("calibration"),
    *STAGES,
)
NOISE = (*ALONG, *_benchmarks("measurement_noise"))
# As `make libero` types it; libero_goal is not named.
WHOLE_SUITE = "--demos=10 --states=50 --tasks=0-9"
OTHER_SUITES = ("libero_spatial", "libero_object", "libero_10")
SUITES = ("libero_goal", *OTHER_SUITES)
# 50 scenes of each of ten tasks, of libero_goal 10. With other kinds than all, the same scenes.
PLACES = {
    "libero_spatial": "--suite=libero_spatial",
    "libero_object": "--suite=libero_object",
    "libero_object_exchanged": "--suite=libero_object --exchanged=true",
    "libero_goal": "--suite=libero_goal --scenes=10",
    "libero_goal_patches": "--suite=libero_goal --scenes=10 --kinds=patches",
    "libero_goal_shape": "--suite=libero_goal --scenes=10 --kinds=shape",
    "libero_goal_exchanged": "--suite=libero_goal --exchanged=true --scenes=10",
    "libero_goal_exchanged_demos_3": "--suite=libero_goal --exchanged=true --demos=3 --scenes=10",
    "libero_goal_exchanged_demos_1": "--suite=libero_goal --exchanged=true --demos=1 --scenes=10",
    "libero_goal_exchanged_patches": "--suite=libero_goal --exchanged=true --scenes=10 --kinds=patches",
    "libero_goal_exchanged_shape": "--suite=libero_goal --exchanged=true --scenes=10 --kinds=shape",
}
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
    """

    command: str
    paths: tuple[str, ...]


def _figure(module: str, paths: tuple[str, ...], options: str = "") -> Figure:
    return Figure(f"python -m benchmarks.{module} {options}".strip(), paths)


def _libero(module: str, *own: str, options: str = "") -> Figure:
    return _figure(f"libero.{module}", (*LIBERO, *_benchmarks(f"libero/{module}", *own)), options)


def _with(figure: Figure, *paths: str) -> Figure:
    return replace(figure, paths=(*figure.paths, *paths))


ERRORS = ("libero/accuracy", "truth")
# The other suites' scenes get a copy of it that stands elsewhere.
ARM = "configs/arms/libero_panda.urdf"
COMPARISONS = (
    "tabletop",
    "execution",
    "oracle",
    "conditioning",
    "compound",
    "combinations",
    "preconditions",
    "two_bowls",
    "anywhere",
)
ON_LIBERO = "--env.type=libero"
FIGURES: dict[str, Figure] = {
    **{
        name: _figure(
            "tabletop",
            (*TABLETOP, *EPISODES, *_benchmarks("tabletop", "anywhere", "calls", "truth")),
            f"--comparison={name}",
        )
        for name in COMPARISONS
    },
    "perception_tabletop": _figure("perception", (*TABLETOP, *ALONG)),
    "tracking": _figure("tracking", DISTURBED, "--figure=tracking"),
    "cameras": _figure("tracking", DISTURBED, "--figure=cameras"),
    "teach": _figure("teach", (*TABLETOP, *EPISODES, *_benchmarks("teach"))),
    "keyposes_tabletop": _figure("key_poses", (*KEY_POSES, *RECORDING["openspm_tabletop"])),
    "language": _figure("language", LANGUAGE),
    "memory": _figure("memory", MEMORY),
    "measurement_noise": _figure("measurement_noise", (*TABLETOP, *NOISE)),
    "measurement_noise_libero": _figure("measurement_noise", (*LIBERO, *NOISE), ON_LIBERO),
    "libero_experts": _figure(
        "libero.experts", (*RECORDING["libero"], *STAGES, *_benchmarks("libero/experts"))
    ),
    **{name: _libero("run", *ERRORS, options=WHOLE_SUITE) for name in ("libero_goal", "libero_accuracy")},
    **{
        suite: _with(_libero("run", *ERRORS, options=f"--suite={suite} {WHOLE_SUITE}"), ARM)
        for suite in OTHER_SUITES
    },
    "libero_all": _with(_libero("run", *ERRORS, options=f"--suite=all {WHOLE_SUITE}"), ARM),
    **{
        suite: _figure(
            "libero_pro",
            (*LIBERO, *_benchmarks("libero_pro", *ERRORS)),
            f"--suite={suite} --states=50",
        )
        for suite in ("libero_goal_swap", "libero_goal_lan", "libero_goal_task", "libero_goal_object")
    },
    **{
        f"places_{name}": _libero("places", "libero/place_errors", "truth", "calls", options=options)
        for name, options in PLACES.items()
    },
    "wrong_calibration_libero": _libero(
        "wrong_calibration", "libero/places", "calls", "truth", "libero/place_errors"
    ),
    "libero_few_shot_3": _libero("few_shot", "libero/run", *ERRORS, options="--demos=3"),
    "libero_few_shot_1": _libero("few_shot", "libero/run", *ERRORS, options="--demos=1 --states=10"),
    **{
        f"{suite}_few_shot_3": _with(
            _libero("few_shot", "libero/run", *ERRORS, options=f"--suite={suite} --demos=3 --states=10"),
            ARM,
        )
        for suite in OTHER_SUITES
    },
    "libero_ablations": _with(
        _libero("ablations", "libero/geometric_guess", "libero/guessed_key_poses"),
        f"{PACKAGE}/mining/phase_labels",
    ),
    **{
        f"libero_new_task_{task}_3": _libero("new_task", "teach", options=f"--task={task}")
        for task in NEW_TASKS
    },
    "libero_losses": _libero("losses"),
    "libero_latency": _with(_libero("latency"), f"{PACKAGE}/bench"),
    **{
        f"{suite}_equality": _with(
            _libero("equality", "libero/run", *ERRORS, options=f"--suite={suite}"), ARM
        )
        for suite in SUITES
    },
    "perception_libero": _figure("perception", (*LIBERO, *ALONG), ON_LIBERO),
    "keyposes_libero": _figure("key_poses", (*KEY_POSES, *RECORDING["libero"]), ON_LIBERO),
    "calibration": _figure("calibration", (*CALIBRATION, *RECORDING["openspm_tabletop"])),
    "calibration_libero": _figure("calibration", (*CALIBRATION, *RECORDING["libero"]), ON_LIBERO),
}


def takeable() -> list[str]:
    """All figures, but for those on LIBERO where that is not installed; which these are is told."""
    if find_spec("libero") is not None:
        return list(FIGURES)
    left_out = [name for name, figure in FIGURES.items() if needs_libero(figure)]
    logger.warning("LIBERO is not installed; run: make libero-setup. Left out: %s", ", ".join(left_out))
    return [name for name in FIGURES if name not in left_out]


def needs_libero(figure: Figure) -> bool:
    """Whether a figure is taken on LIBERO, which is installed apart."""
    return "libero" in figure.command


def take(name: str) -> None:
    """Run a figure's command, unless its result is current. One that fails leaves the others to be taken."""
    figure = FIGURES[name]
    problem = origin(name, figure.paths, expected_command=figure.command).problem
    if problem is None:
        logger.info("%s is current", name)
        return
    logger.info("%s (%s): %s", name, problem, figure.command)
    try:
        program, *arguments = shlex.split(figure.command)
        subprocess.run([str(Path(sys.executable).with_name(program)), *arguments], check=True)
    except (subprocess.CalledProcessError, OSError) as error:
        logger.error("%s failed: %s", name, error)


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
