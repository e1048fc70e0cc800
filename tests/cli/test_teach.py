"""`openspm teach`, typed as a user types it, on the tests' small checkpoint."""

import json
import math
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from filelock import FileLock
from tests.cli.conftest import Openspm
from tests.conftest import record
from tests.memory.memory_files import names

from lerobot_openspm.files import LOCK_WAIT_S
from lerobot_openspm.memory.io import LOCK, read_memory, write_memory
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.modeling_openspm import OpenSPMPolicy

PUSH = "push the plate to the front of the stove"
BOX = "put the cream cheese box in the bowl"


@pytest.fixture(scope="session")
def box_dataset(make_once: Callable[..., Path]) -> Path:
    """One demonstration of a task with an object that the tiny dataset does not show."""
    return make_once("box_dataset", lambda root: record(root, "box_in_bowl", 1))


@pytest.fixture
def into(checkpoint: Path, tmp_path: Path) -> Path:
    """A checkpoint to teach."""
    return Path(shutil.copytree(checkpoint, tmp_path / "checkpoint"))


@pytest.fixture
def spoiled(other_dataset: Path, tmp_path: Path) -> Path:
    """A dataset to spoil."""
    return Path(shutil.copytree(other_dataset, tmp_path / "dataset"))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def last_line(out: str) -> dict:
    return json.loads(out.splitlines()[-1])


def test_a_task_is_appended_and_the_weights_stay(openspm: Openspm, into: Path, other_dataset: Path):
    before, known = contents(into), read_memory(into)
    code, out, err = openspm(
        "teach", f"--dataset.root={other_dataset}", "--dataset.episodes=[1]", f"--into={into}"
    )
    assert code == 0, err
    summary = last_line(out)
    assert summary.pop("seconds") > 0
    assert summary == {
        "taught": [PUSH], "entries": 1, "entries_in_memory": len(known.entries) + 1,
        "entries_known_before": 0, "skipped": [], "objects_learned": [],
        "objects_recognised": ["plate", "stove"], "output": str(into),
    }  # fmt: skip
    assert f"{PUSH!r}: 1 new entry\n" in out
    after = contents(into)
    same = {name for name in before if before[name] == after.get(name)}
    assert {"config.json", "model.safetensors"} <= same
    assert set(after) == {*same, *names(into), LOCK}
    taught = read_memory(into)
    assert [entry.language for entry in taught.entries] == [e.language for e in known.entries] + [PUSH]
    assert taught.entries[-1].source.endswith("#1")


def test_an_unknown_object_is_learned_from_one_demonstration(
    openspm: Openspm, into: Path, box_dataset: Path, tmp_path: Path
):
    before, output = contents(into), tmp_path / "new" / "checkpoint"
    arguments = ("teach", f"--dataset.root={box_dataset}", f"--into={into}", f"--output={output}")
    code, out, err = openspm(*arguments)
    assert code == 0, err
    assert last_line(out)["objects_learned"] == ["cream cheese box"]
    assert last_line(out)["objects_recognised"] == ["bowl"]
    assert contents(into) == before
    assert contents(output)["model.safetensors"] == before["model.safetensors"]
    assert "cream cheese box" in read_memory(output).objects
    code, _, err = openspm(*arguments)
    assert code == 2
    assert f"{output} exists already; choose another --output" in err


def test_what_the_memory_knows_already_is_said(openspm: Openspm, into: Path, other_dataset: Path):
    arguments = ("teach", f"--dataset.root={other_dataset}", f"--into={into}", "--dataset.episodes=[0]")
    openspm(*arguments)
    code, out, _ = openspm(*arguments[:-1], "--dataset.episodes=[1]")
    assert code == 0
    assert f"{PUSH!r}: 1 new entry, beside 1 that the memory had" in out
    assert last_line(out)["entries_known_before"] == 1
    # The same episode again takes the place of its entry.
    code, out, _ = openspm(*arguments[:-1], "--dataset.episodes=[1]")
    assert last_line(out)["entries_in_memory"] == 8
    assert read_memory(into).entries[-1].version == 2


