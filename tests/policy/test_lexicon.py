"""`--policy.lexicon`: words of the user's own, in the policy and in its checkpoint."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.policy.conftest import Frame, batch_of

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import LexiconError
from lerobot_openspm.modeling_openspm import OpenSPMPolicy


def test_a_word_of_the_users_own_is_acted_on_and_travels_with_the_checkpoint(
    load: Callable[..., OpenSPMPolicy], recorded: list[list[Frame]], tmp_path: Path
):
    words = tmp_path / "words.yaml"
    words.write_text("synonyms: {bowl: [dax]}\nverbs: {put: [blick]}\n")
    frame = next(episode[0] for episode in recorded if episode[0]["task"] == "put the bowl on the plate")
    batch = batch_of([{**frame, "task": "blick the dax on the plate"}])
    without = load()
    without.select_action(batch)
    assert without.episodes[0].controller.state.refusal
    policy = load(lexicon=str(words))
    policy.select_action(batch)
    assert policy.episodes[0].controller.state.ranked[0].entry.language == "put the bowl on the plate"
    policy.save_pretrained(tmp_path / "saved")
    words.unlink()
    elsewhere = OpenSPMPolicy.from_pretrained(tmp_path / "saved")
    elsewhere.select_action(batch)
    assert not elsewhere.episodes[0].controller.state.refusal


def test_without_words_of_ones_own_a_checkpoint_keeps_none(
    load: Callable[..., OpenSPMPolicy], tmp_path: Path
):
    load().save_pretrained(tmp_path)
    assert OpenSPMConfig.from_pretrained(tmp_path).lexicon is None


def test_a_file_that_cannot_be_read_is_an_error_when_the_policy_is_loaded(
    load: Callable[..., OpenSPMPolicy], tmp_path: Path
):
    with pytest.raises(LexiconError, match=r"cannot be read.*--policy.lexicon"):
        load(lexicon=str(tmp_path / "none.yaml"))
