"""`openspm collect`: record scripted demonstrations on the tabletop as a LeRobotDataset."""

import contextlib
import json
import multiprocessing
import shutil
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_openspm.envs.seeds import DEMO_SEED_START, require_demo_seeds
from lerobot_openspm.envs.tasks import TASK_NAMES, select_tasks

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_openspm.envs.recording import RecordedEpisode

SUMMARY_FILE = "meta/openspm_collect.json"
FPS = 20
# Every task has its own stretch of seeds, so that no two tasks show the same initial states.
SEEDS_PER_TASK = 10_000
# An expert that fails more often than this is broken, and collecting on would only hide it.
MAX_DISCARDED_SHARE = 0.5


@dataclass
class CollectConfig:
    """Record scripted demonstrations on the tabletop as a LeRobotDataset."""

    task: str = "all"  # a task name, a comma list of them, or "all"
    episodes: int = 10  # per task
    root: str | None = None  # output folder; default: LeRobot's home folder / repo_id
    repo_id: str = "local/openspm_tabletop"
    seed: int = DEMO_SEED_START  # first demonstration seed; each task takes its own stretch from here on
    height: int = 256
    width: int = 256
    vcodec: str = "h264"
    pix_fmt: str = (
        "yuv444p"  # full colour resolution; yuv420p plays in every browser but smears colours at edges
    )
    crf: int = 16  # lower keeps colours better
    workers: int = 2  # processes that simulate; 0 simulates in this one
    overwrite: bool = False  # replace an existing dataset at `root`

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}")
        if self.workers < 0:
            raise ValueError(f"workers must not be negative, got {self.workers}")
        select_tasks(self.task)
        require_demo_seeds(self.seed, SEEDS_PER_TASK * len(TASK_NAMES))


