from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.utils.feature_utils import dataset_to_policy_features
from tests.policy.conftest import Frame, act
from tests.policy.lerobot_commands import ARM, CALIBRATION

from lerobot_openspm import training
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import CalibrationError, DatasetError, MemoryFormatError
from lerobot_openspm.flow.training_set import TrainingSet
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import load_arm
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.mining import processor
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.mined import MinedDataset, MinedKeyPoses
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.training import dataset_processor, fitting_arm, training_set

BOWL, STOVE = "put the bowl on the plate", "turn on the stove"
PUSH = "push the plate to the front of the stove"


def new_config(meta: LeRobotDatasetMetadata, **options) -> OpenSPMConfig:
    """A configuration as LeRobot fills it in for a new policy."""
    features = dataset_to_policy_features(meta.features)
    outputs = {key: feature for key, feature in features.items() if feature.type is FeatureType.ACTION}
    config = OpenSPMConfig(
        device="cpu", push_to_hub=False, cameras=str(CALIBRATION), samples_per_frame=8,
        input_features={key: value for key, value in features.items() if key not in outputs},
        output_features=outputs, **options,
    )  # fmt: skip
    config.set_dataset_feature_metadata(meta.features)
    return config


@pytest.fixture
def other_meta(other_dataset: Path) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata("local/other", root=other_dataset)


@pytest.fixture
def trainable(load: Callable[..., OpenSPMPolicy], tiny_meta: LeRobotDatasetMetadata) -> OpenSPMPolicy:
    """The trained policy, ready to be trained further."""
    return load(dataset_meta=tiny_meta)


def batch(*index: int) -> dict[str, torch.Tensor]:
    return {"index": torch.tensor(index)}


def samples_of(meta: LeRobotDatasetMetadata, config: OpenSPMConfig) -> TrainingSet:
    mined = dataset_processor(meta, config).key_poses(held_out=True)
    return training_set(mined, mined.robot, config)


def test_the_loss_of_every_frame_has_the_mean_loss_as_its_mean(trainable: OpenSPMPolicy):
    trainable.train()
    torch.manual_seed(0)
    mean, logged = trainable.forward(batch(3, 60, 200))
    torch.manual_seed(0)
    each, _ = trainable.forward(batch(3, 60, 200), reduction="none")
    assert each.shape == (3,)
    torch.testing.assert_close(each.mean(), mean)
    assert logged["flow_loss"] == pytest.approx(mean.item())


def test_training_goes_on_after_a_rollout(trainable: OpenSPMPolicy, recorded: list[list[Frame]]):
    with torch.inference_mode():
        act(trainable, recorded[:2])
    trainable.train()
    before = [parameter.detach().clone() for parameter in trainable.parameters()]
    optimizer = torch.optim.SGD(trainable.get_optim_params(), lr=0.1)
    loss, _ = trainable.forward(batch(3, 60))
    loss.backward()
    optimizer.step()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in trainable.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, trainable.parameters(), strict=True))
    assert not any(buffer.is_inference() for buffer in trainable.buffers())


def test_training_lowers_the_loss(trainable: OpenSPMPolicy):
    trainable.train()
    optimizer = torch.optim.AdamW(trainable.get_optim_params(), lr=2e-3)
    losses = []
    for i in range(60):
        loss, _ = trainable.forward(batch(*range(i, i + 16)))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert sum(losses[-10:]) < 0.95 * sum(losses[:10])


def test_the_evaluation_loss_repeats_with_the_seed(trainable: OpenSPMPolicy):
    trainable.eval()
    losses = []
    for _ in range(2):
        torch.manual_seed(5)
        with torch.no_grad():
            losses.append(trainable.forward(batch(*range(551)), reduction="none")[0])
    assert torch.equal(*losses)


def test_evaluation_looks_at_the_same_samples_whatever_the_seed(
    tiny_meta: LeRobotDatasetMetadata,
):
    samples = samples_of(tiny_meta, new_config(tiny_meta, memory_episodes=[0, 1, 3, 4]))
    everything = torch.arange(tiny_meta.total_frames)
    torch.manual_seed(1)
    first = samples.draw(everything, 1, training=False)
    torch.manual_seed(2)
    second = samples.draw(everything, 1, training=False)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def count_calls(owner: Any, name: str, argument: int, monkeypatch: pytest.MonkeyPatch) -> Counter[int]:
    """How often a function is called, by the index of the episode that it is given as an argument."""
    called, calls = getattr(owner, name), Counter[int]()

    def counted(*given, **named):
        calls[given[argument].index] += 1
        return called(*given, **named)

    monkeypatch.setattr(owner, name, counted)
    return calls


