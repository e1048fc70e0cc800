"""What training needs of a dataset: the mined experience, and the samples that the flow model learns from."""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.datasets import open_dataset
from lerobot_openspm.errors import CalibrationError, DatasetError, PerceptionError
from lerobot_openspm.experience import Experience
from lerobot_openspm.flow.samples import perturbed, segment_frames
from lerobot_openspm.flow.training_set import TrainingSet
from lerobot_openspm.geometry.camera import Camera, check_sizes, load_cameras
from lerobot_openspm.judgement.cache import AnswerCache
from lerobot_openspm.judgement.judging import judge_episodes
from lerobot_openspm.judgement.make import make_judge
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.mine import (
    MinedEpisode,
    build_entries,
    layouts_in_scenes,
    learn_scenes,
    mine_key_poses,
    oracle_layouts,
)
from lerobot_openspm.mining.signals import observe_robot
from lerobot_openspm.perception.object_shape import ShapeBackend
from lerobot_openspm.perception.sam3d import Sam3dShape, worker_command
from lerobot_openspm.perception.segmentation.make import make_segmenter
from lerobot_openspm.perception.types import Segmenter

logger = logging.getLogger(__name__)

# Copies of every frame with different perturbations, beside the frame itself.
PERTURBED_COPIES = 3


def open_demonstrations(dataset_meta: Any, config: OpenSPMConfig) -> Demonstrations:
    """The dataset behind LeRobot's metadata, read as mining reads it."""
    dataset = open_dataset(dataset_meta)
    if config.state_layout is None or config.action_layout is None:
        config.set_dataset_feature_metadata(dataset_meta.features)
    return Demonstrations(dataset, *config.layouts())


def segmenter_of(config: OpenSPMConfig) -> Segmenter | None:
    """The segmenter that a configuration asks for; None where the demonstrations teach objects' looks.

    Raises:
        PerceptionError: It cannot be used.
    """
    if config.segmentation == "demonstrations":
        return None
    weights, labels = config.segmentation_weights or (), config.mask_labels or {}
    return make_segmenter(config.segmentation, {}, labels, weights, str(config.device))


def shapes_of(config: OpenSPMConfig) -> AbstractContextManager[ShapeBackend | None]:
    """The shape backend that a configuration asks for, to be closed after use; None where there is none.

    Raises:
        PerceptionError: It is not said where SAM 3D is.
    """
    if config.shape != "sam3d":
        return nullcontext(None)
    if config.sam3d_python is None or config.sam3d_checkout is None:
        raise PerceptionError(
            f"shape is 'sam3d', but sam3d_python is {config.sam3d_python!r} and sam3d_checkout "
            f"{config.sam3d_checkout!r}; pass --policy.sam3d_python=PYTHON and --policy.sam3d_checkout=DIR, "
            "see docs/sam3d.md"
        )
    return Sam3dShape(worker_command(Path(config.sam3d_python), Path(config.sam3d_checkout)))


def judged(
    demonstrations: Demonstrations, mined: tuple[MinedEpisode, ...], robot: RobotModel, config: OpenSPMConfig
) -> tuple[MinedEpisode, ...]:
    """Episodes with what the configuration's judge of phases says of their key poses; unchanged without one.

    Raises:
        JudgementError: There is nothing to ask.
        PerceptionError: A model's package or weights are missing.
        DatasetError: The dataset was never annotated, and its annotations are the judge.
    """
    if config.phase_judge == "none":
        return mined
    judge = make_judge(
        config.phase_judge, demonstrations, config.phase_judge_model_id, config.phase_judge_api_base,
        config.phase_judge_timeout_s, str(config.device),
    )  # fmt: skip
    folder = config.phase_judge_cache or HF_LEROBOT_HOME / "openspm" / "phase_judgements"
    cache = AnswerCache(Path(folder))
    return judge_episodes(demonstrations, mined, robot, judge, config.phase_judge_confidence, cache)


def mine_experience(
    dataset_meta: Any,
    config: OpenSPMConfig,
    known: Experience | None = None,
    cameras: dict[str, Camera] | None = None,
    segmenter: Segmenter | None = None,
) -> Experience:
    """Mine a dataset, and append what was mined to what is known already, as :func:`mine` does each.

    Raises:
        CalibrationError, DatasetError: See :func:`mine`.
        MemoryFormatError: What is known comes from another robot.
    """
    mined = mine(dataset_meta, config, known, cameras, segmenter)
    return known.appended(mined) if known else mined


