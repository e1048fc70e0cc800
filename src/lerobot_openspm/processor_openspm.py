"""Pre- and post-processing: LeRobot's default steps, as identities, so that every override finds its step."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_openspm.configuration_openspm import OpenSPMConfig


def make_openspm_pre_post_processors(
    config: OpenSPMConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Create the pipelines: rename, batch, device, normalise; and unnormalise, to CPU.

    Poses are geometry and are never normalised: the configuration maps every feature to the identity.
    """
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
