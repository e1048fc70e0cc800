"""The stages that benchmarks share, each run once: demonstrations and policies.

They lie where `make demo` and `make libero` leave theirs, and are made by whichever comes first.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.processes import watched_memory
from lerobot_openspm.cli.options import require_checkpoint
from lerobot_openspm.cli.pipeline import DONE, TRAIN_CONFIG, collect_dataset, train
from lerobot_openspm.envs.collection import SUMMARY_FILE
from lerobot_openspm.envs.suites import find_suite, whole_suite
from lerobot_openspm.files import write_beside, write_json

# The demonstrations a task of the published figures; whoever asks for fewer takes the first of them.
DEMOS = 10
TABLETOP, LIBERO = "openspm_tabletop", "libero"
RUNS = {TABLETOP: Path("outputs/demo"), LIBERO: Path("outputs/libero")}
TRAIN_CONFIGS = {TABLETOP: TRAIN_CONFIG, LIBERO: Path("configs/openspm_libero_train.yaml")}
# LIBERO's, as it stands in libero_goal.
ARM = Path("configs/arms/libero_panda.urdf")
# Beside a training's checkpoints: how much memory it took.
PEAK = "peak_memory.json"


@dataclass
class EnvironmentOption:
    """Where to measure.

    Args:
        type: openspm_tabletop, or libero.
        task: A task's name, several with commas, or "all"; of libero also a suite, "all" is libero_goal.
    """

    type: str = TABLETOP
    task: str = "all"

    def __post_init__(self) -> None:
        self.tasks()

    @property
    def suffix(self) -> str:
        """What a figure's name ends with where it is taken in this simulator too."""
        return "" if self.type == TABLETOP else f"_{self.type}"

    def tasks(self) -> list[str]:
        """Names of the tasks. Raises ValueError if there is no such simulator or task."""
        return find_suite(self.type, self.task).tasks(self.task)

    def dataset(self) -> Path:
        """The demonstrations of all tasks of the suite, recorded if need be."""
        return dataset(self.type, selection=whole_suite(self.type, self.task))


@dataclass
class PolicyOption:
    """What to measure; the checkpoint that `make demo` or `make libero` leaves if not given."""

    path: str | None = None


@dataclass
class DatasetOption:
    """The demonstrations; those of `make demo` or `make libero` if not given."""

    root: str | None = None


