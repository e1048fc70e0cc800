"""What a policy's configuration makes of a dataset: what was mined, the memory, and the flow samples.

learn(...): dataset -> dataset_processor(...).mine() -> MinedDataset -> memory_of(...), training_set(...)
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import CalibrationError, PerceptionError
from lerobot_openspm.flow.samples import perturbed, segment_frames
from lerobot_openspm.flow.training_set import TrainingSet
from lerobot_openspm.geometry.arm import OUT_OF_REACH_M, OUT_OF_REACH_RAD, Arm, load_arm
from lerobot_openspm.geometry.camera import Camera, load_cameras
from lerobot_openspm.language.lexicon import read_lexicon
from lerobot_openspm.memory.indexed_entries import known_names
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.merging import demonstration_of
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.dataset import Demonstrations, open_dataset
from lerobot_openspm.mining.entries import build_entries
from lerobot_openspm.mining.mined import MinedDataset, MinedEpisode, MinedKeyPoses
from lerobot_openspm.mining.not_learned import list_not_learned
from lerobot_openspm.mining.phase_labels.labelling import LabelCache, label_phases, make_judge
from lerobot_openspm.mining.processor import DatasetProcessor, MiningOptions
from lerobot_openspm.perception.objects.base import ShapeBackend
from lerobot_openspm.perception.objects.sam3d.size import Sam3dShape, worker_command
from lerobot_openspm.types import Segmenter

logger = logging.getLogger(__name__)

# Where a judge's answers are kept, so that nothing is asked twice.
LABELS = HF_LEROBOT_HOME / "openspm" / "phase_labels"
# Copies of every frame with different perturbations, beside the frame itself. Their spread is that of the
# hand's error on the way: somewhat more than the tolerance at a contact key pose.
PERTURBED_COPIES = 3
PERTURBATION_M, PERTURBATION_RAD = 0.006, 0.04
# Whether an arm fits is tested on at most so many of the key poses that were shown.
REACHED_SAMPLE = 20


def learn(
    dataset_meta: Any, config: OpenSPMConfig, memory: Memory | None, segmenter: Segmenter | None
) -> tuple[Memory, TrainingSet]:
    """Mine a dataset once, and make the memory and the flow samples of it.

    Args:
        dataset_meta: LeRobot's metadata of the dataset.
        config: The policy's configuration; ``memory_update`` says what becomes of a memory that is there.
        memory: What is known so far; None for a new policy.
        segmenter: Finds the objects' masks; None where the demonstrations teach what objects look like.
    """
    update = "rebuild" if memory is None else config.memory_update
    known = None if update == "rebuild" else memory
    cameras = None if memory is None else memory.cameras
    processor = dataset_processor(dataset_meta, config, known, cameras, segmenter)
    if update == "keep" and memory is not None:
        mined = processor.key_poses(held_out=True)
    else:
        mined = processor.mine(held_out=True)
        newer = memory_of(mined, config)
        memory = newer if known is None else known.appended(newer)
    logger.info("memory_update=%s: %d entries", update, len(memory.entries))
    return memory, training_set(mined, memory.robot, config)


def dataset_processor(
    dataset: Any,
    config: OpenSPMConfig,
    known: Memory | None = None,
    cameras: dict[str, Camera] | None = None,
    segmenter: Segmenter | None = None,
) -> DatasetProcessor:
    """The processor that mines a dataset as a policy's configuration says.

    Args:
        dataset: A LeRobotDataset, or LeRobot's metadata of one.
        config: The policy's configuration; learns from the dataset how state and action are laid out, where
            it does not say.
        known: A memory whose objects are recognised by what is known of them.
        cameras: Calibration to use where the configuration names no file.
        segmenter: Finds the objects' masks; made as the configuration says if not given.

    Raises:
        CalibrationError: The calibration cannot be read.
        PerceptionError: The segmenter cannot be used.
    """
    meta = getattr(dataset, "meta", dataset)
    _take_layouts(meta, config)
    _compare_rates(meta, config)
    if config.cameras is not None:
        cameras = load_cameras(Path(config.cameras))
    state_layout, action_layout = config.layouts()
    options = MiningOptions(
        state_layout=state_layout,
        action_layout=action_layout,
        cameras=cameras,
        calibration=config.cameras or "the checkpoint's calibration",
        episodes=config.memory_episodes,
        known_objects=known.objects if known else {},
        known_names=known_names(known.entries) if known else (),
        lexicon=read_lexicon(config.lexicon),
        known_robot=known.robot if known else None,
        judge=None if config.judge.type == "none" else partial(labelled, config=config),
        segmenter=segmenter or config.make_segmenter(),
        shape=config.segmenter.shape,
        make_shapes=partial(shapes_of, config),
        is_oracle=config.perception == "oracle",
    )
    return DatasetProcessor(dataset, options)


def memory_of(mined: MinedDataset, config: OpenSPMConfig) -> Memory:
    """The memory that a policy acts by.

    Raises:
        DatasetError: No demonstration's objects were found.
        CalibrationError: The arm's URDF cannot be read, or the arm cannot have moved as was shown.
    """
    robot = (
        mined.robot if config.arm is None else replace(mined.robot, arm=fitting_arm(mined, Path(config.arm)))
    )
    entries = build_entries(mined)
    episodes = len(mined.episodes) + len(mined.skipped)
    used = {demonstration_of(entry.source) for entry in entries}
    logger.info(
        "mined %d entries from %d of %d episodes; objects: %s",
        len(entries), len(used), episodes, ", ".join(sorted(mined.objects)),
    )  # fmt: skip
    not_learned = list_not_learned(mined)
    for one in not_learned:
        logger.warning("%s", one)
    perception, segmentation = "demonstrations", config.perception
    if config.perception == "oracle":
        perception, segmentation = "oracle", "demonstrations"
    return Memory(
        entries, dict(mined.objects), robot, dict(mined.cameras), perception,
        mined.simulator_objects, segmentation, config.segmenter.shape, config.layouts(),
        not_learned=not_learned,
    )  # fmt: skip


def fitting_arm(mined: MinedKeyPoses, path: Path) -> Arm:
    """The arm of a URDF, which reaches most of a sample of the key poses that were shown.

    Raises:
        CalibrationError: It cannot be read, or it misses most of them: it is of another robot, or stands
            elsewhere.
    """
    arm = load_arm(path)
    shown = [pose.T_world_ee for item in mined.episodes for pose in item.key_poses]
    sample = shown[:: max(1, -(-len(shown) // REACHED_SAMPLE))]
    misses = np.array([arm.miss(T, arm.stance(T)) for T in sample]).reshape(-1, 2)
    is_missed = (misses > [OUT_OF_REACH_M, OUT_OF_REACH_RAD]).any(1)
    if 2 * is_missed.sum() > len(sample):
        metres, radians = misses.max(0)
        raise CalibrationError(
            f"{path}: this arm cannot have moved as was shown: of {len(sample)} demonstrated key poses its "
            f"joints miss {is_missed.sum()}, by up to {metres:.2f} m and {radians:.1f} rad, expected at most "
            f"{OUT_OF_REACH_M} m and {OUT_OF_REACH_RAD} rad; pass as --policy.arm=FILE the URDF of this "
            "robot, with its base where it stands in the world of the states and its link 'ee' where they "
            "have the hand (see docs/libero.md), or leave the option out"
        )
    return arm


def training_set(mined: MinedKeyPoses, robot: RobotModel, config: OpenSPMConfig) -> TrainingSet:
    """The samples that the flow model learns from. Reads no image.

    Held-out episodes can be looked up, for a validation loss, but nothing is measured on them or drawn from
    them.

    Args:
        mined: The dataset's key poses.
        robot: The robot that the policy will act with.
        config: The policy's configuration.
    """
    every = sorted((*mined.episodes, *mined.held_out), key=lambda item: item.episode.index)
    episodes = [item.episode for item in every]
    frames = segment_frames(episodes, [item.key_poses for item in every], robot, config.chunk_size)
    rng = np.random.default_rng(0)
    copies = [
        perturbed(frames, robot, PERTURBATION_M, PERTURBATION_RAD, rng) for _ in range(PERTURBED_COPIES)
    ]
    allowed = np.array([item.episode.index for item in mined.episodes])
    starts = np.sort([episode.from_index for episode in episodes])
    return TrainingSet(frames, copies, allowed, starts, config.conditioning)


def open_demonstrations(dataset_meta: Any, config: OpenSPMConfig) -> Demonstrations:
    """The dataset behind LeRobot's metadata, read as mining reads it."""
    dataset = open_dataset(dataset_meta)
    _take_layouts(dataset_meta, config)
    return Demonstrations(dataset, *config.layouts())