def mine(
    dataset_meta: Any,
    config: OpenSPMConfig,
    known: Experience | None = None,
    cameras: dict[str, Camera] | None = None,
    segmenter: Segmenter | None = None,
) -> Experience:
    """Mine a dataset's key poses, learn its objects, and make memory entries of it.

    Deterministic: every process of a distributed run mines the same.

    Args:
        dataset_meta: LeRobot's metadata of the dataset.
        config: The policy's configuration.
        known: An experience whose objects are recognised by what is known of them.
        cameras: Calibration to use where the configuration names no file.
        segmenter: Finds the objects' masks, where the configuration's segmentation is not "demonstrations".

    Raises:
        CalibrationError: No calibration is given, or it does not fit.
        DatasetError: The dataset yields no key poses or no anchors.
    """
    cameras = _calibration(dataset_meta, config, cameras)
    _compare_rates(dataset_meta, config)
    demonstrations = open_demonstrations(dataset_meta, config)
    episodes = demonstrations.episodes(config.memory_episodes)
    robot = observe_robot(episodes, known.robot if known else None)
    models = known.objects if known else {}
    mined = mine_key_poses(demonstrations, robot, config.memory_episodes, models)
    mined = replace(mined, mined=judged(demonstrations, mined.mined, robot, config))
    scenes = learn_scenes(demonstrations, mined.mined, cameras)
    with shapes_of(config) as shapes:
        objects = layouts_in_scenes(
            scenes, mined.mined, models, np.random.default_rng(0), segmenter, config.shape, shapes
        )
    names: tuple[str, ...] = ()
    layouts = objects.layouts
    if config.perception == "oracle":
        layouts, names = oracle_layouts(demonstrations, mined.mined, objects.models)
    yaw_periods = {name: model.yaw_period for name, model in objects.models.items()}
    entries = build_entries(mined.mined, layouts, objects.ends, yaw_periods, demonstrations.name)
    if not entries:
        raise DatasetError(
            f"dataset {demonstrations.name} has key poses in {len(mined.mined)} episodes, but the objects "
            "they belong to were found in none; check --policy.cameras, or record with the hand out of view "
            "at the start"
        )
    logger.info(
        "mined %d entries from %d episodes (%d skipped); objects: %s",
        len(entries), len(mined.mined), len(mined.skipped), ", ".join(sorted(objects.models)),
    )  # fmt: skip
    return Experience(
        entries, objects.models, robot, cameras, config.perception, names, config.segmentation, config.shape,
        config.layouts(),
    )  # fmt: skip


def _calibration(
    dataset_meta: Any, config: OpenSPMConfig, cameras: dict[str, Camera] | None
) -> dict[str, Camera]:
    """The calibration that the configuration names, or else the one given, compared with the images."""
    if config.cameras is not None:
        cameras = load_cameras(Path(config.cameras))
    if cameras is None:
        raise CalibrationError(
            "mining needs the cameras' calibration, got none; pass --policy.cameras=FILE, e.g. "
            "configs/cameras/openspm_tabletop.json"
        )
    shapes = {key: tuple(dataset_meta.features[key]["shape"]) for key in dataset_meta.camera_keys}
    # Datasets write the channels last, but some write them first.
    sizes = {key: shape[1:] if shape[0] == 3 else shape[:2] for key, shape in shapes.items()}
    check_sizes(cameras, sizes, config.cameras or "the checkpoint's calibration")
    return cameras


def _compare_rates(dataset_meta: Any, config: OpenSPMConfig) -> None:
    """Say so where a dataset claims another rate than the robot's; no motion is computed from either."""
    if config.control_hz is None or float(dataset_meta.fps) == config.control_hz:
        return
    logger.warning(
        "dataset %s says %g frames per second, but the robot takes %g actions per second. OpenSPM counts "
        "steps, so this is harmless where only the number is wrong, as in the public LIBERO dataset; if the "
        "frames were really recorded at %g Hz, every recorded action reaches further than one step does, and "
        "the demonstrations have to be recorded again at the robot's rate",
        dataset_meta.repo_id, dataset_meta.fps, config.control_hz, dataset_meta.fps,
    )  # fmt: skip


def training_set(dataset_meta: Any, config: OpenSPMConfig, robot: RobotModel) -> TrainingSet:
    """Cut all episodes of a dataset into training samples. Reads no image.

    Held-out episodes can be looked up, for a validation loss, but nothing is measured on them or drawn from
    them.
    """
    demonstrations = open_demonstrations(dataset_meta, config)
    mined = mine_key_poses(demonstrations, robot).mined
    episodes = [item.episode for item in mined]
    frames = segment_frames(episodes, [item.key_poses for item in mined], robot, config.chunk_size)
    allowed = [e.index for e in episodes] if config.memory_episodes is None else config.memory_episodes
    rng = np.random.default_rng(0)
    copies = [
        perturbed(frames, robot, config.perturbation_m, config.perturbation_rad, rng)
        for _ in range(PERTURBED_COPIES if config.perturbation_m > 0 or config.perturbation_rad > 0 else 0)
    ]
    starts = np.sort([episode.from_index for episode in episodes])
    return TrainingSet(frames, copies, np.asarray(allowed), starts, config.conditioning)
