"""`openspm collect`: record scripted demonstrations on the tabletop or on LIBERO as a LeRobotDataset."""

import contextlib
import json
import logging
import multiprocessing
import queue
import shutil
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_openspm.envs.recording import source
from lerobot_openspm.envs.seeds import DEMO_SEED_START, require_demo_seeds
from lerobot_openspm.files import write_json

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_openspm.envs.recording import RecordedEpisode

logger = logging.getLogger(__name__)

SUMMARY_FILE = "meta/openspm_collect.json"
# Marks a task's part as complete, and what a folder of parts is being made for.
PART_FILE, PARTS_FILE = "meta/openspm_part.json", "openspm_collect.json"
FPS = 20
# Every task has its own stretch of seeds, so that no two tasks show the same initial states.
SEEDS_PER_TASK = 10_000
# An expert that fails more often than this is broken, and collecting on would only hide it.
MAX_DISCARDED_SHARE = 0.5


@dataclass
class SimulatorConfig:
    """Which simulator, and which of its tasks."""

    type: str = "openspm_tabletop"  # openspm_tabletop, or libero (its suite libero_goal)
    task: str = "all"  # a task name, a comma list of them, or "all"


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
        recorded = source(self.env.type)
        recorded.tasks(self.env.task)
        require_demo_seeds(self.seed, SEEDS_PER_TASK * len(recorded.all_tasks()))
        self.repo_id = self.repo_id or f"local/{self.env.type}"


def collect(config: CollectConfig) -> dict[str, Any]:
    """Record the demonstrations and return {"episodes", "frames", "discarded", "root", "seconds"}.

    Every task is recorded as a dataset of its own beside `root`; when all are there they are merged and moved
    to their place. An interrupted recording goes on with the tasks that were not complete.

    Raises:
        FileExistsError: `root` holds something that this command did not write.
        RuntimeError: The expert failed too often.
    """
    start_s = time.monotonic()
    root = _root(config)
    if root.exists() and not (root / SUMMARY_FILE).is_file():
        raise FileExistsError(f"{root} exists and was not written by openspm collect; choose another --root")
    if root.exists() and not config.overwrite:
        return _keep_existing(config, root)
    partial = root.with_name(root.name + ".partial")
    parts = _open_parts(config, partial)
    _record_parts(config, {task: part for task, part in parts.items() if not (part / PART_FILE).is_file()})
    records = [json.loads((part / PART_FILE).read_text(encoding="utf-8")) for part in parts.values()]
    merged = _merge(config, list(parts.values()), partial / "merged")
    episodes, discarded = ([e for r in records for e in r[kind]] for kind in ("episodes", "discarded"))
    summary = {
        "episodes": len(episodes),
        "frames": sum(e["steps"] for e in episodes),
        "discarded": len(discarded),
        "root": str(root),
        "seconds": round(time.monotonic() - start_s, 1),
    }
    document = {"summary": summary, "settings": _settings(config)}
    _write_meta(config, merged, {**document, "episodes": episodes, "discarded": discarded})
    if root.exists():
        shutil.rmtree(root)
    merged.rename(root)
    shutil.rmtree(partial)
    return summary


def _root(config: CollectConfig) -> Path:
    if config.root is not None:
        return Path(config.root).expanduser().resolve()
    from lerobot.utils.constants import HF_LEROBOT_HOME

    return (HF_LEROBOT_HOME / config.repo_id).resolve()


def _keep_existing(config: CollectConfig, root: Path) -> dict[str, Any]:
    """Leave a complete dataset alone and say what is there."""
    recorded = json.loads((root / SUMMARY_FILE).read_text(encoding="utf-8"))
    summary, kept, asked = recorded["summary"], recorded.get("settings", {}), _settings(config)
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


def _features(config: CollectConfig) -> dict[str, dict]:
    recorded = source(config.env.type)

    def count(names: Any) -> int:
        return sum(map(len, names.values())) if isinstance(names, Mapping) else len(names)

    video = {
        "dtype": "video",
        "shape": (config.height, config.width, 3),
        "names": ["height", "width", "channels"],
    }
    return {
        **{f"observation.images.{name}": dict(video) for name in recorded.cameras},
        **{
            key: {"dtype": "float32", "shape": (count(names),), "names": names}
            for key, names in recorded.names.items()
        },
    }


