"""The low-dimensional signals of episodes, and the robot model that they show."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.robot import RobotModel

# Commanded and achieved motion are compared over windows this long, because an operational-space
# controller answers a command over several steps.
GAIN_WINDOW_STEPS = 5
# ... and an axis tells the gain if they vary together by at least this share of what they do along the best.
TELLING_SHARE = 0.9
# Gripper commands that differ by less than this are one command.
MIN_COMMAND_RANGE = 1e-3

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Episode:
    """What mining reads of one demonstration, `n` frames long.

    Attributes:
        index: Episode index in the dataset.
        task: The instruction.
        from_index: Dataset index of the first frame.
        T_world_ee: Hand poses ``(n, 4, 4)``.
        opening: Gripper opening ``(n,)`` in the units of the state.
        actions: Canonical actions ``(n, 7)`` in the units of the dataset.
    """

    index: int
    task: str
    from_index: int
    T_world_ee: Array
    opening: Array
    actions: Array

    def __len__(self) -> int:
        return len(self.opening)


def observe_robot(episodes: Sequence[Episode], known: RobotModel | None = None) -> RobotModel:
    """Fit the gripper's convention and the gain from action to motion over all episodes.

    Args:
        episodes: The demonstrations.
        known: Model of the same robot from earlier demonstrations; its gripper commands are used where these
            episodes show only one.
    """
    close, open_ = _gripper_commands(episodes, known)
    opening = np.concatenate([episode.opening for episode in episodes])
    positions = np.concatenate([episode.T_world_ee[:, :3, 3] for episode in episodes])
    speed = np.concatenate([se3.distance(e.T_world_ee[:-1], e.T_world_ee[1:]) for e in episodes])
    moving = speed[speed > 0.1 * speed.max(initial=0.0)]
    return RobotModel(
        close_command=close,
        open_command=open_,
        open_width=float(np.percentile(opening, 98)),
        metres_per_action=_gain(episodes, slice(0, 3)),
        radians_per_action=_gain(episodes, slice(3, 6)),
        metres_per_step=float(np.median(moving)) if len(moving) else 0.0,
        workspace=np.stack([positions.min(axis=0), positions.max(axis=0)]),
    )


def _gripper_commands(episodes: Sequence[Episode], known: RobotModel | None) -> tuple[float, float]:
    """The commands that close and that open."""
    commands = np.concatenate([episode.actions[:, 6] for episode in episodes])
    low, high = (float(c) for c in np.percentile(commands, [2, 98]))
    if high - low > MIN_COMMAND_RANGE:
        # Under the command that closes, the opening shrinks from one step to the next.
        middle = (low + high) / 2
        trends = [((e.actions[:-1, 6] - middle) * np.diff(e.opening)).sum() for e in episodes]
        return (high, low) if sum(trends) <= 0 else (low, high)
    if known is not None:
        return known.close_command, known.open_command
    other = -low if abs(low) > MIN_COMMAND_RANGE else 1.0
    ends = float(np.median([e.opening[-1] for e in episodes]))
    closing = ends < 0.5 * max(float(e.opening.max()) for e in episodes)
    logger.warning(
        "the gripper command is %.3g in every frame; taken to be the one that %s, and %.3g the other",
        low, "closes" if closing else "opens", other,
    )  # fmt: skip
    return (low, other) if closing else (other, low)


def _gain(episodes: Sequence[Episode], part: slice) -> float:
    """Least-squares slope of achieved over commanded motion, of the axes that tell it; 0 when none does.

    A demonstrator who only keeps the hand level commands against what disturbs it. About such an axis the
    hand follows its commands badly, and the slope is far too small.
    """
    k = GAIN_WINDOW_STEPS
    cross, commanded_power, achieved_power = np.zeros(3), np.zeros(3), np.zeros(3)
    for episode in episodes:
        if len(episode) <= 2 * k:
            continue
        achieved = se3.increment(episode.T_world_ee[:-k], episode.T_world_ee[k:])[:, part]
        sums = np.cumsum(np.vstack([np.zeros(7), episode.actions]), axis=0)
        commanded = (sums[k:-1] - sums[: -k - 1])[: len(achieved), part]
        cross += (achieved * commanded).sum(0)
        commanded_power += (commanded**2).sum(0)
        achieved_power += (achieved**2).sum(0)
    correlation = cross / np.sqrt(np.maximum(commanded_power * achieved_power, 1e-12))
    tells = (correlation > 0) & (correlation >= TELLING_SHARE * correlation.max())
    return float(cross[tells].sum() / commanded_power[tells].sum()) if tells.any() else 0.0
