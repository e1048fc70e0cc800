import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.recording import Tabletop
from lerobot_openspm.geometry.camera import cameras_from_dict, project

CAMERA_FILE = Path(__file__).parents[3] / "configs/cameras/openspm_tabletop.json"
DOCUMENT = Tabletop().calibration(256, 256)


def _world_from_camera(env, camera: str) -> np.ndarray:
    calibration = DOCUMENT["cameras"][f"observation.images.{camera}"]
    mount = env.simulator.ee_pose() if calibration["mount"] == "ee" else np.eye(4)
    return mount @ np.array(calibration["T_mount_cam"])


def test_file_is_what_the_simulator_says():
    assert json.loads(CAMERA_FILE.read_text()) == json.loads(json.dumps(DOCUMENT))


@pytest.mark.parametrize("camera", scene.CAMERA_NAMES)
def test_pose_agrees_with_mujoco(make_env, camera):
    env = make_env()
    env.reset(seed=0)
    env.step(np.array([1, 1, 0, 0.3, 0.2, 1, -1], np.float32))
    T_world_cam = _world_from_camera(env, camera)
    data = env.simulator.data.camera(camera)
    np.testing.assert_allclose(T_world_cam[:3, 3], data.xpos, atol=1e-6)
    np.testing.assert_allclose(T_world_cam[:3, :3] * (1, -1, -1), data.xmat.reshape(3, 3), atol=1e-6)


@pytest.mark.parametrize("camera", scene.CAMERA_NAMES)
def test_projection_hits_the_coloured_pixels(make_env, camera):
    """The burner is a flat disc: its pixels' centroid is that of its projected outline."""
    env = make_env(observation_height=256, observation_width=256)
    for seed in range(20):
        observation, _ = env.reset(seed=seed)
        for _ in range(12 if camera == "wrist" else 0):
            observation, *_ = env.step(np.array([-0.5, -0.9, 0, 0, 0, 0, -1], np.float32))
        pixels = _burner_pixels(observation["pixels"][camera])
        inside = len(pixels) > 100 and pixels.min() > 0 and pixels.max() < 255
        if not inside:
            continue
        angles = np.linspace(0, 2 * np.pi, 360, endpoint=False)
        xy = np.stack(
            [scene.BURNER_X + scene.BURNER_RADIUS * np.cos(angles), scene.BURNER_RADIUS * np.sin(angles)]
        )
        edge = np.vstack([xy, np.full(360, scene.BURNER_TOP), np.ones(360)])
        points = (env.simulator.object_poses()["stove"] @ edge).T[:, :3]
        calibrated = cameras_from_dict(DOCUMENT, "the simulator")[f"observation.images.{camera}"]
        outline, _ = project(calibrated, _world_from_camera(env, camera), points)
        moments = cv2.moments(outline.astype(np.float32))
        expected = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
        assert np.linalg.norm(pixels.mean(axis=0) - expected) < 0.5
        return
    pytest.fail(f"the burner was never fully in view of {camera}")


def _burner_pixels(image: np.ndarray) -> np.ndarray:
    red, green, blue = (image[..., i].astype(int) for i in range(3))
    rows, columns = np.nonzero((green > 120) & (blue > 130) & (red < 80))
    return np.stack([columns, rows], axis=1)
