"""Cameras recovered from the tracks of known points."""

import math

import numpy as np
import pytest
from tests.calibration.known_points import FOCAL, SIZE, camera, follow, hand_paths, held_in_the_hand

from lerobot_openspm.calibration.estimate import Estimate, estimate_camera
from lerobot_openspm.calibration.tracks import Track
from lerobot_openspm.errors import CalibrationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera

FOV_DEG = math.degrees(2 * math.atan(SIZE / 2 / FOCAL))


def run(tracks: list[Track], paths: list[np.ndarray], truth: Camera, **options) -> Estimate:
    given = {"fov_deg": FOV_DEG, "mirrored": None, "rng": np.random.default_rng(0), **options}
    return estimate_camera(tracks, paths, width=SIZE, height=SIZE, mount=truth.mount, **given)


def scene(
    mount: str, *, mirrored: bool = False, turning: bool = True, outliers: int = 12, noise_px: float = 0.2
):
    rng = np.random.default_rng(3)
    truth = camera(mount, mirrored)
    paths = hand_paths(rng, 6, 90, turning=turning)
    return truth, paths, follow(rng, truth, paths, 30, outliers, noise_px)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("mount", ["world", "ee"])
def test_pose_and_mirroring_are_recovered_among_outliers(mount: str, mirrored: bool):
    truth, paths, tracks = scene(mount, mirrored=mirrored)
    found = run(tracks, paths, truth)
    metres, radians = se3.distances(found.camera.T_mount_cam, truth.T_mount_cam)
    assert metres < 0.003
    assert radians < np.deg2rad(0.2)
    assert (found.camera.fx < 0) == mirrored
    assert found.reprojection_px < 3 * 0.2 * math.sqrt(2)
    # The estimate knows how exact it is, within what one sample can tell.
    assert 0.2 * metres < found.position_sd_m < 0.005


@pytest.mark.parametrize("mount", ["world", "ee"])
def test_the_focal_length_is_found_too(mount: str):
    truth, paths, tracks = scene(mount, noise_px=0.1)
    found = run(tracks, paths, truth, fov_deg=None)
    assert found.camera.fy == pytest.approx(FOCAL, rel=0.01)
    assert se3.distances(found.camera.T_mount_cam, truth.T_mount_cam)[0] < 0.01
    assert 0 < found.focal_sd < 0.02


@pytest.mark.parametrize("mount", ["world", "ee"])
def test_a_hand_that_never_turns_is_refused(mount: str):
    truth, paths, tracks = scene(mount, turning=False)
    with pytest.raises(CalibrationError, match="record episodes in which the hand turns about two axes"):
        run(tracks, paths, truth)


def test_things_held_while_the_hand_turns_do_not_decide():
    truth, paths, tracks = scene("ee")
    tracks += held_in_the_hand(0, 90) + held_in_the_hand(1, 90)
    found = run(tracks, paths, truth)
    assert se3.distances(found.camera.T_mount_cam, truth.T_mount_cam)[0] < 0.005


def test_the_wrong_sense_of_mirroring_is_refused():
    truth, paths, tracks = scene("world", mirrored=True)
    with pytest.raises(CalibrationError):
        run(tracks, paths, truth, mirrored=False)


def test_outliers_alone_are_refused():
    truth, paths, _ = scene("world")
    tracks = follow(np.random.default_rng(1), truth, paths, 0, 40)
    with pytest.raises(CalibrationError):
        run(tracks, paths, truth)


@pytest.mark.parametrize("count", [0, 5])
def test_too_few_tracks_are_refused(count: int):
    truth, paths, tracks = scene("world", outliers=0)
    with pytest.raises(CalibrationError, match=r"features were seen to move .* --episodes"):
        run(tracks[:count], paths, truth)


def test_the_same_seed_gives_the_same_camera():
    truth, paths, tracks = scene("world")
    first, second = (run(tracks, paths, truth).camera.T_mount_cam for _ in range(2))
    assert np.array_equal(first, second)
