"""Making the question about an episode: its moments and its contact sheets."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.mining.phase_labels.base import Moment, PhaseQuestion, Picture
from lerobot_openspm.mining.signals import Episode

# The paper's three views.
MAX_CAMERAS = 3
# Qwen3-VL sees a tile as 7 x 7 patches of 32 pixels, enough to show what a hand holds; 20 are 1,000 tokens.
TILE_PX = 224
COLUMNS, TILES_PER_SHEET = 5, 20
TRAJECTORY_MOMENTS = 32


def ask_about(
    demonstrations: Demonstrations, item: MinedEpisode, robot: RobotModel, looks: bool
) -> PhaseQuestion:
    """The question about an episode.

    Args:
        demonstrations: Its dataset.
        item: The episode with its candidate key poses.
        robot: The robot that recorded it; says which gripper command closes.
        looks: Whether the judge needs pictures.
    """
    episode, frames = item.episode, [pose.frame for pose in item.key_poses]
    pictures = demonstrations.pictures(episode, frames, MAX_CAMERAS) if looks else {}
    spread = np.unique(np.linspace(0, len(episode) - 1, min(TRAJECTORY_MOMENTS, len(episode))).astype(int))
    return PhaseQuestion(
        dataset=demonstrations.name,
        episode=episode.index,
        instruction=episode.task,
        candidates=moments(episode, frames, demonstrations.fps, robot),
        trajectory=moments(episode, [int(frame) for frame in spread], demonstrations.fps, robot),
        sheets={camera: contact_sheets(tiles) for camera, tiles in pictures.items()},
        kinematic=tuple(pose.phase for pose in item.key_poses),
    )


def moments(episode: Episode, frames: Sequence[int], fps: float, robot: RobotModel) -> tuple[Moment, ...]:
    """The hand's state at some frames."""
    closing = robot.closed(episode.actions[:, 6])
    wide = max(robot.open_width, 1e-9)
    return tuple(
        Moment(
            frame / fps,
            tuple(episode.T_world_ee[frame, :3, 3].tolist()),
            tuple(se3.log_so3(episode.T_world_ee[frame, :3, :3]).tolist()),
            float(np.clip(episode.opening[frame] / wide, 0, 1)),
            bool(closing[frame]),
        )
        for frame in frames
    )


def contact_sheets(pictures: Sequence[Picture]) -> tuple[Picture, ...]:
    """Pack one camera's pictures into sheets of numbered tiles, row by row.

    Args:
        pictures: ``(height, width, 3)`` RGB, all of one size; the first gets number 1.
    """
    tiles = [_tile(picture, number) for number, picture in enumerate(pictures, start=1)]
    return tuple(_sheet(tiles[i : i + TILES_PER_SHEET]) for i in range(0, len(tiles), TILES_PER_SHEET))


def _sheet(tiles: Sequence[Picture]) -> Picture:
    columns = min(COLUMNS, len(tiles))
    blank = np.zeros_like(tiles[0])
    rows = [list(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    rows[-1] += [blank] * (columns - len(rows[-1]))
    return np.concatenate([np.concatenate(row, axis=1) for row in rows], axis=0)


def _tile(picture: Picture, number: int) -> Picture:
    """A picture of the tiles' width, with its number in white on black in a corner."""
    height = max(1, round(picture.shape[0] * TILE_PX / picture.shape[1]))
    tile = cv2.resize(picture, (TILE_PX, height), interpolation=cv2.INTER_AREA)
    text, font, scale, thick = str(number), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 2
    (width, tall), below = cv2.getTextSize(text, font, scale, thick)
    cv2.rectangle(tile, (0, 0), (width + 8, tall + below + 6), (0, 0, 0), cv2.FILLED)
    cv2.putText(tile, text, (4, tall + 4), font, scale, (255, 255, 255), thick, cv2.LINE_AA)
    return np.asarray(tile, np.uint8)
