"""`openspm bench ...`: what is measured in the simulators, resumably; and where the other measures are."""

from __future__ import annotations

import importlib
import importlib.util
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_openspm.bench.results import ResultOption, write_result
from lerobot_openspm.bench.workers import each
from lerobot_openspm.envs.gl_backend import set_default_gl_backend
from lerobot_openspm.envs.tabletop.tasks import select_tasks
from lerobot_openspm.errors import OpenSPMError

logger = logging.getLogger(__name__)

# Where `make demo` and `make libero` leave their checkpoints and demonstrations, and what those are called.
DEFAULTS = {
    "openspm_tabletop": ("outputs/demo/demos_10", "local/openspm_tabletop"),
    "libero": ("outputs/libero/demos_10", "local/libero"),
}
CHECKPOINT = "train/checkpoints/last/pretrained_model"
# Seeds of evaluation that no success rate was taken on.
SEED = 5000


@dataclass
class EnvironmentOption:
    """Where to measure."""

    type: str = "openspm_tabletop"  # openspm_tabletop, or libero (its suite libero_goal)
    task: str = "all"  # a task name, a comma list of them, or "all"


@dataclass
class PolicyOption:
    """What to measure."""

    path: str | None = None  # default: the checkpoint that `make demo` or `make libero` left


@dataclass
class DatasetOption:
    """The demonstrations, whose simulator poses tell where on each object its learned frame stands."""

    root: str | None = None  # default: those of `make demo` or `make libero`
    repo_id: str | None = None


@dataclass
class BenchConfig(ResultOption):
    """Measure a checkpoint in a simulator."""

    env: EnvironmentOption = field(default_factory=EnvironmentOption)
    policy: PolicyOption = field(default_factory=PolicyOption)
    dataset: DatasetOption = field(default_factory=DatasetOption)
    episodes: int = 100  # in all, the tasks in turn; for tracking and cameras, of each kind
    seed: int = SEED  # of the first scene of every task
    workers: int = 2  # episodes at a time, each in a process of its own
    output: str | None = None  # folder for what was measured; default: outputs/bench/<what>_<env.type>

    def __post_init__(self) -> None:
        if self.env.type not in DEFAULTS:
            raise ValueError(f"env.type is {self.env.type!r}, expected one of {', '.join(DEFAULTS)}")
        if self.env.type == "libero" and importlib.util.find_spec("libero") is None:
            raise ValueError("env.type=libero needs LIBERO; install it with: pip install 'lerobot[libero]'")
        if self.env.type == "openspm_tabletop":
            select_tasks(self.env.task)
        if self.episodes < 1 or self.workers < 1:
            raise ValueError(
                f"episodes and workers must be at least 1, got {self.episodes} and {self.workers}"
            )

    @property
    def checkpoint(self) -> Path:
        """Folder of the checkpoint. Raises FileNotFoundError when there is none."""
        path = Path(self.policy.path or Path(DEFAULTS[self.env.type][0]) / CHECKPOINT)
        if not (path / "memory.json").is_file():
            make = "make demo" if self.env.type == "openspm_tabletop" else "make libero"
            raise FileNotFoundError(f"no checkpoint of this policy at {path}; pass --policy.path, or {make}")
        return path

    @property
    def demonstrations(self) -> Path:
        """Folder of the demonstrations."""
        return Path(self.dataset.root or Path(DEFAULTS[self.env.type][0]) / "dataset")

    def folder(self, what: str) -> Path:
        """Where results go; what was measured of other code or another checkpoint is discarded."""
        from lerobot_openspm.cli.pipeline import digest, measured_folder

        files = [self.checkpoint / name for name in ("model.safetensors", "memory.json")]
        options = [what, self.env.type, *([str(self.demonstrations)] if what == "perception" else [])]
        folder = Path(self.output or f"outputs/bench/{what}_{self.env.type}")
        return measured_folder(folder, digest(files, options))


