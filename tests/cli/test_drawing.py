"""Pictures of key poses: every mark can be seen, also where the hand is in one place for several phases."""

import numpy as np
import pytest

from lerobot_openspm.cli.drawing import PHASE_COLOURS, draw_key_poses
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.types import View

SIZE = 256
# From half a metre above, straight down.
T_WORLD_CAM = np.array([[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -1.0, 0.5], [0, 0, 0, 1.0]])
CAMERA = Camera(SIZE, SIZE, 300.0, 300.0, SIZE / 2, SIZE / 2, "world", T_WORLD_CAM)
WHITE = np.full((SIZE, SIZE, 3), 255, np.uint8)


def hand(x: float, y: float) -> np.ndarray:
    """``T_world_ee`` of a hand that points down."""
    T_world_ee = np.diag([1.0, -1.0, -1.0, 1.0])
    T_world_ee[:2, 3] = x, y
    return T_world_ee


@pytest.mark.parametrize("apart_m", [0.0, 0.001, 0.03])
def test_every_phase_is_marked_where_it_can_be_seen(apart_m: float):
    phases = ["approach", "grasp", "lift", "place", "release"]
    poses = [hand(0.02, apart_m * (i - 2)) for i in range(len(phases))]
    picture = draw_key_poses(View(WHITE, CAMERA, T_WORLD_CAM), poses, phases)
    picture[:100, :100] = 255  # the legend
    seen = {phase: int((picture == PHASE_COLOURS[phase]).all(axis=-1).sum()) for phase in phases}
    assert min(seen.values()) > 20, seen
