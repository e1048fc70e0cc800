"""Which errors cameras are given, and what is counted, without a simulator."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.libero import wrong_calibration
from benchmarks.libero.wrong_calibration import WrongCalibrationConfig, errors, look_at_scene, spoilt, summary
from tests.memory.memories import a_memory

from lerobot_openspm.geometry import se3

FRONT = "observation.images.front"


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_is_off_along_or_about_one_of_its_axes(seed: int):
    found = errors(np.random.default_rng(seed))
    assert len(found) == 6
    for name, T in found.items():
        metres, radians = se3.distances(T, np.eye(4))
        is_shift = name.startswith("2 cm")
        assert metres == pytest.approx(0.02 if is_shift else 0.0)
        assert np.rad2deg(radians) == pytest.approx(0.0 if is_shift else 3.0)
        vector = T[:3, 3] if is_shift else se3.log_so3(T[:3, :3])
        assert "xyz"[int(np.argmax(np.abs(vector)))] == name[-1]


def test_the_side_is_drawn():
    sides = {np.sign(errors(np.random.default_rng(seed))["2 cm along x"][0, 3]) for seed in range(20)}
    assert sides == {-1.0, 1.0}


def test_only_the_camera_that_is_meant_is_off():
    memory, T_cam_off = a_memory(), se3.transform(np.eye(3), [0.02, 0.0, 0.0])
    camera, *others = memory.cameras
    off = spoilt(memory, camera, T_cam_off)
    true = memory.cameras[camera].T_mount_cam
    np.testing.assert_allclose(off.cameras[camera].T_mount_cam, true @ T_cam_off)
    assert all(off.cameras[name] is memory.cameras[name] for name in others)


def test_every_camera_and_error_is_looked_at_and_counted(monkeypatch: pytest.MonkeyPatch):
    memory = a_memory()
    camera, *_ = memory.cameras

    def told(seen_by, _):
        """Believes no camera that is off by 2 cm."""
        off_m = np.linalg.norm(
            seen_by.cameras[camera].T_mount_cam[:3, 3] - memory.cameras[camera].T_mount_cam[:3, 3]
        )
        return [camera] if off_m > 0.01 else []

    policy = SimpleNamespace(require_memory=lambda: memory)
    monkeypatch.setattr(wrong_calibration, "load", lambda _: policy)
    monkeypatch.setattr(wrong_calibration, "draw", lambda *_: (None, 5))
    monkeypatch.setattr(wrong_calibration, "observe", lambda *_: None)
    monkeypatch.setattr(wrong_calibration, "told", told)
    rows = [look_at_scene(WrongCalibrationConfig(), Path("x"), "a task", i) for i in range(2)]
    counted = summary(rows)
    assert counted["right"]["success"] == 0.0
    own = counted["cameras"][camera]
    for error, row in own.items():
        assert row["n"] == 2
        assert (row["success"], row["named"]) == ((1.0, 2) if error.startswith("2 cm") else (0.0, 0))


def test_no_two_scenes_have_the_same_seed():
    drawn = WrongCalibrationConfig(scenes=5).drawn(["one", "another"])
    assert [task for task, _ in drawn] == ["one", "another", "one", "another", "one"]
    assert len({seed for _, seed in drawn}) == 5


@pytest.mark.parametrize("told", [["observation.images.wrist"], [FRONT, "observation.images.wrist"]])
def test_an_error_for_which_another_camera_is_blamed_too_is_told_but_not_named(told: list[str]):
    row = {"right": [], "off": {FRONT: {"2 cm along x": told}}}
    counted = summary([row, {"right": [FRONT], "off": {FRONT: {"2 cm along x": []}}}])
    assert counted["cameras"][FRONT]["2 cm along x"]["success"] == 0.5
    assert counted["cameras"][FRONT]["2 cm along x"]["named"] == 0
    assert counted["right"]["success"] == 0.5


def test_none_of_anything_is_refused():
    with pytest.raises(ValueError, match="must be at least 1, got 0 and 2"):
        WrongCalibrationConfig(scenes=0)
    with pytest.raises(ValueError, match="must be at least 1, got 20 and 0"):
        WrongCalibrationConfig(workers=0)
