"""`openspm`, typed as a user types it; the commands that do work are called in this process."""

import json
import subprocess
from pathlib import Path

import pytest
from lerobot.datasets import LeRobotDataset
from tests.cli.conftest import Openspm
from tests.memory.memory_files import names
from tests.policy.lerobot_commands import CALIBRATION, run_command

from lerobot_openspm.cli.main import COMMANDS
from lerobot_openspm.envs.tabletop.tasks import ANY_TASK

BOWL, STOVE = "put the bowl on the plate", "turn on the stove"


def last_line(text: str) -> dict:
    return json.loads(text.splitlines()[-1])


def test_the_installed_command_lists_its_commands():
    done: subprocess.CompletedProcess[str] = run_command("openspm", "--help")
    assert done.returncode == 0
    assert all(f"  {name}" in done.stdout for name in COMMANDS)


def test_without_arguments_it_helps(openspm: Openspm):
    assert openspm() == openspm("-h")


def test_an_unknown_command_is_named_with_the_known_ones(openspm: Openspm):
    code, out, err = openspm("juggle")
    assert (code, out) == (2, "")
    assert err == f"openspm: unknown command 'juggle'; expected one of {', '.join(COMMANDS)}\n"


@pytest.mark.parametrize("command", ["collect", "calibrate", "mine", "inspect"])
def test_a_command_lists_its_options(openspm: Openspm, command: str):
    code, out, _ = openspm(command, "--help")
    assert code == 0
    assert out.startswith(f"usage: openspm {command} [-h]")
    options = {
        "collect": "--episodes",
        "calibrate": "--fov_deg",
        "mine": "--policy.cameras",
        "inspect": "--instruction",
    }
    assert options[command] in out


def test_mining_then_inspecting(openspm: Openspm, tiny_dataset: Path, checkpoint: Path, tmp_path: Path):
    memory, annotated = tmp_path / "memory", tmp_path / "annotated"
    code, out, _ = openspm(
        "mine", f"--dataset.root={tiny_dataset}", f"--output={memory}", f"--policy.cameras={CALIBRATION}",
        f"--annotated={annotated}",
    )  # fmt: skip
    assert code == 0
    summary = last_line(out)
    assert set(summary) >= {"entries", "episodes", "key_poses", "objects", "output", "seconds"}
    assert (summary["entries"], summary["episodes"]) == (6, 6)
    assert summary["objects"] == ["bowl", "plate", "stove"]
    assert sorted(path.name for path in memory.iterdir()) == sorted(names(memory))
    # Mining is deterministic: training mined the same in another process, to the last bit.
    assert {name: (memory / name).read_bytes() for name in names(memory)} == {
        name: (checkpoint / name).read_bytes() for name in names(checkpoint)
    }
    assert summary["annotated"] == str(annotated)
    written = LeRobotDataset("local/openspm_tabletop", root=annotated, video_backend="pyav")
    assert sum(written.hf_dataset.with_format("numpy")["openspm.is_key_pose"]) == summary["key_poses"]
    assert written[0]["openspm.phase"] == "approach"

    code, out, _ = openspm("inspect", f"--path={memory}")
    assert code == 0
    known_by = dict.fromkeys(summary["objects"], "shape")
    assert last_line(out) == {
        "entries": 6, "shown": 6, "per_task": {BOWL: 3, STOVE: 3}, "objects": known_by,
    }  # fmt: skip
    assert out.count("grasp") >= 3

    _, out, _ = openspm("inspect", f"--path={memory}", "--instruction=stove", "--limit=2")
    assert last_line(out)["shown"] == 2
    assert BOWL not in out.rsplit("\n", 2)[0]


def test_a_trained_checkpoint_can_be_inspected(openspm: Openspm, checkpoint: Path):
    code, out, _ = openspm("inspect", f"--path={checkpoint}")
    assert (code, last_line(out)["entries"]) == (0, 6)


def one_line_error(result: tuple[int, str, str], command: str) -> str:
    code, out, err = result
    assert (code, out) == (2, "")
    errors = [line for line in err.splitlines() if line.startswith(f"openspm {command}: ")]
    assert len(errors) == 1
    assert "Traceback" not in err
    return errors[0]


