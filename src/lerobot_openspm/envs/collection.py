"""Recording scripted demonstrations of many tasks as one LeRobotDataset, by several processes."""

from __future__ import annotations

import contextlib
import json
import logging
import multiprocessing
import queue
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lerobot_openspm.envs.dataset import (
    create_dataset,
    merge,
    quiet_libraries,
    resume_dataset,
    video_encoder,
    write_episode,
)
from lerobot_openspm.envs.recording import Suite, record
from lerobot_openspm.envs.seeds import DEMO_SEED_START, require_demo_seeds
from lerobot_openspm.envs.suites import find_suite, whole_suite
from lerobot_openspm.files import write_json

logger = logging.getLogger(__name__)

SUMMARY_FILE = "meta/openspm_collect.json"
# Marks a task's part as complete, or as interrupted between two episodes; what a folder of parts is made for.
PART_FILE, INTERRUPTED_FILE = "meta/openspm_part.json", "meta/openspm_interrupted.json"
PARTS_FILE = "openspm_collect.json"
# Every task has its own stretch of seeds, so that no two tasks show the same initial states.
SEEDS_PER_TASK = 10_000
# An expert that fails more often than this is broken, and collecting on would only hide it.
MAX_DISCARDED_SHARE = 0.5


@dataclass
class SimulatorConfig:
    """Which simulator, and which of its tasks."""

    type: str = "openspm_tabletop"  # or libero
    # A task name, a comma list of them, or "all"; of libero also a suite, and "all" is libero_goal.
    task: str = "all"

    def suite(self) -> Suite:
        """What the tasks are of."""
        return find_suite(self.type, self.task)


@dataclass
class CollectConfig:
    """Record scripted demonstrations on the tabletop or on LIBERO as a LeRobotDataset."""

    env: SimulatorConfig = field(default_factory=SimulatorConfig)
    episodes: int = 10  # per task
    root: str | None = None  # output folder; default: LeRobot's home folder / repo_id
    repo_id: str = ""  # default: local/ and the name of the simulator
    seed: int = DEMO_SEED_START  # first demonstration seed; each task takes its own stretch from here on
    height: int = 256
    width: int = 256
    vcodec: str = "h264"
    pix_fmt: str = (
        "yuv444p"  # full colour resolution; yuv420p plays in every browser but smears colours at edges
    )
    crf: int = 16  # lower keeps colours better
    workers: int = 2  # processes that record, a task each at a time; 0 records in this one
    overwrite: bool = False  # replace an existing dataset at `root`

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}")
        if min(self.height, self.width) < 64:
            raise ValueError(f"images must have at least 64 pixels a side, got {self.height} x {self.width}")
        if self.workers < 0:
            raise ValueError(f"workers must not be negative, got {self.workers}")
        suite = self.env.suite()
        recorded, selected = suite.tasks("all"), suite.tasks(self.env.task)
        if other := [task for task in selected if task not in recorded]:
            raise ValueError(f"no expert records {', '.join(other)}; expected some of {', '.join(recorded)}")
        if selected == recorded:
            # However they are named, the dataset is the same.
            self.env = replace(self.env, task=whole_suite(self.env.type, self.env.task))
        require_demo_seeds(self.seed, SEEDS_PER_TASK * len(recorded))
        self.repo_id = self.repo_id or f"local/{suite.name}"

    def settings(self) -> dict[str, Any]:
        """What decides about a dataset's content."""
        return {k: value for k, value in asdict(self).items() if k not in ("root", "workers", "overwrite")}

    def folder(self) -> Path:
        """Where the dataset goes."""
        if self.root is not None:
            return Path(self.root).expanduser().resolve()
        from lerobot.utils.constants import HF_LEROBOT_HOME

        return (HF_LEROBOT_HOME / self.repo_id).resolve()


def collect(config: CollectConfig) -> dict[str, Any]:
    """Record the demonstrations and return {"episodes", "frames", "discarded", "root", "seconds"}.

    Every task is recorded as a dataset of its own beside `root`; when all are there they are merged and moved
    to their place. A recording that Ctrl-C interrupted goes on with the episode that was being recorded; one
    that was killed goes on with the tasks that were not complete. A complete one with the same settings is
    left alone.

    Raises:
        FileExistsError: `root` holds something that this command did not write, or wrote with other settings.
        RuntimeError: The expert failed too often.
    """
    start_s, root = time.monotonic(), config.folder()
    if root.exists() and not (root / SUMMARY_FILE).is_file():
        raise FileExistsError(f"{root} exists and was not written by openspm collect; choose another --root")
    if root.exists() and not config.overwrite:
        return _keep_existing(config, root)
    partial = root.with_name(root.name + ".partial")
    parts, merged = _open_parts(config, partial), partial / "merged"
    _record_parts(config, {task: part for task, part in parts.items() if not (part / PART_FILE).is_file()})
    records = [json.loads((part / PART_FILE).read_text(encoding="utf-8")) for part in parts.values()]
    merge(config.repo_id, list(parts.values()), merged)
    episodes, discarded = ([e for r in records for e in r[kind]] for kind in ("episodes", "discarded"))
    summary = {
        "episodes": len(episodes),
        "frames": sum(e["steps"] for e in episodes),
        "discarded": len(discarded),
        "root": str(root),
        "seconds": round(time.monotonic() - start_s, 1),
    }
    document = {"summary": summary, "settings": config.settings()}
    write_json(merged / SUMMARY_FILE, {**document, "episodes": episodes, "discarded": discarded})
    calibration = config.env.suite().calibration(config.height, config.width, config.env.task)
    if calibration is None:
        logger.warning(
            "%s has no meta/openspm_cameras.json: the cameras do not stand alike in all of its tasks", root
        )
    else:
        write_json(merged / "meta/openspm_cameras.json", calibration)
    if root.exists():
        shutil.rmtree(root)
    merged.rename(root)
    shutil.rmtree(partial)
    return summary