def perception(config: BenchConfig) -> dict[str, Any]:
    """Errors of the poses that are followed, and what perception and the filter cost."""
    from lerobot_openspm.bench import perception as measure

    setting = measure.Setting(
        config.env.type, str(config.checkpoint), str(config.demonstrations),
        config.dataset.repo_id or DEFAULTS[config.env.type][1],
    )  # fmt: skip
    if not (config.demonstrations / "meta/info.json").is_file():
        raise FileNotFoundError(f"no demonstrations at {setting.dataset}; pass --dataset.root")
    folder = config.folder("perception")
    tasks = measure.tasks(config.env.type, config.env.task)
    jobs = [(tasks[i % len(tasks)], config.seed + i // len(tasks)) for i in range(config.episodes)]
    left = [job for job in jobs if not measure.file_of(folder, *job).is_file()]
    for _ in each(config.workers, measure.run, [(setting, folder, *job) for job in left]):
        pass  # each writes its own file
    samples = measure.read(folder, jobs)
    return {**measure.summarise(samples), **measure.costs(setting), "episodes": len(jobs)}


def tracking(config: BenchConfig) -> dict[str, Any]:
    """Success where objects are displaced or dropped, with and without tracking."""
    from lerobot_openspm.bench import tracking as measure

    found = _disturbed(config, "tracking", measure.TRACKING)
    n = min(one["n"] for one in found.values())
    return {**{f"success_{name}": one["success"] for name, one in found.items()}, "n": n, "conditions": found}


def cameras(config: BenchConfig) -> dict[str, Any]:
    """Success where the cameras stand elsewhere and their calibration says so."""
    from lerobot_openspm.bench import tracking as measure

    found = _disturbed(config, "cameras", measure.CAMERAS)
    n = min(one["n"] for one in found.values())
    return {**{f"success_{name}": one["success"] for name, one in found.items()}, "n": n, "conditions": found}


def _disturbed(config: BenchConfig, what: str, conditions: Sequence[Any]) -> dict[str, Any]:
    from lerobot_openspm.bench import tracking as measure

    if config.env.type != "openspm_tabletop":
        raise OpenSPMError(f"bench {what} disturbs the tabletop alone, got env.type={config.env.type}")
    log = config.folder(what) / "episodes.jsonl"
    checkpoint = str(config.checkpoint)
    jobs = measure.jobs(conditions, config.env.task, config.episodes, config.seed)
    done = measure.read(log)
    left = [(checkpoint, *job) for job in jobs if (job[0].name, *job[1:]) not in done]
    for result in each(config.workers, measure.run, left):
        measure.write_line(log, result)
    done = measure.read(log)
    return measure.summarise([done[condition.name, task, seed] for condition, task, seed in jobs])


# Measures of a checkpoint in a simulator, which share their options.
MEASURES: dict[str, Callable[[BenchConfig], dict[str, Any]]] = {
    "perception": perception,
    "tracking": tracking,
    "cameras": cameras,
}
# Measures with options of their own: a module with a dataclass `Options`, a `ResultOption`, and
# `measure(options)`, which returns what is printed. Imported when it is asked for.
ON_THEIR_OWN: dict[str, str] = {
    "keyposes": "lerobot_openspm.bench.key_poses",
    "language": "lerobot_openspm.bench.language",
    "memory": "lerobot_openspm.bench.memory",
    "teach": "lerobot_openspm.bench.teach",
}


def main(args: Sequence[str] | None = None) -> None:
    """Parse the arguments (default: the command line's), measure, print one JSON object last."""
    import sys

    import draccus

    what, *options = list(sys.argv[1:] if args is None else args) or [""]
    known = [*MEASURES, *ON_THEIR_OWN]
    if what not in known:
        raise OpenSPMError(f"bench what? got {what!r}, expected one of {', '.join(known)}")
    set_default_gl_backend()
    if what in MEASURES:
        options_class, measure = BenchConfig, MEASURES[what]
    else:
        module = importlib.import_module(ON_THEIR_OWN[what])
        options_class, measure = module.Options, module.measure
    config = draccus.parse(config_class=options_class, args=options)
    measured = measure(config)
    if config.result:
        # Policies act on one thread, in this process or in others.
        threads = 1 if what in (*MEASURES, "teach") else None
        write_result(Path(config.result), {"seed": getattr(config, "seed", None), **measured}, threads)
    print(json.dumps(measured))