def test_mining_without_a_calibration_is_one_line(openspm: Openspm, tiny_dataset: Path, tmp_path: Path):
    result = openspm("mine", f"--dataset.root={tiny_dataset}", f"--output={tmp_path / 'memory'}")
    assert "got none; pass --policy.cameras=FILE" in one_line_error(result, "mine")
    assert not (tmp_path / "memory").exists()


def test_mining_with_a_calibration_that_is_not_there_is_one_line(
    openspm: Openspm, tiny_dataset: Path, tmp_path: Path
):
    result = openspm(
        "mine",
        f"--dataset.root={tiny_dataset}",
        f"--output={tmp_path / 'memory'}",
        "--policy.cameras=nowhere.json",
    )
    assert "no calibration file at nowhere.json" in one_line_error(result, "mine")
    assert not (tmp_path / "memory").exists()


def test_annotating_into_a_folder_that_exists_is_one_line(
    openspm: Openspm, tiny_dataset: Path, tmp_path: Path
):
    result = openspm(
        "mine", f"--dataset.root={tiny_dataset}", f"--output={tmp_path / 'memory'}",
        f"--annotated={tmp_path}", f"--policy.cameras={CALIBRATION}",
    )  # fmt: skip
    assert "exists already; choose another --annotated" in one_line_error(result, "mine")
    assert list(tmp_path.iterdir()) == []


def test_inspecting_what_holds_no_memory_is_one_line(openspm: Openspm, tmp_path: Path):
    assert "no memory at" in one_line_error(openspm("inspect", f"--path={tmp_path}"), "inspect")


def test_collecting_into_a_recorded_folder_leaves_it_alone(openspm: Openspm, tiny_dataset: Path):
    before = {path: path.stat().st_mtime_ns for path in tiny_dataset.rglob("*") if path.is_file()}
    same = ("--env.task=bowl_on_plate,turn_on_stove", "--episodes=3", "--height=128", "--width=128")
    code, out, _ = openspm("collect", f"--root={tiny_dataset}", *same)
    assert code == 0
    assert "already holds 6 episodes; left alone" in out
    assert set(last_line(out)) == {"episodes", "frames", "discarded", "root", "seconds"}
    assert {path: path.stat().st_mtime_ns for path in tiny_dataset.rglob("*") if path.is_file()} == before


def test_collecting_something_else_into_a_recorded_folder_is_refused(openspm: Openspm, tiny_dataset: Path):
    error = one_line_error(openspm("collect", f"--root={tiny_dataset}", "--episodes=4"), "collect")
    assert "episodes is 3, asked was 4" in error
    assert "--overwrite=true" in error


def test_overwriting_a_foreign_folder_is_refused(openspm: Openspm, tmp_path: Path):
    (tmp_path / "precious.txt").write_text("keep")
    error = one_line_error(openspm("collect", f"--root={tmp_path}", "--overwrite=true"), "collect")
    assert "was not written by openspm collect" in error
    assert (tmp_path / "precious.txt").read_text() == "keep"


def test_collecting_into_a_foreign_folder_is_one_line(openspm: Openspm, tmp_path: Path):
    (tmp_path / "precious.txt").write_text("keep")
    error = one_line_error(openspm("collect", f"--root={tmp_path}"), "collect")
    assert "was not written by openspm collect" in error
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("collect", "--env.task=juggle"),
            f"or a comma list of: {', '.join(ANY_TASK)}",
        ),
        (("collect", "--episodes=0"), "episodes must be at least 1, got 0"),
        (("collect", "--episodes=abc"), "openspm collect: --episodes: Couldn't parse 'abc' into an int\n"),
        (("collect", "--overwrite=maybe"), "--overwrite: Couldn't parse 'maybe' into a bool\n"),
        (
            ("mine", "--policy.reach_margin_m=far"),
            "--policy.reach_margin_m: Couldn't parse 'far' into a float\n",
        ),
        (("mine", "--policy.execution=telepathy"), "telepathy"),
    ],
)
def test_a_bad_option_is_refused_without_a_traceback(
    openspm: Openspm, arguments: tuple[str, ...], words: str, tmp_path: Path
):
    target = f"--root={tmp_path / 'data'}" if arguments[0] == "collect" else f"--output={tmp_path / 'out'}"
    code, _, err = openspm(*arguments, target)
    assert code == 2
    assert "Traceback" not in err
    assert words in err
    assert not list(tmp_path.iterdir())