def test_a_dataset_is_mined_like_its_metadata(tiny_meta: LeRobotDatasetMetadata, tiny_dataset: Path):
    config = new_config(tiny_meta)
    some = LeRobotDataset(tiny_meta.repo_id, root=tiny_dataset, episodes=[1, 4], video_backend="pyav")
    opened = dataset_processor(some, config).key_poses(held_out=True)
    named = dataset_processor(tiny_meta, new_config(tiny_meta, memory_episodes=[1, 4])).key_poses(
        held_out=True
    )
    for found in (opened, named):
        assert [item.episode.index for item in found.episodes] == [1, 4]
        assert [item.episode.index for item in found.held_out] == [0, 2, 3, 5]
    for one, other in zip(opened.episodes, named.episodes, strict=True):
        assert np.array_equal(one.episode.T_world_ee, other.episode.T_world_ee)
        assert [pose.frame for pose in one.key_poses] == [pose.frame for pose in other.key_poses]


def test_no_episodes_to_learn_from_are_an_error(tiny_meta: LeRobotDatasetMetadata):
    with pytest.raises(DatasetError, match=r"no episode of dataset .* may be learned from"):
        dataset_processor(tiny_meta, new_config(tiny_meta, memory_episodes=[])).key_poses()


def numbers(samples: torch.Tensor) -> set[tuple[float, ...]]:
    """The different rows of a batch of samples."""
    return {tuple(row.tolist()) for row in samples}


def test_held_out_episodes_are_neither_remembered_nor_drawn(
    tiny_meta: LeRobotDatasetMetadata, monkeypatch: pytest.MonkeyPatch
):
    kept = [0, 1]
    mined = count_calls(processor, "find_key_poses", 0, monkeypatch)
    seen = count_calls(Demonstrations, "views", 1, monkeypatch)
    policy = OpenSPMPolicy(new_config(tiny_meta, memory_episodes=kept), dataset_meta=tiny_meta)
    assert mined == Counter(range(6)), "every episode is mined once"
    assert set(seen) == set(kept), "of what is held out no image is looked at"
    assert max(seen.values()) <= 2
    assert policy.memory is not None
    assert sorted(e.source for e in policy.memory.entries) == [f"{tiny_meta.repo_id}#{i}" for i in kept]

    # Unperturbed, every sample is known by its numbers.
    monkeypatch.setattr(training, "PERTURBED_COPIES", 0)
    samples = samples_of(tiny_meta, new_config(tiny_meta, memory_episodes=kept))
    starts, ends = tiny_meta.episodes["dataset_from_index"], tiny_meta.episodes["dataset_to_index"]
    held_out, remembered = (
        torch.cat([torch.arange(starts[i], ends[i]) for i in indices]) for indices in ((2, 3), kept)
    )
    allowed = numbers(samples.draw(remembered, 1, training=False)[0])
    forbidden = numbers(samples.draw(held_out, 1, training=False)[0])
    assert len(forbidden) > 50, "held-out frames can be asked for by index"
    assert not forbidden & allowed, "a validation loss is not measured on what was learned from"
    assert numbers(samples.draw(remembered, 40, training=True)[0]) == allowed
    outside = torch.full((400,), 10_000)
    assert not forbidden & numbers(samples.draw(outside, 40, training=True)[0])


@pytest.mark.parametrize("held_out", [[6], [-1], [0, 99]])
def test_an_episode_that_does_not_exist_is_named(tiny_meta: LeRobotDatasetMetadata, held_out: list[int]):
    with pytest.raises(DatasetError, match=r"has episodes 0 to 5, got \["):
        OpenSPMPolicy(new_config(tiny_meta, memory_episodes=held_out), dataset_meta=tiny_meta)


def languages(policy: OpenSPMPolicy) -> list[str]:
    assert policy.memory is not None
    return [entry.language for entry in policy.memory.entries]