def _keep_existing(config: CollectConfig, root: Path) -> dict[str, Any]:
    """Leave a complete dataset alone and say what is there."""
    recorded = json.loads((root / SUMMARY_FILE).read_text(encoding="utf-8"))
    summary, kept, asked = recorded["summary"], recorded.get("settings", {}), config.settings()
    if differing := [key for key in asked if kept.get(key) != asked[key]]:
        details = "; ".join(f"{key} is {kept.get(key)}, asked was {asked[key]}" for key in differing)
        raise FileExistsError(
            f"{root} was recorded with other settings: {details}. Choose another --root, or pass "
            "--overwrite=true"
        )
    print(
        f"{root} already holds {summary['episodes']} episodes; left alone "
        "(pass --overwrite=true to record again)"
    )
    return {**summary, "root": str(root)}


def _open_parts(config: CollectConfig, partial: Path) -> dict[str, Path]:
    """Folders of the tasks' parts, by task; what other settings left there is discarded."""
    settings, made_for = config.settings(), partial / PARTS_FILE
    if partial.exists() and not made_for.is_file():
        raise FileExistsError(
            f"{partial} was not written by openspm collect; move it, or choose another --root"
        )
    if partial.exists() and json.loads(made_for.read_text(encoding="utf-8")) != settings:
        logger.info("%s was being recorded with other settings; recording anew", partial)
        shutil.rmtree(partial)
    if not partial.exists():
        partial.mkdir(parents=True)
        write_json(made_for, settings)
    parts = {task: partial / task for task in config.env.suite().tasks(config.env.task)}
    if kept := [task for task, part in parts.items() if (part / PART_FILE).is_file()]:
        logger.info("keeping what was recorded before an interruption: %s", ", ".join(kept))
    return parts


def _record_parts(config: CollectConfig, parts: Mapping[str, Path]) -> None:
    """Record tasks, several at a time, with a progress bar over their episodes."""
    with tqdm(total=len(parts) * config.episodes, desc="episodes", unit="ep") as bar:

        def show(task: str) -> None:
            bar.set_postfix(task=task)
            bar.update()

        if config.workers == 0:
            for task, part in parts.items():
                record_part(config, task, part, show)
            return
        context = multiprocessing.get_context("spawn")
        with context.Manager() as manager, ProcessPoolExecutor(config.workers, context) as pool:
            recorded = manager.Queue()
            running = [
                pool.submit(record_part, config, task, part, recorded.put) for task, part in parts.items()
            ]
            try:
                _watch(running, recorded, show)
            finally:
                pool.shutdown(cancel_futures=True)


def _watch(running: Sequence[Future], recorded: queue.Queue[str], show: Callable[[str], None]) -> None:
    """Show recorded episodes until every part is done. Raises what the first failed part raised."""
    left = True
    while left:
        done, left = wait(running, timeout=0.5, return_when=FIRST_EXCEPTION)
        for future in done:
            future.result()
        with contextlib.suppress(queue.Empty):
            while True:
                show(recorded.get_nowait())


def record_part(config: CollectConfig, task: str, root: Path, done: Callable[[str], None]) -> None:
    """Record one task's demonstrations as a dataset; ``done`` is called with the task after each.

    Failed attempts are made up for with further seeds.

    Raises:
        RuntimeError: The expert failed too often.
    """
    suite, size = config.env.suite(), (config.height, config.width)
    encoder = video_encoder(config.vcodec, config.pix_fmt, config.crf)
    interrupted, attempts = root / INTERRUPTED_FILE, {"episodes": [], "discarded": []}
    with quiet_libraries(), contextlib.closing(suite.scene(task, *size)) as scene:
        if interrupted.is_file():
            attempts = json.loads(interrupted.read_text(encoding="utf-8"))
            dataset = resume_dataset(config.repo_id, root, encoder)
            interrupted.unlink()
        else:
            shutil.rmtree(root, ignore_errors=True)
            dataset = create_dataset(suite, config.repo_id, root, size, encoder)
        kept, discarded = attempts["episodes"], attempts["discarded"]
        first_seed = config.seed + SEEDS_PER_TASK * suite.tasks("all").index(task)
        for _ in kept:
            done(task)
        while len(kept) < config.episodes:
            try:
                episode = record(scene, task, first_seed + len(kept) + len(discarded))
            except KeyboardInterrupt:
                if kept:
                    dataset.finalize()
                    write_json(interrupted, attempts)
                raise
            (kept if episode.success else discarded).append(episode.about())
            if episode.success:
                write_episode(dataset, episode)
                done(task)
            elif len(discarded) > 3 + MAX_DISCARDED_SHARE * config.episodes:
                raise RuntimeError(
                    f"the expert failed {len(discarded)} times on {task}, where {config.episodes} episodes "
                    "were wanted; this task was not kept"
                )
        dataset.finalize()
    write_json(root / PART_FILE, attempts)
