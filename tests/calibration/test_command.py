"""`openspm calibrate` on rendered demonstrations, typed as a user types it."""

import functools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lerobot_openspm.cli.calibrate import choose_episodes
from lerobot_openspm.cli.main import main
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import load_cameras
from lerobot_openspm.mining.signals import Episode

WRIST = "observation.images.wrist"


@pytest.fixture
def calibrate(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple]:
    """Run `openspm calibrate` in this process; returns exit code, stdout and stderr."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["openspm", "calibrate", *arguments])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = int(str(stop.code))
        out, err = capsys.readouterr()
        return code, out, err

    return run


def reason(result: tuple[int, str, str]) -> str:
    code, out, err = result
    assert (code, out) == (2, "")
    assert "Traceback" not in err
    (line,) = [line for line in err.splitlines() if line.startswith("openspm calibrate: ")]
    return line


@pytest.fixture(scope="session")
def turning_dataset(make_once: Callable[..., Path]) -> Path:
    """Two demonstrations each of two tasks in which the hand turns about different axes."""
    from lerobot_openspm.envs.collection import CollectConfig, SimulatorConfig, collect

    env = SimulatorConfig(task="open_middle_drawer,turn_on_stove")
    config = functools.partial(CollectConfig, env, 2, height=160, width=160, workers=0)
    return make_once("turning_dataset", lambda root: collect(config(root=str(root))))


def test_a_dataset_that_is_not_there_is_one_line(calibrate: Callable[..., tuple], tmp_path: Path):
    assert "no dataset in" in reason(calibrate(f"--dataset.root={tmp_path / 'nowhere'}"))


@pytest.mark.slow
def test_the_hand_camera_is_found_and_other_cameras_are_kept(
    calibrate: Callable[..., tuple], turning_dataset: Path, tmp_path: Path
):
    truth = turning_dataset / "meta" / "openspm_cameras.json"
    output = tmp_path / "new" / "cameras.json"
    output.parent.mkdir()
    document = json.loads(truth.read_text())
    del document["cameras"][WRIST]
    output.write_text(json.dumps(document))
    code, out, err = calibrate(
        f"--dataset.root={turning_dataset}",
        f"--camera={WRIST}",
        "--mount=ee",
        "--fov_deg=75",
        f"--output={output}",
    )
    assert code == 0, err
    summary = json.loads(out.splitlines()[-1])
    assert list(summary) == ["camera", "reprojection_px", "file", "position_mm", "rotation_deg"]
    assert (summary["camera"], summary["file"]) == (WRIST, str(output))
    assert summary["reprojection_px"] < 1
    assert summary["position_mm"] < 5
    assert summary["rotation_deg"] < 0.5
    found, true = load_cameras(output), load_cameras(truth)
    assert set(found) == set(true)
    metres, radians = se3.distances(found[WRIST].T_mount_cam, true[WRIST].T_mount_cam)
    assert (1e3 * metres, np.rad2deg(radians)) == pytest.approx(
        (summary["position_mm"], summary["rotation_deg"]), abs=0.01
    )
    others = set(true) - {WRIST}
    assert all(np.array_equal(found[key].T_mount_cam, true[key].T_mount_cam) for key in others)


def test_the_wrong_mount_is_refused_and_nothing_is_written(
    calibrate: Callable[..., tuple], tiny_dataset: Path, tmp_path: Path
):
    output = tmp_path / "cameras.json"
    result = calibrate(
        f"--dataset.root={tiny_dataset}", f"--camera={WRIST}", "--fov_deg=75", f"--output={output}"
    )
    reason(result)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--camera=observation.images.roof", "has no camera 'observation.images.roof'; it has"),
        ("--mount=ceiling", "--mount is 'ceiling', expected 'world' or 'ee'"),
        ("--fov_deg=0", "--fov_deg is 0.0, expected 5 to 150 degrees"),
        ("--dataset.episodes=[99]", "got [99]"),
        ("--truth=nowhere.json", "no calibration file at nowhere.json"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    calibrate: Callable[..., tuple], tiny_dataset: Path, tmp_path: Path, option: str, words: str
):
    output = tmp_path / "cameras.json"
    assert words in reason(calibrate(f"--dataset.root={tiny_dataset}", f"--output={output}", option))
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_file_is_not_overwritten(
    calibrate: Callable[..., tuple], tiny_dataset: Path, tmp_path: Path
):
    output = tmp_path / "cameras.json"
    output.write_text('{"format": "openspm-cam')
    assert "not JSON" in reason(calibrate(f"--dataset.root={tiny_dataset}", f"--output={output}"))
    assert output.read_text() == '{"format": "openspm-cam'


def test_episodes_are_chosen_from_every_task_those_that_turn_first():
    def episode(index: int, task: str, turn: float) -> Episode:
        T = se3.from_yaw(np.zeros((5, 3)), np.linspace(0, turn, 5))
        return Episode(index, task, 0, T, np.zeros(5), np.zeros((5, 7)))

    episodes = [episode(0, "a", 0.1), episode(1, "a", 1.0), episode(2, "b", 0.5), episode(3, "c", 0.9)]
    assert [e.index for e in choose_episodes(episodes, 2)] == [3, 2]
    assert [e.index for e in choose_episodes(episodes, 9)] == [3, 2, 0, 1]
