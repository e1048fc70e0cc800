"""Several workplaces in one policy: an episode acts by the memory of the one where the hand is."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from tests.memory.builders import entry
from tests.memory.test_rim_grasps import LOOKS, PUSHED, by_the_rim
from tests.policy.conftest import Frame, act, batch_of

from lerobot_openspm.cli.join import main as join
from lerobot_openspm.errors import MemoryFormatError, OpenSPMError
from lerobot_openspm.language.names import TABLE_NAMES
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.memory.looks import UNKNOWN_LOOKS
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.merging import demonstration_of
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.observation import Observation, split_batch
from lerobot_openspm.workplaces import _knows, choose

FAR_M = 5.0


@pytest.fixture
def changed(checkpoint: Path, tmp_path: Path) -> Callable[[str, Memory], Path]:
    """A copy of the checkpoint with another memory."""

    def change(name: str, memory: Memory) -> Path:
        shutil.copytree(checkpoint, tmp_path / name)
        write_memory(memory, tmp_path / name)
        return tmp_path / name

    return change


def elsewhere(memory: Memory) -> Memory:
    """The memory of a robot whose hand is metres away."""
    return replace(memory, robot=replace(memory.robot, workspace=memory.robot.workspace + FAR_M))


def joined(*paths: Path) -> Path:
    output = paths[0].parent / "joined"
    join([f"--policy.paths=[{','.join(map(str, paths))}]", f"--output_dir={output}"])
    return output


def test_the_hand_tells_the_workplace_and_its_memory_alone_learns(
    policy: OpenSPMPolicy,
    checkpoint: Path,
    changed: Callable[[str, Memory], Path],
    recorded: list[list[Frame]],
    tmp_path: Path,
):
    far = changed("far", elsewhere(read_memory(checkpoint)))
    both = OpenSPMPolicy.from_pretrained(joined(far, checkpoint))
    here = [recorded[0], recorded[3]]
    assert torch.equal(act(both, here), act(policy, here))
    assert [one.workplace for one in both.episodes] == [1, 1]
    both.report_successes([True, False])
    assert not any(entry.trials for entry in both.require_memory().entries)
    both.save_pretrained(tmp_path / "saved")
    again = OpenSPMPolicy.from_pretrained(tmp_path / "saved")
    assert sorted(e.trials for e in again.elsewhere[0].entries) == [0, 0, 0, 0, 1, 1]
    assert torch.equal(act(again, here[:1]), act(policy, here[:1]))


def test_where_the_hand_does_not_tell_the_instruction_does(
    checkpoint: Path, changed: Callable[[str, Memory], Path], recorded: list[list[Frame]]
):
    memory = read_memory(checkpoint)
    tasks = sorted({entry.language for entry in memory.entries})
    paths = [
        changed(f"only_{i}", replace(memory, entries=tuple(e for e in memory.entries if e.language == task)))
        for i, task in enumerate(tasks)
    ]
    both = OpenSPMPolicy.from_pretrained(joined(*paths))
    batch = batch_of([recorded[0][0], recorded[3][0]])
    both.select_action(batch)
    assert [one.workplace for one in both.episodes] == [tasks.index(task) for task in batch["task"]]


def test_a_hand_at_the_edge_of_what_was_covered_is_still_there(
    policy: OpenSPMPolicy,
    checkpoint: Path,
    changed: Callable[[str, Memory], Path],
    recorded: list[list[Frame]],
):
    memory, batch = read_memory(checkpoint), batch_of([recorded[0][0]])
    stove, bowl = (
        replace(memory, entries=tuple(e for e in memory.entries if e.language == recorded[i][0]["task"]))
        for i in (3, 0)
    )
    # By millimetres the hand begins outside of where the demonstrations of the bowl had it.
    (observation,) = split_batch(batch, policy.config.layouts()[0])
    edge = memory.robot.workspace.copy()
    edge[0, 0] = observation.hand.T_world_ee[0, 3] + 0.004
    bowl = replace(bowl, robot=replace(memory.robot, workspace=edge))
    both = OpenSPMPolicy.from_pretrained(joined(changed("stove", stove), changed("bowl", bowl)))
    both.select_action(batch)
    assert both.episodes[0].workplace == 1


def test_where_one_demonstration_shows_all_is_better_than_where_several_do():
    each = [
        entry("put the bowl on the plate", source="a/b#1"),
        entry("put the cup on the plate", source="a/b#2"),
    ]
    both = [replace(one, source=f"a/b#{i}") for one, i in zip(each, ("3", "3.2"), strict=True)]
    instruction = "put the bowl on the plate and put the cup on the plate"
    assert _knows(instruction, both, TABLE_NAMES) > _knows(instruction, each, TABLE_NAMES)
    assert _knows(instruction, each, TABLE_NAMES) > _knows(instruction, each[:1], TABLE_NAMES)


def test_what_is_asked_twice_is_shown_by_what_does_it_twice():
    once = [entry("put the pot on the stove", source=f"a/b#{i}") for i in (1, 2)]
    twice = [replace(one, source=f"a/b#{i}") for one, i in zip(once, ("3", "3.2"), strict=True)]
    merged = [replace(once[0], source="a/b#3, a/b#3.2")]
    instruction = "put both pots on the stove"
    assert _knows(instruction, twice, TABLE_NAMES) > _knows(instruction, once, TABLE_NAMES)
    assert _knows(instruction, merged, TABLE_NAMES) == _knows(instruction, twice, TABLE_NAMES)


def test_a_workplace_knows_what_its_things_looks_alone_let_it_do():
    looks = [UNKNOWN_LOOKS, LOOKS]  # of a plate that was never grasped, and can be taken by its rim
    here = np.zeros((2, 3))
    memories = [
        cast(Memory, SimpleNamespace(robot=SimpleNamespace(workspace=here), looks=one)) for one in looks
    ]
    hand = SimpleNamespace(T_world_ee=np.eye(4))
    observation = cast(Observation, SimpleNamespace(hand=hand, instruction="put the plate on the stove"))
    entries = [[by_the_rim(), PUSHED]] * 2
    assert choose(observation, memories, entries, TABLE_NAMES) == 1


@pytest.mark.parametrize("source", ["a/b#20", "a/b#20.2"])
def test_what_is_done_a_second_time_is_of_the_same_demonstration(source):
    assert demonstration_of(source) == "a/b#20"


def test_workplaces_of_joined_policies_are_joined_too(
    checkpoint: Path, changed: Callable[[str, Memory], Path], capsys: pytest.CaptureFixture[str]
):
    far = changed("far", elsewhere(read_memory(checkpoint)))
    both = joined(far, checkpoint)
    output = both.with_name("three")
    capsys.readouterr()
    join([f"--policy.paths=[{checkpoint},{both}]", f"--output_dir={output}"])
    told = json.loads(capsys.readouterr().out)
    assert told == {"output": str(output), "workplaces": 3, "entries": [6, 6, 6]}
    assert len(OpenSPMPolicy.from_pretrained(output).elsewhere) == 2


def test_a_checkpoint_holds_as_many_workplaces_as_its_memory_says(
    policy: OpenSPMPolicy, checkpoint: Path, changed: Callable[[str, Memory], Path]
):
    both = joined(changed("far", elsewhere(read_memory(checkpoint))), checkpoint)
    pulled = Path(shutil.copytree(both, both.with_name("pulled")))
    shutil.rmtree(pulled / "workplaces" / "1")
    with pytest.raises(MemoryFormatError, match=r"no memory at .*workplaces/1/memory\.json"):
        OpenSPMPolicy.from_pretrained(pulled)
    # The Hub keeps the others' files.
    one = Path(shutil.copytree(checkpoint, both.with_name("one")))
    shutil.copytree(both / "workplaces", one / "workplaces")
    assert OpenSPMPolicy.from_pretrained(one).elsewhere == ()
    policy.save_pretrained(both)
    assert OpenSPMPolicy.from_pretrained(both).elsewhere == ()
    assert not (both / "workplaces" / "1").exists()


def test_what_cannot_be_joined_is_named_and_nothing_is_written(checkpoint: Path, tmp_path: Path):
    config = json.loads((checkpoint / "config.json").read_text())
    cases = [([checkpoint], "got 1 checkpoints to join, expected at least two")]
    for name, value in (
        ("control_hz", 7.0),
        ("hand_radius_m", 0.05),
        ("lexicon", '{"synonyms": {"bowl": ["tureen"]}}'),
        ("name_embeddings", "somebody/model"),
        ("execution", "open_loop"),
        ("tracking", False),
    ):
        other = Path(shutil.copytree(checkpoint, tmp_path / name))
        (other / "config.json").write_text(json.dumps({**config, name: value}))
        cases.append(([checkpoint, other], f"its {name} is "))
    for paths, words in cases:
        options = [f"--policy.paths=[{','.join(map(str, paths))}]", f"--output_dir={tmp_path / 'joined'}"]
        with pytest.raises(OpenSPMError, match=words):
            join(options)
        assert not (tmp_path / "joined").exists()
    with pytest.raises(OpenSPMError, match="exists already"):
        join([f"--policy.paths=[{checkpoint},{checkpoint}]", f"--output_dir={other}"])