def collect(config: CollectConfig) -> dict[str, Any]:
    """Record the demonstrations and return {"episodes", "frames", "discarded", "root", "seconds"}.

    The dataset is written beside its place and moved there when it is complete.

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
    shutil.rmtree(partial, ignore_errors=True)
    root.parent.mkdir(parents=True, exist_ok=True)
    with _quiet_libraries():
        dataset = _create_dataset(config, partial)
        try:
            episodes, discarded = _record_all(config, dataset)
        finally:
            dataset.finalize()
    summary = {
        "episodes": len(episodes),
        "frames": sum(e["steps"] for e in episodes),
        "discarded": len(discarded),
        "root": str(root),
        "seconds": round(time.monotonic() - start_s, 1),
    }
    _write_meta(config, partial, {"summary": summary, "episodes": episodes, "discarded": discarded})
    if root.exists():
        shutil.rmtree(root)
    partial.rename(root)
    return summary


def _root(config: CollectConfig) -> Path:
    if config.root is not None:
        return Path(config.root).expanduser().resolve()
    from lerobot.utils.constants import HF_LEROBOT_HOME

    return (HF_LEROBOT_HOME / config.repo_id).resolve()


def _keep_existing(config: CollectConfig, root: Path) -> dict[str, Any]:
    """Leave a complete dataset alone and say what is there."""
    recorded = json.loads((root / SUMMARY_FILE).read_text(encoding="utf-8"))
    summary = recorded["summary"]
    tasks, wanted = {e["task"] for e in recorded["episodes"]}, set(select_tasks(config.task))
    if tasks != wanted or summary["episodes"] != config.episodes * len(wanted):
        raise FileExistsError(
            f"{root} holds {summary['episodes']} episodes of {sorted(tasks)}, asked were {config.episodes} "
            f"of each of {sorted(wanted)}; choose another --root, or pass --overwrite=true"
        )
    print(
        f"{root} already holds {summary['episodes']} episodes; left alone "
        "(pass --overwrite=true to record again)"
    )
    return {**summary, "root": str(root)}


def _features(config: CollectConfig) -> dict[str, dict]:
    from lerobot_openspm.envs.scene import CAMERA_NAMES
    from lerobot_openspm.envs.tabletop_env import ACTION_NAMES, OBJECT_POSE_NAMES, STATE_NAMES

    def vector(names: Sequence[str]) -> dict:
        return {"dtype": "float32", "shape": (len(names),), "names": list(names)}

    video = {
        "dtype": "video",
        "shape": (config.height, config.width, 3),
        "names": ["height", "width", "channels"],
    }
    return {
        **{f"observation.images.{name}": dict(video) for name in CAMERA_NAMES},
        "observation.state": vector(STATE_NAMES),
        "action": vector(ACTION_NAMES),
        # Not under "observation.": no policy is ever handed the true poses by accident.
        "simulator.object_poses": vector(OBJECT_POSE_NAMES),
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
        robot_type="openspm_tabletop",
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
    """Keep the encoder's and the table writer's messages per episode away from the progress bar."""
    import av.logging
    import datasets

    level, bars = av.logging.get_level(), datasets.are_progress_bars_disabled()
    av.logging.set_libav_level(av.logging.ERROR)
    datasets.disable_progress_bars()
    try:
        yield
    finally:
        av.logging.set_libav_level(level if level is not None else av.logging.INFO)
        if not bars:
            datasets.enable_progress_bars()


def _record_all(config: CollectConfig, dataset: "LeRobotDataset") -> tuple[list[dict], list[dict]]:
    from tqdm import tqdm

    tasks = select_tasks(config.task)
    kept: list[dict] = []
    discarded: list[dict] = []
    with tqdm(total=len(tasks) * config.episodes, desc="episodes", unit="ep") as bar:
        for episode in _episodes(config, tasks):
            record = {
                "task": episode.task,
                "seed": episode.seed,
                "steps": len(episode.action),
                "success": episode.success,
                "status": episode.status,
            }
            if not episode.success:
                discarded.append(record)
                continue
            _write_episode(dataset, episode)
            kept.append(record)
            bar.set_postfix(task=episode.task, discarded=len(discarded))
            bar.update()
    return kept, discarded


def _episodes(config: CollectConfig, tasks: list[str]) -> Iterator["RecordedEpisode"]:
    """Yield episodes task by task in the order of their seeds; a failed one is made up for at once."""
    with _Recorder(config) as submit:
        for task in tasks:
            seeds = iter(range(_first_seed(config, task), _first_seed(config, task) + SEEDS_PER_TASK))
            submit.enqueue(task, [next(seeds) for _ in range(config.episodes)])
            submit.spare_seeds[task] = seeds
        yield from submit.results()


def _first_seed(config: CollectConfig, task: str) -> int:
    return config.seed + SEEDS_PER_TASK * TASK_NAMES.index(task)


class _Recorder:
    """Runs episodes in worker processes, few at a time (they are large), and hands them out in order."""

    def __init__(self, config: CollectConfig) -> None:
        self._config = config
        self._waiting: deque[tuple[str, int]] = deque()
        self._running: deque[tuple[str, Callable[[], RecordedEpisode]]] = deque()
        self._pool: ProcessPoolExecutor | None = None
        self._failures: dict[str, int] = {}
        self.spare_seeds: dict[str, Iterator[int]] = {}

    def __enter__(self) -> "_Recorder":
        if self._config.workers:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self._config.workers, mp_context=context)
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def enqueue(self, task: str, seeds: list[int]) -> None:
        """Add episodes to the end of the queue."""
        self._waiting.extend((task, seed) for seed in seeds)

    def results(self) -> Iterator["RecordedEpisode"]:
        """Yield every queued episode, and one more for each that failed."""
        ahead = self._config.workers + 1 if self._pool is not None else 1
        while self._waiting or self._running:
            while self._waiting and len(self._running) < ahead:
                task, seed = self._waiting.popleft()
                self._running.append((task, self._start(task, seed)))
            task, result = self._running.popleft()
            episode = result()
            if not episode.success:
                self._count_failure(task)
                self._running.appendleft((task, self._start(task, next(self.spare_seeds[task]))))
            yield episode

    def _start(self, task: str, seed: int) -> Callable[[], "RecordedEpisode"]:
        from lerobot_openspm.envs.recording import record_episode

        arguments = (task, seed, self._config.height, self._config.width)
        if self._pool is None:
            return lambda: record_episode(*arguments)
        future: Future[RecordedEpisode] = self._pool.submit(record_episode, *arguments)
        return future.result

    def _count_failure(self, task: str) -> None:
        self._failures[task] = self._failures.get(task, 0) + 1
        if self._failures[task] > 3 + MAX_DISCARDED_SHARE * self._config.episodes:
            raise RuntimeError(
                f"the expert failed {self._failures[task]} times on {task}, "
                f"where {self._config.episodes} episodes were wanted; "
                "nothing was kept"
            )


def _write_episode(dataset: "LeRobotDataset", episode: "RecordedEpisode") -> None:
    for i in range(len(episode.action)):
        dataset.add_frame(
            {
                **{f"observation.images.{name}": frames[i] for name, frames in episode.images.items()},
                "observation.state": episode.state[i],
                "action": episode.action[i],
                "simulator.object_poses": episode.object_poses[i],
                "task": episode.instruction,
            }
        )
    dataset.save_episode()


def _write_meta(config: CollectConfig, root: Path, document: dict) -> None:
    from lerobot_openspm.envs.calibration import write_calibration

    (root / SUMMARY_FILE).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    write_calibration(root / "meta/openspm_cameras.json", config.height, config.width)


def main(args: Sequence[str] | None = None) -> None:
    """Parse the arguments (default: the command line's), collect, print one JSON object last."""
    import draccus

    config = draccus.parse(config_class=CollectConfig, args=None if args is None else list(args))
    print(json.dumps(collect(config)))