@pytest.mark.parametrize(
    ("update", "expected"),
    [
        ("keep", [BOWL] * 3 + [STOVE] * 3),
        ("append", [BOWL] * 3 + [PUSH] * 2 + [STOVE] * 3),
    ],
)
def test_fine_tuning_updates_the_memory_as_asked(
    load: Callable[..., OpenSPMPolicy],
    other_meta: LeRobotDatasetMetadata,
    recorded: list[list[Frame]],
    tmp_path: Path,
    update: str,
    expected: list[str],
):
    tuned = load(dataset_meta=other_meta, memory_update=update)
    assert sorted(languages(tuned)) == sorted(expected)
    loss, _ = tuned.forward(batch(3, 10))
    assert torch.isfinite(loss)
    # What was known before is still found, and acts as before.
    assert torch.equal(act(tuned, recorded), act(load(), recorded))
    tuned.save_pretrained(tmp_path)
    assert languages(load(tmp_path)) == languages(tuned)
    # Resuming such a run meets the same dataset again and adds nothing.
    assert sorted(languages(load(tmp_path, dataset_meta=other_meta))) == sorted(expected)


def test_rebuilding_forgets_what_was_known_and_keeps_the_cameras(
    load: Callable[..., OpenSPMPolicy], tiny_meta: LeRobotDatasetMetadata, recorded: list[list[Frame]]
):
    tuned = load(dataset_meta=tiny_meta, memory_update="rebuild", memory_episodes=[3, 4, 5], cameras=None)
    assert languages(tuned) == [STOVE] * 3
    act(tuned, recorded[:1])
    assert STOVE in tuned.episodes[0].controller.state.refusal


def test_what_a_new_memory_could_not_know_is_refused(
    load: Callable[..., OpenSPMPolicy], other_meta: LeRobotDatasetMetadata
):
    # The stove that the plate is pushed to is touched in no demonstration of this dataset alone.
    with pytest.raises(DatasetError, match="'stove': the hand touches it in no demonstration"):
        load(dataset_meta=other_meta, memory_update="rebuild")


def test_appending_keeps_the_episodes_of_another_dataset_of_the_same_name(
    load: Callable[..., OpenSPMPolicy], other_dataset: Path
):
    namesake = LeRobotDatasetMetadata("local/openspm_tabletop", root=other_dataset)
    tuned = load(dataset_meta=namesake, memory_update="append")
    assert sorted(languages(tuned)) == sorted([BOWL] * 3 + [PUSH] * 2 + [STOVE] * 3)


def test_the_perceptions_are_not_mixed(load: Callable[..., OpenSPMPolicy]):
    with pytest.raises(
        MemoryFormatError, match=r"perception=demonstrations, got --policy\.perception=oracle"
    ):
        load(perception="oracle")
    with pytest.raises(MemoryFormatError, match=r"perception=demonstrations, got --policy\.perception=sam3"):
        load(perception="sam3")


def test_a_loaded_policy_cannot_be_trained_without_a_dataset(policy: OpenSPMPolicy):
    with pytest.raises(DatasetError, match="dataset_meta"):
        policy.forward(batch(0))


def of_hand_poses(mined: MinedKeyPoses, poses: list[Array]) -> MinedKeyPoses:
    """The same demonstrations, as if the hand had been at these poses in turn."""
    turn = cycle(poses)
    episodes = [
        replace(item, key_poses=tuple(replace(pose, T_world_ee=next(turn)) for pose in item.key_poses))
        for item in mined.episodes
    ]
    return replace(mined, episodes=tuple(episodes))


def test_an_arm_that_cannot_have_moved_as_was_shown_is_refused_by_its_option(
    tiny_meta: LeRobotDatasetMetadata,
):
    config = new_config(tiny_meta, arm=str(ARM))
    mined, arm = dataset_processor(tiny_meta, config).key_poses(), load_arm(ARM)
    reached = [arm.ee_pose(arm.middle + change) for change in np.linspace(-0.5, 0.5, 5)]
    assert fitting_arm(of_hand_poses(mined, reached), ARM).joints
    # As in scenes where the robot stands on the floor.
    lower = [se3.transform(np.eye(3), [0.06, 0.0, -0.912]) @ T for T in reached]
    assert fitting_arm(of_hand_poses(mined, [*reached, *lower[:2]]), ARM).joints
    wrong = MinedDataset(
        **vars(of_hand_poses(mined, lower)), cameras={}, objects={}, object_poses=(), tasks=()
    )
    with pytest.raises(
        CalibrationError, match=r"libero_panda\.urdf: .* miss \d+, by up to 0\.\d+ m"
    ) as error:
        training.memory_of(wrong, config)
    assert "--policy.arm=FILE" in str(error.value)
