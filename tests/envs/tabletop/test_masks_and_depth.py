"""The simulator's own segmentation and depth, against the scene's geometry."""

import numpy as np
import pytest

from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.recording import Tabletop
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import cameras_from_dict, project, ray_directions

SIZE = 128
# Lowest and highest corner of each object in its own frame, metres, the cabinet's drawers closed.
EXTENTS = {
    "bowl": ((-0.056, -0.056, 0.0), (0.056, 0.056, scene.BOWL_HEIGHT)),
    "plate": ((-0.086, -0.086, 0.0), (0.086, 0.086, scene.PLATE_RIM_HEIGHT)),
    "box": ((-0.03, -0.02, 0.0), (0.03, 0.02, 0.03)),
    "bottle": ((-0.022, -0.022, 0.0), (0.022, 0.022, scene.BOTTLE_HEIGHT)),
    "rack": ((-0.07, -0.045, 0.0), (0.07, 0.045, 0.062)),
    "cabinet": ((-0.1, -0.13, 0.0), (0.151, 0.13, 0.215)),
    "stove": ((-0.11, -0.1, 0.0), (0.11, 0.1, 0.061)),
}
TABLE_Z = -0.0001


@pytest.fixture
def env(make_env):
    made = make_env(masks=True, depth=True)
    made.reset(seed=3)
    return made


@pytest.fixture
def observation(env):
    return env.step(np.zeros(7, np.float32))[0]


def camera_of(env, name):
    camera = cameras_from_dict(Tabletop().calibration(SIZE, SIZE), "tabletop")[f"observation.images.{name}"]
    return camera, camera.T_world_cam(env.simulator.ee_pose())


def points_of(env, observation, name):
    """World points (SIZE * SIZE, 3) that the pixels show by the depth image; the rays (SIZE * SIZE, 3)."""
    camera, T_world_cam = camera_of(env, name)
    v, u = np.mgrid[0:SIZE, 0:SIZE]
    rays = ray_directions(camera, T_world_cam, np.stack([u.ravel(), v.ravel()], axis=1))
    rays /= (rays @ T_world_cam[:3, 2])[:, None]
    return T_world_cam[:3, 3] + rays * observation[f"depth.{name}"].reshape(-1, 1), rays


@pytest.mark.parametrize("name", scene.CAMERA_NAMES)
def test_depth_on_the_table_is_the_rays_distance_to_its_plane(env, observation, name):
    points, rays = points_of(env, observation, name)
    _, T_world_cam = camera_of(env, name)
    distance = (TABLE_Z - T_world_cam[2, 3]) / rays[:, 2]
    at = T_world_cam[:3, 3] + rays * distance[:, None]
    on_table = (distance > 0) & (np.abs(at[:, 0]) < 0.35) & (np.abs(at[:, 1]) < 0.4)
    # What stands on the table is nearer than it, and nothing lies below.
    depth = observation[f"depth.{name}"].ravel()[on_table]
    assert (depth < distance[on_table] + 1e-4).all()
    bare = np.abs(points[on_table, 2] - TABLE_Z) < 2e-5
    assert bare.mean() > 0.2
    np.testing.assert_allclose(depth[bare], distance[on_table][bare], atol=1e-4)
    assert (observation[f"masks.{name}"].ravel()[on_table][bare] == 0).all()


@pytest.mark.parametrize("name", scene.CAMERA_NAMES)
def test_what_a_mask_and_the_depth_show_lies_in_the_objects_extent(env, observation, name):
    points, _ = points_of(env, observation, name)
    labels = observation[f"masks.{name}"].ravel()
    for obj, T_world_obj in env.simulator.object_poses().items():
        own = se3.apply(se3.inverse(T_world_obj), points[labels == scene.OBJECT_LABELS[obj]])
        low, high = EXTENTS[obj]
        assert len(own) > 10, obj
        assert (own >= np.array(low) - 0.002).all(), obj
        assert (own <= np.array(high) + 0.002).all(), obj


@pytest.mark.parametrize("name", ["front", "side"])
def test_the_mask_holds_the_objects_projected_top(env, observation, name):
    camera, T_world_cam = camera_of(env, name)
    tops = {"box": (0, 0, 0.03), "rack": (0, 0, 0.05), "stove": (-0.03, 0, 0.03)}
    for obj, top in tops.items():
        uv, depth = project(
            camera, T_world_cam, se3.apply(env.simulator.object_poses()[obj], np.array([top]))[0]
        )
        u, v = np.round(uv).astype(int)
        assert observation[f"masks.{name}"][0, v, u] == scene.OBJECT_LABELS[obj], obj
        assert observation[f"depth.{name}"][0, v, u] == pytest.approx(depth, abs=0.01), obj


def test_drawers_and_knob_are_their_objects(env):
    env.simulator.data.qpos[env.simulator.model.joint("drawer_top").qposadr[0]] = scene.DRAWER_TRAVEL
    observation = env.step(np.zeros(7, np.float32))[0]
    T_world_cabinet, T_world_stove = (env.simulator.object_poses()[name] for name in ("cabinet", "stove"))
    handle = np.array([[scene.HANDLE_X + scene.DRAWER_TRAVEL, 0.0, scene.handle_height(2)]])
    knob = np.array([[scene.KNOB_X, 0.0, scene.STOVE_HEIGHT + 0.036]])
    for name in ("front", "side"):
        camera, T_world_cam = camera_of(env, name)
        for T, point, obj in ((T_world_cabinet, handle, "cabinet"), (T_world_stove, knob, "stove")):
            u, v = np.round(project(camera, T_world_cam, se3.apply(T, point))[0][0]).astype(int)
            assert observation[f"masks.{name}"][0, v, u] == scene.OBJECT_LABELS[obj], (name, obj)


def test_colours_are_the_same_with_and_without(env, make_env):
    plain = make_env()
    plain.reset(seed=3)
    env.reset(seed=3)
    with_both, without = (one.step(np.ones(7, np.float32))[0] for one in (env, plain))
    assert set(without) == {"pixels", "agent_pos"}
    for name in scene.CAMERA_NAMES:
        np.testing.assert_array_equal(with_both["pixels"][name], without["pixels"][name])