def _create_dataset(config: CollectConfig, root: Path) -> "LeRobotDataset":
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    presets = {"h264": "veryfast", "libsvtav1": 10}
    return LeRobotDataset.create(
        repo_id=config.repo_id,
        fps=FPS,
        features=_features(config),
        root=root,
        robot_type=source(config.env.type).robot_type,
        use_videos=True,
        # Nothing is read back here; naming a decoder spares the search for another one.
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(
            vcodec=config.vcodec, pix_fmt=config.pix_fmt, crf=config.crf, preset=presets.get(config.vcodec)
        ),
        streaming_encoding=True,
        # A full queue drops frames; one that holds the longest episode never is.
        encoder_queue_maxsize=1000,
        encoder_threads=1,
    )


@contextlib.contextmanager
def _quiet_libraries() -> Generator[None]:
    """Keep the encoder's, the table writer's and the merging's messages away from the progress bar."""
    import av.logging
    import datasets

    merging = logging.getLogger("lerobot.datasets.aggregate")
    merging_level, level, bars = merging.level, av.logging.get_level(), datasets.are_progress_bars_disabled()
    merging.setLevel(logging.WARNING)
    av.logging.set_libav_level(av.logging.ERROR)
    datasets.disable_progress_bars()
    try:
        yield
    finally:
        merging.setLevel(merging_level)
        av.logging.set_libav_level(level if level is not None else av.logging.INFO)
        if not bars:
            datasets.enable_progress_bars()


def _settings(config: CollectConfig) -> dict[str, Any]:
    """What decides about a dataset's content."""
    return {
        key: value for key, value in asdict(config).items() if key not in ("root", "workers", "overwrite")
    }


def _open_parts(config: CollectConfig, partial: Path) -> dict[str, Path]:
    """Folders of the tasks' parts, by task; what other settings left there is discarded."""
    settings = _settings(config)
    made_for = partial / PARTS_FILE
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
    parts = {task: partial / task for task in source(config.env.type).tasks(config.env.task)}
    if kept := [task for task, part in parts.items() if (part / PART_FILE).is_file()]:
        logger.info("keeping what was recorded before an interruption: %s", ", ".join(kept))
    return parts


def _record_parts(config: CollectConfig, parts: Mapping[str, Path]) -> None:
    """Record tasks, several at a time, with a progress bar over their episodes."""
    from tqdm import tqdm

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


def _watch(running: Sequence[Future], recorded: "queue.Queue[str]", show: Callable[[str], None]) -> None:
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
    recorded = source(config.env.type)
    shutil.rmtree(root, ignore_errors=True)
    kept: list[dict] = []
    discarded: list[dict] = []
    seed = config.seed + SEEDS_PER_TASK * list(recorded.all_tasks()).index(task)
    with _quiet_libraries():
        dataset = _create_dataset(config, root)
        while len(kept) < config.episodes:
            episode = recorded.record(task, seed, config.height, config.width)
            seed += 1
            record = {
                "task": task,
                "seed": episode.seed,
                "steps": len(episode),
                "success": episode.success,
                "status": episode.status,
            }
            if episode.success:
                _write_episode(dataset, episode)
                kept.append(record)
                done(task)
                continue
            discarded.append(record)
            if len(discarded) > 3 + MAX_DISCARDED_SHARE * config.episodes:
                raise RuntimeError(
                    f"the expert failed {len(discarded)} times on {task}, where {config.episodes} episodes "
                    "were wanted; this task was not kept"
                )
        dataset.finalize()
    document = {"episodes": kept, "discarded": discarded}
    write_json(root / PART_FILE, document)


def _merge(config: CollectConfig, parts: Sequence[Path], merged: Path) -> Path:
    """One dataset of all parts, in their order."""
    from lerobot.datasets.aggregate import aggregate_datasets

    shutil.rmtree(merged, ignore_errors=True)
    with _quiet_libraries():
        aggregate_datasets([config.repo_id] * len(parts), config.repo_id, list(parts), merged)
    return merged


def _write_episode(dataset: "LeRobotDataset", episode: "RecordedEpisode") -> None:
    for i in range(len(episode)):
        dataset.add_frame(
            {
                **{f"observation.images.{name}": frames[i] for name, frames in episode.images.items()},
                **{key: rows[i] for key, rows in episode.columns.items()},
                "task": episode.instruction,
            }
        )
    dataset.save_episode()


def _write_meta(config: CollectConfig, root: Path, document: dict) -> None:
    write_json(root / SUMMARY_FILE, document)
    calibration = source(config.env.type).calibration(config.height, config.width)
    write_json(root / "meta/openspm_cameras.json", calibration)


def main(args: Sequence[str] | None = None) -> None:
    """Parse the arguments (default: the command line's), collect, print one JSON object last."""
    import draccus

    config = draccus.parse(config_class=CollectConfig, args=None if args is None else list(args))
    print(json.dumps(collect(config)))
