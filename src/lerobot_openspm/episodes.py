"""The episodes that a policy runs: one for each environment, with a state and perception of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.control.feasibility import TransferLimits
from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.language.names import NameSimilarity
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.pipeline import Perception
from lerobot_openspm.types import Segmenter

# Of checkpoints that do not say how often their robot acts.
DEFAULT_CONTROL_HZ = 20.0


@dataclass
class RunningEpisode:
    """One environment.

    Attributes:
        controller: Decides what to do.
        perception: Finds the objects.
        is_reported: Whether its success or failure was reported.
        workplace: Whose memory it acts by, counted from 0.
    """

    controller: EpisodeController
    perception: Perception
    is_reported: bool = False
    workplace: int = 0


def new_episode(
    observation: Observation,
    memory: Memory,
    entries: Sequence[MemoryEntry],
    config: OpenSPMConfig,
    names: NameSimilarity,
    segmenter: Segmenter | None,
) -> RunningEpisode:
    """An episode that begins with an observation.

    Args:
        observation: The first one.
        memory: What was learned.
        entries: The memory's entries with their index.
        config: The policy's configuration.
        names: Tells which names mean the same thing.
        segmenter: Finds the objects' masks; None where their colours do.
    """
    context = PlanningContext(
        entries,
        memory.yaw_periods,
        memory.robot,
        limits=TransferLimits(config.reach_margin_m, config.min_clearance_m),
        execution=config.execution,
        tracking=config.tracking,
        step_s=step_s(config),
        names=names,
        points=memory.points,
        hand_radius_m=config.hand_radius_m,
        symmetries=memory.symmetries,
    )
    fingerprint = observation.fingerprint()
    controller = EpisodeController(context, observation.instruction, fingerprint, config.noise_seed)
    return RunningEpisode(controller, Perception(memory, config.hand_radius_m, segmenter))


def step_s(config: OpenSPMConfig) -> float:
    """Seconds that a control step takes."""
    return 1 / (config.control_hz or DEFAULT_CONTROL_HZ)