def shapes_of(config: OpenSPMConfig) -> ShapeBackend | None:
    """The shape backend that a configuration asks for; None where there is none.

    Raises:
        PerceptionError: It is not said where SAM 3D is.
    """
    if config.segmenter.shape != "sam3d":
        return None
    python, checkout = config.segmenter.sam3d_python, config.segmenter.sam3d_checkout
    if python is None or checkout is None:
        raise PerceptionError(
            f"segmenter.shape is 'sam3d', but sam3d_python is {python!r} and sam3d_checkout {checkout!r}; "
            "pass --policy.segmenter.sam3d_python=PYTHON and --policy.segmenter.sam3d_checkout=DIR, "
            "see docs/sam3d.md"
        )
    return Sam3dShape(worker_command(Path(python), Path(checkout)))


def labelled(
    demonstrations: Demonstrations, mined: tuple[MinedEpisode, ...], robot: RobotModel, config: OpenSPMConfig
) -> tuple[MinedEpisode, ...]:
    """Episodes with the phase labels of the configuration's judge merged into their key poses.

    Raises:
        PhaseLabelError: The judge's model is not named.
        PerceptionError: A model's package or weights are missing.
        DatasetError: The dataset was never annotated, and its annotations are the judge.
    """
    asked = config.judge
    judge = make_judge(
        asked.type, demonstrations, asked.model_id, asked.api_base, asked.timeout_s, str(config.device)
    )
    return label_phases(demonstrations, mined, robot, judge, asked.confidence, LabelCache(LABELS))


def _take_layouts(dataset_meta: Any, config: OpenSPMConfig) -> None:
    """Let a configuration that does not say how state and action are laid out read it from the dataset."""
    if config.state_layout is None or config.action_layout is None:
        config.set_dataset_feature_metadata(dataset_meta.features)


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