class Meanwhile:
    """Another process that changes the memory at the end of the first lesson."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, change: Callable[..., Memory]):
        self.lessons, teach, load = 0, OpenSPMPolicy.teach, read_memory
        self.locked: list[bool] = []

        def teach_slowly(policy: OpenSPMPolicy, *arguments):
            lesson = teach(policy, *arguments)
            self.lessons += 1
            if self.lessons == 1:
                write_memory(change(load(folder), policy.require_memory()), folder)
            return lesson

        def load_and_look(directory: Path) -> Memory:
            self.locked.append(FileLock(directory / LOCK, LOCK_WAIT_S, is_singleton=True).is_locked)
            return load(directory)

        monkeypatch.setattr(OpenSPMPolicy, "teach", teach_slowly)
        monkeypatch.setattr("lerobot_openspm.cli.teach.read_memory", load_and_look)


def test_what_others_changed_during_the_lesson_is_kept(
    openspm: Openspm, into: Path, other_dataset: Path, monkeypatch: pytest.MonkeyPatch
):
    known = read_memory(into)

    def without_the_first(now: Memory, _: Memory) -> Memory:
        return replace(now, entries=now.entries[1:], superseded=now.entries[:1])

    meanwhile = Meanwhile(monkeypatch, into, without_the_first)
    code, out, err = openspm(
        "teach", f"--dataset.root={other_dataset}", "--dataset.episodes=[1]", f"--into={into}"
    )
    assert code == 0, err
    taught = read_memory(into)
    assert [e.source for e in taught.entries[:-1]] == [e.source for e in known.entries[1:]]
    assert [e.source for e in taught.superseded] == [known.entries[0].source]
    assert taught.entries[-1].language == PUSH
    assert last_line(out)["entries_in_memory"] == len(known.entries)
    assert (meanwhile.lessons, meanwhile.locked) == (1, [True])


def test_an_object_that_others_learned_during_the_lesson_is_theirs(
    openspm: Openspm, into: Path, box_dataset: Path, monkeypatch: pytest.MonkeyPatch
):
    def with_another_box(now: Memory, taught: Memory) -> Memory:
        model = taught.objects["cream cheese box"]
        return replace(now, objects={**now.objects, model.name: replace(model, yaw_period=math.pi / 2)})

    meanwhile = Meanwhile(monkeypatch, into, with_another_box)
    code, out, err = openspm("teach", f"--dataset.root={box_dataset}", f"--into={into}")
    assert code == 0, err
    assert meanwhile.lessons == 2
    assert last_line(out)["objects_learned"] == []
    assert "cream cheese box" in last_line(out)["objects_recognised"]
    taught = read_memory(into)
    assert taught.objects["cream cheese box"].yaw_period == math.pi / 2
    assert taught.entries[-1].language == BOX


def rename_state(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    names = info["features"]["observation.state"]["names"]
    info["features"]["observation.state"]["names"] = [f"joint_{i}" for i in range(len(names))]
    (dataset / "meta/info.json").write_text(json.dumps(info))


def rename_camera(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    info["features"]["observation.images.top"] = info["features"].pop("observation.images.front")
    (dataset / "meta/info.json").write_text(json.dumps(info))


def no_instruction(dataset: Path) -> None:
    for file in (dataset / "meta/episodes").rglob("*.parquet"):
        table = pd.read_parquet(file)
        table["tasks"] = [[""] for _ in range(len(table))]
        table.to_parquet(file)


def cameras_that_look_away(dataset: Path) -> None:
    path = dataset / "meta/openspm_cameras.json"
    calibration = json.loads(path.read_text())
    for camera in calibration["cameras"].values():
        camera["T_mount_cam"] = [[*row[:3], row[3] + 5.0] for row in camera["T_mount_cam"][:3]] + [
            [0, 0, 0, 1]
        ]
    path.write_text(json.dumps(calibration))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda dataset: shutil.rmtree(dataset / "meta"), "no dataset in"),
        (lambda dataset: shutil.rmtree(dataset / "data"), "dataset 'local/openspm_tabletop' is not whole in"),
        (rename_state, "the state of dataset local/openspm_tabletop is ['joint_0', "),
        (rename_camera, "cameras['observation.images.front'] has no images here"),
        (
            no_instruction,
            "episode 0 of dataset local/openspm_tabletop has the task '', expected an instruction to find it",
        ),
        (cameras_that_look_away, "the objects they belong to were found in none; check --policy.cameras"),
    ],
)
def test_what_cannot_be_taught_is_one_line_and_changes_nothing(
    openspm: Openspm, into: Path, spoiled: Path, spoil: Callable[[Path], None], message: str
):
    before = contents(into)
    spoil(spoiled)
    code, out, err = openspm("teach", f"--dataset.root={spoiled}", f"--into={into}")
    assert code == 2
    assert "{" not in out
    error = err[err.index("openspm teach: ") :]
    assert message in error
    assert len(error.splitlines()) == 1
    assert contents(into) == before


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--dataset.episodes=[7]", "has episodes 0 to 1, got [7]"),
        ("--dataset.episodes=[]", "no episode of dataset local/openspm_tabletop is asked for"),
        ("--into=nowhere", "no checkpoint of this policy at nowhere: it has no config.json"),
        ("--policy.cameras=nowhere.json", "no calibration file at nowhere.json"),
        ("--policy.segmenter.sam3d_python=nowhere", "are for shape 'sam3d', got 'demonstrations'"),
    ],
)
def test_wrong_options_are_one_line_and_change_nothing(
    openspm: Openspm, into: Path, other_dataset: Path, option: str, message: str
):
    before = contents(into)
    code, _, err = openspm("teach", f"--dataset.root={other_dataset}", f"--into={into}", option)
    assert code == 2
    assert message in err.splitlines()[-1]
    assert contents(into) == before


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["Finding objects", "Reading images"])
def test_a_kill_leaves_the_checkpoint_as_it_was(
    openspm: Openspm, into: Path, other_dataset: Path, moment: str
):
    before = contents(into)
    code = "from lerobot_openspm.cli.main import main; main()"
    arguments = [f"--dataset.root={other_dataset}", f"--into={into}"]
    with subprocess.Popen(
        [sys.executable, "-c", code, "teach", *arguments], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    ) as process:
        assert process.stderr is not None
        told = b""
        while moment.encode() not in told:
            piece = process.stderr.read(1)
            assert piece, told.decode()
            told += piece
        process.kill()
    assert process.returncode == -signal.SIGKILL
    assert contents(into) == before
    assert openspm("teach", *arguments)[0] == 0


def test_a_copy_that_was_interrupted_is_made_anew(
    openspm: Openspm, into: Path, other_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    output = tmp_path / "taught"
    arguments = ("teach", f"--dataset.root={other_dataset}", f"--into={into}", f"--output={output}")
    with monkeypatch.context() as patch:

        def stop(*_: object) -> None:
            raise KeyboardInterrupt

        patch.setattr("lerobot_openspm.cli.teach.write_memory", stop)
        assert openspm(*arguments)[0] == 130
    assert not output.exists()
    assert openspm(*arguments)[0] == 0
    assert len(read_memory(output).entries) == 8
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
