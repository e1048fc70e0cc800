"""What demonstrations cannot teach is told by mining, training and inspecting, with its reason."""

import copy
import json
from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest
from tests.cli.conftest import Openspm
from tests.policy.lerobot_commands import (
    CALIBRATION,
    call_lerobot,
    pretrained,
    train_arguments,
    training_options,
)

from lerobot_openspm.envs.collection import CollectConfig, SimulatorConfig, collect
from lerobot_openspm.envs.tabletop import simulator
from lerobot_openspm.memory.io import read_memory

BOWL, STOVE = "put the bowl on the plate", "turn on the stove"
TABLE_COLOUR = (0.76, 0.65, 0.50)


def record_unseen(root: Path, colour: tuple[float, ...], tasks: str) -> None:
    """Record demonstrations in which the bowl looks otherwise than it is."""
    compiled = simulator.compiled_model

    def disguised(second_bowl: bool = False) -> mujoco.MjModel:
        model = copy.copy(compiled(second_bowl))
        own = model.geom_bodyid == model.body("bowl").id
        model.geom_rgba[own, : len(colour)] = colour
        return model

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(simulator, "compiled_model", disguised)
        collect(CollectConfig(SimulatorConfig(task=tasks), 3, str(root), height=128, width=128, workers=0))


@pytest.fixture(scope="session")
def invisible_bowl(make_once: Callable[..., Path]) -> Path:
    """Demonstrations of bowl_on_plate with a bowl that no picture shows, and of turn_on_stove."""
    tasks = "bowl_on_plate,turn_on_stove"
    return make_once("invisible_bowl", lambda root: record_unseen(root, (*TABLE_COLOUR, 0.0), tasks))


def mine(openspm: Openspm, dataset: Path, output: Path, *more: str) -> tuple[int, str, str]:
    return openspm(
        "mine", f"--dataset.root={dataset}", f"--output={output}", f"--policy.cameras={CALIBRATION}", *more
    )


def test_mining_and_inspecting_say_what_could_not_be_learned(
    openspm: Openspm,
    invisible_bowl: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
):
    code, out, _ = mine(openspm, invisible_bowl, tmp_path / "memory")
    assert code == 0
    told = json.loads(out.splitlines()[-1])["not_learned"]
    assert [(one["what"], one["name"], one["demonstrations"]) for one in told] == [
        ("object", "bowl", 3), ("instruction", BOWL, 3),
    ]  # fmt: skip
    assert "nothing where the hand touched it stands out" in told[0]["reason"]
    assert "'bowl' is handled in 3 demonstrations and could not be learned: nothing where" in caplog.text
    assert f"{BOWL!r} is not learned: none of its 3 demonstrations is kept" in caplog.text
    memory = read_memory(tmp_path / "memory")
    assert {entry.language for entry in memory.entries} == {STOVE}
    assert sorted(memory.objects) == ["plate", "stove"]
    _, out, _ = openspm("inspect", f"--path={tmp_path / 'memory'}")
    assert "'bowl' is handled in 3 demonstrations and could not be learned: nothing where" in out
    assert json.loads(out.splitlines()[-1])["not_learned"] == told


def test_training_says_it_too_and_keeps_it_in_the_checkpoint(
    invisible_bowl: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    options = training_options(invisible_bowl, tmp_path / "run", steps=1)
    call_lerobot("lerobot-train", *train_arguments(*options))
    assert "'bowl' is handled in 3 demonstrations and could not be learned" in "".join(capfd.readouterr())
    (bowl, instruction) = read_memory(pretrained(tmp_path / "run")).not_learned
    assert (bowl.name, instruction.name) == ("bowl", BOWL)


def test_where_nothing_remains_the_error_says_why(
    openspm: Openspm,
    invisible_bowl: Path,
    tmp_path: Path,
):
    code, _, err = mine(openspm, invisible_bowl, tmp_path / "memory", "--policy.memory_episodes=[0,1,2]")
    assert code == 2
    (error,) = [line for line in err.splitlines() if line.startswith("openspm mine: ")]
    assert "What could not be learned: 'bowl': " in error
    assert not (tmp_path / "memory").exists()
