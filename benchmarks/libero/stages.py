"""The stages that LIBERO's benchmarks share, each run once: demonstrations, policies, evaluations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.common import known
from benchmarks.libero.evaluate import EvaluationConfig, evaluate

from lerobot_openspm.cli.pipeline import collect_dataset, train
from lerobot_openspm.envs.collection import SUMMARY_FILE
from lerobot_openspm.envs.libero.simulator import tasks
from lerobot_openspm.types import Execution

REPO_ID = "local/libero"
TRAIN_CONFIG = Path("configs/openspm_libero_train.yaml")
# The demonstrations of the published figures; whoever asks for fewer takes the first of them.
DEMOS, STATES = 10, 50


def run_folder(demos: int = DEMOS, selected: Sequence[str] | None = None) -> Path:
    """Where everything made of so many demonstrations a task lies; a part of the tasks has its own folder."""
    names = list(tasks())
    chosen = names if selected is None else list(selected)
    some = "" if chosen == names else "_tasks_" + "_".join(str(names.index(task)) for task in chosen)
    return Path("outputs/libero") / f"demos_{demos}{some}"


def select_tasks(selection: str) -> list[str]:
    """Tasks by their numbers: "0-9", or "0,3,5-6".

    Raises:
        ValueError: There is no such task.
    """
    names = list(tasks())
    chosen: list[int] = []
    for part in selection.split(","):
        first, dash, last = part.strip().partition("-")
        last = last if dash else first
        numbers = first.isdecimal() and last.isdecimal()
        if not numbers or not int(first) <= int(last) < len(names):
            raise ValueError(
                f"TASKS must be numbers and ascending ranges from 0 to {len(names) - 1}, like 0-9 or 0,3,5, "
                f"got {selection}; they stand for {', '.join(f'{i} {name}' for i, name in enumerate(names))}"
            )
        chosen += range(int(first), int(last) + 1)
    return [names[i] for i in dict.fromkeys(chosen)]


def dataset(demos: int = DEMOS, selected: Sequence[str] | None = None) -> Path:
    """The demonstrations, recorded if need be."""
    root = run_folder(demos, selected) / "dataset"
    names = ",".join(selected) if selected and list(selected) != list(tasks()) else "all"
    collect_dataset(root, demos, "libero", names)
    return root


def first_episodes(root: Path, demos: int, without: str | None = None) -> list[int]:
    """Episode numbers of the first demonstrations of every task, but for one that is left out."""
    recorded = json.loads((root / SUMMARY_FILE).read_text())["episodes"]
    numbers: dict[str, list[int]] = {}
    for number, episode in enumerate(recorded):
        numbers.setdefault(episode["task"], []).append(number)
    return [n for task, own in numbers.items() if task != without for n in own[:demos]]


def policy(
    root: Path, variant: str, *options: str, episodes: Sequence[int] | None = None
) -> tuple[Path, float | None]:
    """Checkpoint and seconds of a variant, mined and trained if need be; None if that was interrupted.

    Args:
        root: The demonstrations.
        variant: Name of its folder beside them.
        options: Further options of lerobot-train.
        episodes: The demonstrations that may be learned from; all if not given.
    """
    if episodes is not None:
        chosen = json.dumps(list(episodes))
        options = (f"--dataset.episodes={chosen}", f"--policy.memory_episodes={chosen}", *options)
    options = (f"--dataset.repo_id={REPO_ID}", *options)
    checkpoint, seconds = train(root, root.with_name(variant), options, TRAIN_CONFIG)
    return checkpoint, known(seconds)


def evaluation(
    name: Path,
    checkpoint: Path,
    states: int = STATES,
    selected: Sequence[str] | None = None,
    execution: Execution | None = None,
) -> list[dict[str, Any]]:
    """Episodes on the benchmark's initial states, run if need be."""
    names = ",".join(selected) if selected else "all"
    return evaluate(EvaluationConfig(str(checkpoint), str(name), names, episodes=states, execution=execution))