@dataclass
class EpisodesConfig:
    """Options of a benchmark that runs episodes in a simulator.

    Args:
        env: The simulator and its tasks.
        episodes: In all, the tasks in turn; of each kind, where there are kinds.
        seed: Of the first scene of every task.
        workers: Episodes at a time, each in a process of its own.
    """

    env: EnvironmentOption = field(default_factory=EnvironmentOption)
    episodes: int = 100
    seed: int = 5000  # no success rate was taken on these
    workers: int = 2

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.workers < 1:
            raise ValueError(
                f"episodes and workers must be at least 1, got {self.episodes} and {self.workers}"
            )

    def turns(self, tasks: Sequence[str] | None = None) -> list[tuple[str, int]]:
        """Task and seed of every episode: the selected tasks, or those given, in turn from the same seeds."""
        names = self.env.tasks() if tasks is None else tasks
        return [(names[i % len(names)], self.seed + i // len(names)) for i in range(self.episodes)]


@dataclass
class CheckpointConfig(EpisodesConfig):
    """Options of a benchmark that runs a checkpoint in a simulator.

    Args:
        policy: The checkpoint.
        output: Folder for what is measured; outputs/bench/NAME_SIMULATOR if not given.
    """

    policy: PolicyOption = field(default_factory=PolicyOption)
    output: str | None = None

    def checkpoint(self) -> Path:
        """The checkpoint, trained if it is the default one. Raises FileNotFoundError when there is none."""
        if self.policy.path is None:
            return policy(self.env.type, selection=whole_suite(self.env.type, self.env.task))[0]
        require_checkpoint(Path(self.policy.path), "--policy.path")
        return Path(self.policy.path)

    def folder(self, name: str) -> Path:
        """Where what is measured goes."""
        return Path(self.output or f"outputs/bench/{name}_{self.env.type}")


def run_folder(simulator: str, demos: int = DEMOS, selection: str = "all") -> Path:
    """Where everything made of so many demonstrations a task lies; a part of the tasks has its own folder.

    Args:
        simulator: As --env.type takes it.
        demos: Of each task.
        selection: The tasks, as --env.task takes them.
    """
    suite = find_suite(simulator, selection)
    names, chosen = suite.tasks("all"), suite.tasks(selection)
    some = "" if chosen == names else "_tasks_" + "_".join(str(names.index(task)) for task in chosen)
    of_suite = "" if suite.name == simulator else suite.name
    return RUNS[simulator] / of_suite / f"demos_{demos}{some}"


def dataset(simulator: str, demos: int = DEMOS, selection: str = "all") -> Path:
    """The demonstrations, recorded if need be; see :func:`run_folder`."""
    root = run_folder(simulator, demos, selection) / "dataset"
    collect_dataset(root, demos, simulator, selection)
    return root


def policy(
    simulator: str,
    variant: str = "train",
    *options: str,
    root: Path | None = None,
    episodes: Sequence[int] | None = None,
    selection: str = "all",
) -> tuple[Path, float | None]:
    """Checkpoint and seconds of a variant, mined and trained if need be.

    Args:
        simulator: Where it was demonstrated.
        variant: Name of its folder beside the demonstrations.
        options: Further options of lerobot-train.
        root: The demonstrations; those of the published figures if not given.
        episodes: The demonstrations that may be learned from; all if not given.
        selection: The tasks that were demonstrated, as --env.task takes them.

    Returns:
        The seconds are None if the training was interrupted: how long it took in all is not known.
    """
    root = dataset(simulator, selection=selection) if root is None else root
    if find_suite(simulator, selection).name != simulator:
        options = (*_as_its_scenes(root, find_suite(simulator, selection).tasks(selection)[0]), *options)
    if episodes is not None:
        chosen = json.dumps(list(episodes))
        options = (f"--dataset.episodes={chosen}", f"--policy.memory_episodes={chosen}", *options)
    output = root.with_name(variant)
    before = _done_ns(output)
    with watched_memory() as peaks:
        made = train(root, output, options, TRAIN_CONFIGS[simulator])
    if made[1] is not None and peaks and _done_ns(output) != before:
        write_json(output / PEAK, {"peak_mb": round(max(peaks.values()) / 1e6)})
    return made


def _done_ns(output: Path) -> int | None:
    """When a training was finished; None if it was not."""
    done = output / DONE
    return done.stat().st_mtime_ns if done.exists() else None


def peak_mb(checkpoint: Path) -> int | None:
    """The most memory that a process of a checkpoint's training had (RSS), MB; None if that is not known."""
    noted = checkpoint.parents[2] / PEAK
    return json.loads(noted.read_text())["peak_mb"] if noted.is_file() else None


def _as_its_scenes(root: Path, task: str) -> tuple[str, str]:
    """The options by which the cameras and the arm stand as in the scenes of a task of LIBERO."""
    from lerobot_openspm.envs.libero.simulator import LiberoSimulator

    simulator = LiberoSimulator(task)
    simulator.reset(0)
    place = " ".join(f"{x:.6g}" for x in simulator.body_pose("robot0_base")[:3, 3])
    simulator.close()
    urdf = re.sub(r'(<joint name="base".*?<origin xyz=")[^"]*', rf"\g<1>{place}", ARM.read_text(), flags=re.S)
    arm = root.with_name("arm.urdf")
    write_beside(arm, urdf.encode())
    return f"--policy.cameras={root}/meta/openspm_cameras.json", f"--policy.arm={arm}"


def first_episodes(root: Path, demos: int, without: str | None = None) -> list[int]:
    """Episode numbers of the first demonstrations of every task, but for one that is left out."""
    numbers = demonstrations_of(root)
    return [n for task, own in numbers.items() if task != without for n in own[:demos]]


def demonstrations_of(root: Path) -> dict[str, list[int]]:
    """Numbers of the recorded episodes by task, in their order."""
    numbers: dict[str, list[int]] = {}
    for number, episode in enumerate(json.loads((root / SUMMARY_FILE).read_text())["episodes"]):
        numbers.setdefault(episode["task"], []).append(number)
    return numbers
