"""Writing recorded episodes as a LeRobotDataset."""

from __future__ import annotations

import contextlib
import logging
import shutil
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_openspm.envs.recording import RecordedEpisode, Suite

if TYPE_CHECKING:
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

FPS = 20
# How hard a video codec tries, where its own default takes long.
PRESETS: dict[str, str | int] = {"h264": "veryfast", "libsvtav1": 10}


# Nothing is read back while recording, but naming a decoder spares the search for another one. A full queue
# drops frames; one that holds the longest episode never is.
WRITING: dict[str, Any] = {
    "video_backend": "pyav",
    "streaming_encoding": True,
    "encoder_queue_maxsize": 1000,
    "encoder_threads": 1,
}


def video_encoder(vcodec: str, pix_fmt: str, crf: int) -> RGBEncoderConfig:
    """How videos are encoded: codec, pixel format, constant rate factor."""
    from lerobot.configs.video import RGBEncoderConfig

    return RGBEncoderConfig(vcodec=vcodec, pix_fmt=pix_fmt, crf=crf, preset=PRESETS.get(vcodec))


def create_dataset(
    suite: Suite, repo_id: str, root: Path, size: tuple[int, int], encoder: RGBEncoderConfig
) -> LeRobotDataset:
    """Begin a dataset of a suite's episodes in a folder that does not exist.

    Args:
        suite: What is recorded.
        repo_id: The dataset's name.
        root: Its folder.
        size: Height and width of the images.
        encoder: How its videos are encoded.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset.create(
        repo_id=repo_id,
        fps=FPS,
        features=_features(suite, size),
        root=root,
        robot_type=suite.robot_type,
        use_videos=True,
        rgb_encoder=encoder,
        **WRITING,
    )


def resume_dataset(repo_id: str, root: Path, encoder: RGBEncoderConfig) -> LeRobotDataset:
    """Append to a dataset that was finalized."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset.resume(repo_id, root, rgb_encoder=encoder, **WRITING)


def _features(suite: Suite, size: tuple[int, int]) -> dict[str, dict[str, Any]]:
    video = {"dtype": "video", "shape": (*size, 3), "names": ["height", "width", "channels"]}
    features: dict[str, dict[str, Any]] = {
        f"observation.images.{name}": dict(video) for name in suite.cameras
    }
    for key, names in suite.names.items():
        count = sum(map(len, names.values())) if isinstance(names, Mapping) else len(names)
        features[key] = {"dtype": "float32", "shape": (count,), "names": names}
    return features


def write_episode(dataset: LeRobotDataset, episode: RecordedEpisode) -> None:
    """Append an episode to a dataset."""
    for i in range(len(episode)):
        dataset.add_frame(
            {
                **{f"observation.images.{name}": frames[i] for name, frames in episode.images.items()},
                **{key: rows[i] for key, rows in episode.columns.items()},
                "task": episode.instruction,
            }
        )
    dataset.save_episode()


def merge(repo_id: str, parts: Sequence[Path], merged: Path) -> None:
    """Make one dataset of several, in their order; what was in its folder is removed."""
    from lerobot.datasets.aggregate import aggregate_datasets

    shutil.rmtree(merged, ignore_errors=True)
    with quiet_libraries():
        aggregate_datasets([repo_id] * len(parts), repo_id, list(parts), merged)


@contextlib.contextmanager
def quiet_libraries() -> Generator[None]:
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
