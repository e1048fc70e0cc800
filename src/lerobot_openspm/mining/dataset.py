"""Reading a LeRobotDataset for mining: low-dimensional columns for all frames, images for a few."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from huggingface_hub.errors import HfHubHTTPError, HFValidationError
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.language import LANGUAGE_PERSISTENT
from lerobot.datasets.video_utils import decode_video_frames
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.geometry.vector_layout import VectorLayout
from lerobot_openspm.mining.columns import TYPES, decode_key_poses
from lerobot_openspm.mining.key_poses import KeyPose
from lerobot_openspm.mining.signals import Episode
from lerobot_openspm.perception.observation import DEPTH, MASKS, depth_of, labels_of
from lerobot_openspm.perception.oracle import decode_object_poses
from lerobot_openspm.types import View

# True object poses of simulated demonstrations; read for the oracle ablation alone.
SIMULATOR_POSES = "simulator.object_poses"


def dataset_metadata(repo_id: str, root: str | None) -> LeRobotDatasetMetadata:
    """LeRobot's metadata of a dataset.

    Args:
        repo_id: Its name on the Hub, or of a local one.
        root: Its folder; LeRobot's cache, or else the Hub, if not given.

    Raises:
        DatasetError: There is none, or it cannot be read.
    """
    # LeRobot would ask the Hub for a local dataset that is not there.
    if root is not None and not (Path(root) / "meta/info.json").is_file():
        raise DatasetError(
            f"no dataset in {root}: it has no meta/info.json; pass --dataset.root=FOLDER of a LeRobotDataset"
        )
    with _one_line(repo_id, root):
        return LeRobotDatasetMetadata(repo_id, root=root)


def open_dataset(dataset_meta: Any) -> LeRobotDataset:
    """The dataset behind LeRobot's metadata.

    Raises:
        DatasetError: Files of it are missing, or cannot be read.
    """
    with _one_line(dataset_meta.repo_id, dataset_meta.root):
        return LeRobotDataset(
            dataset_meta.repo_id, root=dataset_meta.root, revision=dataset_meta.revision, video_backend="pyav"
        )


@contextmanager
def _one_line(repo_id: str, root: object) -> Generator[None]:
    """Say in one line why a dataset cannot be read; LeRobot asks the Hub for files that are missing here."""
    try:
        yield
    except (HfHubHTTPError, HFValidationError, httpx.HTTPError, OSError, ValueError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise DatasetError(
            f"dataset {repo_id!r} is not whole in {root or 'the cache of LeRobot'}, nor can it be had from "
            f"the Hub ({reason}); check --dataset.repo_id and --dataset.root"
        ) from error


class Demonstrations:
    """The episodes of a LeRobotDataset as mining reads them.

    Columns are read from the parquet files, and images are decoded only for the frames that are asked for:
    ``dataset[i]`` for every frame would decode every video as a whole.
    """

    def __init__(self, dataset: LeRobotDataset, state_layout: VectorLayout, action_layout: VectorLayout):
        self.dataset = dataset
        self._state_layout, self._action_layout = state_layout, action_layout
        missing = [key for key in (OBS_STATE, ACTION) if key not in dataset.features]
        if missing:
            raise DatasetError(
                f"dataset {dataset.repo_id} lacks {missing}; it has {sorted(dataset.features)}. OpenSPM "
                "mines end-effector poses and increments: record them, or rename the features"
            )

    @property
    def name(self) -> str:
        """The dataset's repository id."""
        return str(self.dataset.repo_id)

    @property
    def fps(self) -> float:
        """Frames per second, by the dataset's own metadata."""
        return float(self.dataset.meta.fps)

    def episodes(self, indices: Sequence[int] | None = None) -> list[Episode]:
        """Read the given episodes, or all of them. Raises DatasetError for an index that does not exist."""
        meta, tasks = self.dataset.meta.episodes, self.dataset.meta.tasks
        if meta is None or tasks is None:
            raise DatasetError(f"dataset {self.name} has no episodes; record some")
        n_episodes = self.dataset.meta.total_episodes
        wanted = list(range(n_episodes)) if indices is None else list(indices)
        if bad := [index for index in wanted if not 0 <= index < n_episodes]:
            raise DatasetError(f"dataset {self.name} has episodes 0 to {n_episodes - 1}, got {bad}")
        columns = self.dataset.hf_dataset.select_columns([OBS_STATE, ACTION, "task_index"])
        table = columns.with_format("numpy")[:]
        names = {int(row["task_index"]): str(task) for task, row in tasks.iterrows()}
        episodes = []
        for index in wanted:
            first, last = int(meta["dataset_from_index"][index]), int(meta["dataset_to_index"][index])
            state = np.asarray(table[OBS_STATE][first:last], float)
            action = np.asarray(table[ACTION][first:last], float)
            episodes.append(
                Episode(
                    index=index,
                    task=names[int(table["task_index"][first])],
                    from_index=first,
                    T_world_ee=self._state_layout.poses(state),
                    opening=self._state_layout.openings(state),
                    actions=self._action_layout.decode_actions(action),
                )
            )
        return episodes

    def states(self) -> Array:
        """The ``observation.state`` ``(n, d)`` of all frames, as it was recorded."""
        column: Any = self.dataset.hf_dataset.select_columns([OBS_STATE]).with_format("numpy")
        return np.asarray(column[:][OBS_STATE]).reshape(len(self.dataset.hf_dataset), -1)

    @property
    def has_key_poses(self) -> bool:
        """Whether the dataset has its key poses in columns, see `lerobot_openspm.mining.columns`."""
        return all(name in self.dataset.features for name in TYPES)

    def key_poses(self, episode: Episode) -> list[KeyPose]:
        """Read an episode's key poses from the columns. Raises DatasetError if they contradict each other."""
        frames = slice(episode.from_index, episode.from_index + len(episode))
        table: Any = self.dataset.hf_dataset.select_columns(list(TYPES)).with_format("arrow")[frames]
        return decode_key_poses(table.to_pydict(), episode, f"dataset {self.name}")

    def views(self, episode: Episode, frame: int, cameras: Mapping[str, Camera]) -> dict[str, View]:
        """Decode one frame's images of the calibrated cameras, keyed by camera, with its masks and depths.

        Raises:
            DatasetError: The dataset lacks a camera.
            ObservationError: A mask or a depth does not fit its image.
        """
        item: dict[str, Any] = self.dataset[episode.from_index + frame]  # pyright: ignore[reportAssignmentType]
        layers = {key: value for key, value in item.items() if key.startswith((MASKS, DEPTH))}
        views = {}
        for key, camera in cameras.items():
            if key not in item:
                raise DatasetError(
                    f"dataset {self.name} has no camera {key!r} that the calibration names; it has "
                    f"{self.dataset.meta.camera_keys}"
                )
            image = _as_bytes(item[key].numpy().transpose(1, 2, 0))
            scaled = camera.scaled(image.shape[1], image.shape[0])
            size = image.shape[:2]
            depth, labels = depth_of(layers, key, size), labels_of(layers, key, size)
            views[key] = View(image, scaled, scaled.T_world_cam(episode.T_world_ee[frame]), depth, labels)
        return views

    def pictures(
        self, episode: Episode, frames: Sequence[int], n_cameras: int
    ) -> dict[str, list[NDArray[np.uint8]]]:
        """Decode a few frames of the first colour cameras, calibrated or not, ``(height, width, 3)`` RGB.

        Args:
            episode: Of this dataset.
            frames: Frames within the episode.
            n_cameras: How many cameras, in the dataset's order.
        """
        pictures: dict[str, list[NDArray[np.uint8]]] = {}
        for frame in frames:
            item: dict[str, Any] = self.dataset[episode.from_index + frame]  # pyright: ignore[reportAssignmentType]
            colour = [key for key in self.dataset.meta.camera_keys if item[key].shape[0] == 3]
            for key in colour[:n_cameras]:
                pictures.setdefault(key, []).append(_as_bytes(item[key].numpy().transpose(1, 2, 0)))
        return pictures

    def subtask_rows(self, index: int) -> list[tuple[float, str]]:
        """An episode's sub-tasks by lerobot-annotate: the second at which each begins, and its words.

        Raises:
            DatasetError: The dataset was never annotated.
        """
        if LANGUAGE_PERSISTENT not in self.dataset.features:
            raise DatasetError(
                f"dataset {self.name} has no column {LANGUAGE_PERSISTENT!r}, which judge.type=annotations "
                f"reads; write it with lerobot-annotate --root={self.dataset.root}, or leave "
                "--policy.judge.type out"
            )
        # Every frame of an episode repeats the rows of the whole episode.
        meta: Any = self.dataset.meta.episodes
        column: Any = self.dataset.hf_dataset.select_columns([LANGUAGE_PERSISTENT])
        rows = column[int(meta["dataset_from_index"][index])][LANGUAGE_PERSISTENT] or []
        found = [(row["timestamp"], row["content"]) for row in rows if row["style"] == "subtask"]
        return sorted((float(begin), str(words or "")) for begin, words in found)

    def images(self, episode: Episode, camera: str) -> NDArray[np.uint8]:
        """All images ``(n, height, width, 3)`` of one camera, uint8 RGB, decoded in one pass.

        Raises:
            DatasetError: The dataset has no such camera, or its frames are not RGB.
        """
        meta = self.dataset.meta
        if camera not in meta.camera_keys:
            raise DatasetError(f"dataset {self.name} has no camera {camera!r}; it has {meta.camera_keys}")
        frames = range(episode.from_index, episode.from_index + len(episode))
        if camera in meta.video_keys:
            rows: Any = meta.episodes
            begin = float(rows[episode.index][f"videos/{camera}/from_timestamp"])
            stamps: Any = self.dataset.hf_dataset.select_columns(["timestamp"]).with_format("numpy")
            times = [begin + float(t) for t in stamps[frames.start : frames.stop]["timestamp"]]
            path = self.dataset.root / meta.get_video_file_path(episode.index, camera)
            images = decode_video_frames(path, times, self.dataset.tolerance_s, "pyav", return_uint8=True)
            images = np.asarray(images.numpy())
        else:
            column = self.dataset.hf_dataset.select_columns([camera])
            images = np.stack([np.asarray(column[frame][camera]) for frame in frames])
        if images.ndim != 4 or images.shape[1] != 3:
            raise DatasetError(
                f"camera {camera!r} of dataset {self.name} is not RGB: frames {images.shape[1:]}"
            )
        return _as_bytes(images.transpose(0, 2, 3, 1))

    def simulator_poses(self, episode: Episode, frame: int) -> dict[str, Array]:
        """True object poses ``T_world_obj`` by name, as a simulator recorded them (oracle ablation only)."""
        if SIMULATOR_POSES not in self.dataset.features:
            raise DatasetError(
                f"dataset {self.name} has no {SIMULATOR_POSES!r}, which --policy.perception=oracle needs; "
                "use perception=demonstrations, or record with openspm collect"
            )
        feature = self.dataset.features[SIMULATOR_POSES]
        row = self.dataset.hf_dataset.select_columns([SIMULATOR_POSES]).with_format("numpy")
        values = np.asarray(row[episode.from_index + frame][SIMULATOR_POSES], float)
        return decode_object_poses(values, feature["names"])


def _as_bytes(images: np.ndarray) -> NDArray[np.uint8]:
    """Images as uint8, whether LeRobot gave bytes or floats from 0 to 1."""
    return images if images.dtype == np.uint8 else np.round(images * 255).astype(np.uint8)
