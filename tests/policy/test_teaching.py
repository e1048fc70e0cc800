"""A policy is taught in Python, also while it runs."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import modify_tasks
from tests.memory.builders import entry
from tests.policy.conftest import NAME, Frame, batch_of

from lerobot_openspm import teaching
from lerobot_openspm.errors import DatasetError, MemoryFormatError
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.teaching import _is_shown

PUSH = "push the plate to the front of the stove"


@pytest.fixture(scope="session")
def push_meta(other_dataset: Path) -> LeRobotDatasetMetadata:
    """Two demonstrations of a task that the checkpoint does not know."""
    return LeRobotDatasetMetadata(NAME, root=other_dataset)


def test_a_running_policy_can_be_taught(
    policy: OpenSPMPolicy, recorded: list[list[Frame]], push_meta: LeRobotDatasetMetadata
):
    running, asked = batch_of([recorded[0][0]]), batch_of([recorded[0][0] | {"task": PUSH}])
    policy.select_action(asked)
    assert "it knows" in policy.episodes[0].controller.state.refusal
    policy.select_action(running)
    row, weights = policy.episodes[0].controller, {k: v.clone() for k, v in policy.state_dict().items()}
    lesson = policy.teach(push_meta, [0])
    assert lesson.instructions == (PUSH,)
    assert (lesson.known_before, lesson.skipped, lesson.objects_learned) == ({PUSH: 0}, (), ())
    assert all(torch.equal(value, weights[key]) for key, value in policy.state_dict().items())
    policy.select_action(running)
    assert policy.episodes[0].controller is row  # the running episode goes on
    assert torch.isfinite(policy.select_action(asked)).all()
    assert policy.episodes[0].controller.instruction == PUSH


def test_a_taught_memory_travels_with_the_checkpoint(
    policy: OpenSPMPolicy, load: Callable[..., OpenSPMPolicy], push_meta: Any, tmp_path: Path
):
    lesson = policy.teach(push_meta)
    policy.save_pretrained(tmp_path)
    entries = load(tmp_path).require_memory().entries
    assert [entry.source for entry in entries[-2:]] == [entry.source for entry in lesson.entries]
    assert len(entries) == 8


def without_stove(memory: Memory, episodes: tuple[int, ...]) -> Memory:
    """The same where the stove was not found in some of the episodes."""
    unseen = {f"{NAME}#{index}" for index in episodes}
    entries = [
        replace(e, object_poses={"plate": e.object_poses["plate"]}) if e.source in unseen else e
        for e in memory.entries
    ]
    return replace(memory, entries=tuple(entries))


@pytest.mark.parametrize("hidden", [(1,), (0, 1)])
def test_demonstrations_that_do_not_show_an_object_are_not_believed(
    policy: OpenSPMPolicy, push_meta: Any, monkeypatch: pytest.MonkeyPatch, hidden: tuple[int, ...]
):
    remember = teaching.memory_of
    monkeypatch.setattr(teaching, "memory_of", lambda *given: without_stove(remember(*given), hidden))
    before = policy.memory
    if len(hidden) == 2:
        with pytest.raises(DatasetError, match=r"not learned from episodes \[0, 1\].*could not find stove"):
            policy.teach(push_meta)
        assert policy.memory is before
    else:
        lesson = policy.teach(push_meta)
        assert (len(lesson.entries), lesson.skipped) == (1, (1,))


def test_demonstrations_of_another_robot_are_refused(
    policy: OpenSPMPolicy, push_meta: Any, monkeypatch: pytest.MonkeyPatch
):
    remember = teaching.memory_of

    def of_another(*given: Any) -> Memory:
        mined = remember(*given)
        return replace(mined, robot=replace(mined.robot, close_command=-mined.robot.close_command))

    monkeypatch.setattr(teaching, "memory_of", of_another)
    before = policy.memory
    with pytest.raises(MemoryFormatError, match="another robot or controller"):
        policy.teach(push_meta)
    assert policy.memory is before


@pytest.mark.parametrize(
    ("told", "asked", "objects", "learned"),
    [
        ("polish the plate with the bowl", "please polish a plate with the bowl", {"bowl"}, ()),
        (
            "Serve the soup to the guest",
            "could you serve soup to the guest?",
            {"soup", "guest"},
            ("guest", "soup"),
        ),
    ],
)
def test_any_wording_is_taught_and_acted_on(
    policy: OpenSPMPolicy,
    tiny_dataset: Path,
    recorded: list[list[Frame]],
    tmp_path: Path,
    told: str,
    asked: str,
    objects: set[str],
    learned: tuple[str, ...],
):
    """The demonstrations put the bowl on the plate; what is said of it is not what the grammar reads."""
    root = Path(shutil.copytree(tiny_dataset, tmp_path / "told"))
    modify_tasks(
        LeRobotDataset(NAME, root=root, video_backend="pyav"), episode_tasks=dict.fromkeys(range(3), told)
    )
    lesson = policy.teach(LeRobotDatasetMetadata(NAME, root=root), [0, 1, 2])
    assert lesson.instructions == (told,)
    assert sorted(lesson.objects_learned) == sorted(learned)
    assert objects <= set(lesson.entries[0].objects)
    frame = recorded[0][0]
    for said in (told, asked):
        policy.reset()
        policy.select_action(batch_of([{**frame, "task": said}, frame]))
        assert [one.controller.state.status.value for one in policy.episodes] == ["running", "running"]
        assert [one.controller.state.ranked[0].entry.language for one in policy.episodes] == [
            told,
            frame["task"],
        ]


@pytest.mark.parametrize(
    ("sources", "is_shown"),
    [
        (["a/b#4", "a/b#4"], True),
        (["a/b#4", "a/b#4.2"], True),
        (["a/b#4", "a/b#5"], False),  # of neither episode all was found
        (["a/b#4"], False),
        (["a/b#6", "a/b#6"], False),  # of another instruction
        ([], False),
    ],
)
def test_an_episode_of_several_things_is_learned_where_all_of_them_are(sources, is_shown):
    read = parse_instruction("put both moka pots on the stove")
    entries = [entry("put the moka pot on the stove", source=source) for source in sources]
    assert _is_shown([4, 5], entries, read) == is_shown
