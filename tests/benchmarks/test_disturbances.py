import numpy as np
import pytest
from benchmarks.disturbances import GRASPED, Disturbance, move_cameras
from benchmarks.worlds import TabletopWorld
from tests.policy.lerobot_commands import CALIBRATION

from lerobot_openspm.envs.tabletop import placement as layout
from lerobot_openspm.envs.tabletop.env import TabletopEnv
from lerobot_openspm.envs.tabletop.experts import expert_actions
from lerobot_openspm.envs.tabletop.simulator import TabletopSimulator
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import load_cameras, project

SEED = 2_000_010


def disturbed(kind: str, task: str = "bowl_on_plate") -> tuple[TabletopWorld, list[np.ndarray], Disturbance]:
    """An expert that knows nothing of it is disturbed; poses of what it grasps, step by step."""
    world = TabletopWorld(TabletopEnv(task=task), SEED)
    disturbance = Disturbance(world, kind, np.random.default_rng(0))
    poses = []
    expert = expert_actions(world.env.simulator, task, np.random.default_rng(SEED))
    for step, action in enumerate(expert):
        poses.append(world.object_poses()[GRASPED[task]])
        disturbance(step)
        if disturbance.step is not None:
            poses.append(world.object_poses()[GRASPED[task]])
            break
        world.step(action)
    return world, poses, disturbance


@pytest.mark.parametrize("kind", ["displaced", "dropped"])
def test_a_disturbance_puts_the_object_elsewhere_on_the_table_once(kind: str):
    world, poses, disturbance = disturbed(kind)
    assert disturbance.step is not None
    way = np.linalg.norm(poses[-1][:2, 3] - poses[-2][:2, 3])
    assert 0.05 <= way <= 0.15
    assert poses[-1][2, 3] == pytest.approx(poses[0][2, 3], abs=1e-9)
    lifted = poses[-2][2, 3] - poses[0][2, 3]
    assert lifted > 0.03 if kind == "dropped" else lifted == pytest.approx(0, abs=1e-3)
    T_before = world.object_poses()
    disturbance(disturbance.step + 1)
    np.testing.assert_array_equal(world.object_poses()["bowl"], T_before["bowl"])
    placed = {n: layout.Placement(T[0, 3], T[1, 3], float(se3.yaw_of(T))) for n, T in T_before.items()}
    assert layout.is_admissible(placed), "it can be grasped there"


def test_every_task_that_puts_something_has_something_to_take_away():
    assert GRASPED["box_in_bowl"] == "box"
    assert GRASPED["bowl_in_top_drawer"] == "bowl"
    assert "push_plate" not in GRASPED
    assert len(GRASPED) == 7


def test_moved_cameras_see_the_world_from_where_their_calibration_says():
    simulator = TabletopSimulator()
    simulator.reset(layout.sample_layout(np.random.default_rng(SEED)))
    cameras = load_cameras(CALIBRATION)
    moved = move_cameras(simulator, cameras, np.random.default_rng(4))
    for key, camera in moved.items():
        metres, radians = se3.distances(camera.T_mount_cam, cameras[key].T_mount_cam)
        if camera.mount == "ee":
            assert (metres, radians) == (0, 0)
            continue
        assert 0 < metres <= 0.10
        assert 0 < np.rad2deg(radians) <= 10
        # The bowl is where the new calibration puts it: its blue is there.
        image = simulator.render(key.rsplit(".", 1)[1], 256, 256).astype(int)
        middle = simulator.object_poses()["bowl"][:3, 3] + [0, 0, 0.02]
        uv, _ = project(camera, camera.T_mount_cam, middle)
        patch = image[round(float(uv[1])), round(float(uv[0]))]
        assert patch[2] > patch[0] + 30, "blue"
