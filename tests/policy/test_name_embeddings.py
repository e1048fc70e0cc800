"""`--policy.name_embeddings`: names that the table of words does not know, in the policy."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tests.language.text_model import make_model
from tests.policy.conftest import Frame, batch_of

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import InstructionError
from lerobot_openspm.modeling_openspm import OpenSPMPolicy


def asked(recorded: list[list[Frame]], known: str, instruction: str) -> dict[str, Any]:
    """The first observation of the episode of an instruction, asked for in other words."""
    frame = next(episode[0] for episode in recorded if episode[0]["task"] == known)
    return batch_of([{**frame, "task": instruction}])


def test_a_name_that_only_embeddings_know_is_acted_on(
    load: Callable[..., OpenSPMPolicy], recorded: list[list[Frame]], tmp_path: Path
):
    model = make_model(tmp_path / "model", {"bowl": (1.0, 0.0), "zorb": (0.9, 0.1)})
    batch = asked(recorded, "put the bowl on the plate", "put the zorb on the plate")
    without = load()
    without.select_action(batch)
    assert "no entry" in without.episodes[0].controller.state.refusal
    policy = load(name_embeddings=str(model))
    action = policy.select_action(batch)
    assert torch.isfinite(action).all()
    assert policy.episodes[0].controller.state.ranked[0].entry.language == "put the bowl on the plate"
    # The folder exists on this machine alone, so that it does not travel with the checkpoint.
    policy.save_pretrained(tmp_path / "saved")
    assert OpenSPMConfig.from_pretrained(tmp_path / "saved").name_embeddings is None


def test_weights_that_are_missing_are_an_error_when_the_policy_is_loaded(
    load: Callable[..., OpenSPMPolicy], tmp_path: Path
):
    with pytest.raises(InstructionError, match=r"name_embeddings.*hf download"):
        load(name_embeddings=str(tmp_path))
