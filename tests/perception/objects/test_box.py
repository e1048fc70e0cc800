"""The upright box around points, from all sides and from one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.perception.drawn_masks import turned_yaw
from tests.properties import examples

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.box.box import Box, oriented_box

SIDE = st.floats(0.03, 0.3)
YAW = st.floats(-np.pi, np.pi)
PLACE = st.floats(-1.0, 1.0)


def faces_seen(box: Box, eye: np.ndarray, rng: np.random.Generator, count: int = 1500, top: bool = False):
    """Points ``(n, 3)`` evenly over the sides of a box, and its top if asked for, that face a camera."""
    own_eye = se3.apply(se3.inverse(box.T_world_obj), eye[None])[0]
    unit = rng.uniform(-0.5, 0.5, (count, 3))
    areas, parts = [], []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)) + (((2, 1),) if top else ()):
        if sign * own_eye[axis] <= box.size[axis] / 2 and axis < 2:
            continue
        points = unit.copy()
        points[:, axis] = sign / 2
        parts.append((points + np.array([0, 0, 0.5])) * box.size)
        areas.append(np.prod(np.delete(box.size, axis)))
    shares = (np.array(areas) / sum(areas) * count).astype(int)
    return se3.apply(box.T_world_obj, np.vstack([p[:n] for p, n in zip(parts, shares, strict=True)]))


def principal_yaw(points: np.ndarray) -> float:
    """Yaw of the long principal axis of a footprint: what the box's yaw is compared with."""
    _, vectors = np.linalg.eigh(np.cov(points[:, :2].T))
    return float(np.arctan2(vectors[1, -1], vectors[0, -1]))


def grid(size: np.ndarray, steps: int = 7) -> np.ndarray:
    axes = [np.linspace(-0.5, 0.5, steps)] * 2 + [np.linspace(0, 1, steps)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * size


@given(SIDE, SIDE, SIDE, PLACE, PLACE, PLACE, YAW)
def test_a_full_box_is_found_at_any_size_place_and_yaw(a, b, height, x, y, z, yaw):
    size = np.array([max(a, b) * 1.2, min(a, b), height])
    T = se3.from_yaw([x, y, z], yaw)
    found = oriented_box(se3.apply(T, grid(size)), z)
    assert found.size == pytest.approx(size, abs=1e-5)
    assert found.T_world_obj[:3, 3] == pytest.approx(T[:3, 3], abs=1e-5)
    assert turned_yaw(found.T_world_obj, T, np.pi) < 1e-3


@examples(40)
@given(st.integers(0, 2**31), YAW, PLACE, PLACE)
def test_moving_and_turning_the_points_moves_and_turns_the_box(seed, yaw, x, y):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(60, 3)) * [0.2, 0.08, 0.05] + [0, 0, 0.3]
    T_moved = se3.from_yaw([x, y, 0.0], yaw)
    one, two = oriented_box(points, 0.0), oriented_box(se3.apply(T_moved, points), 0.0)
    # Two rectangles of about the same area may change places by rounding; their areas may not.
    assert two.size[:2].prod() == pytest.approx(one.size[:2].prod(), rel=1e-3)
    if np.allclose(one.size, two.size, rtol=1e-3):
        expected = T_moved @ one.T_world_obj
        assert two.T_world_obj[:3, 3] == pytest.approx(expected[:3, 3], abs=1e-3)
        assert turned_yaw(two.T_world_obj, expected, np.pi) < 0.01


def test_its_frame_is_that_of_poses_and_its_vertices_its_own():
    box = Box(se3.from_yaw([0.1, 0.2, 0.03], 0.5), np.array([0.12, 0.06, 0.05]))
    own = se3.apply(se3.inverse(box.T_world_obj), box.vertices())
    assert own.min(0) == pytest.approx([-0.06, -0.03, 0.0])
    assert own.max(0) == pytest.approx([0.06, 0.03, 0.05])
    rims = Box(box.T_world_obj, np.array([0.12, 0.12, 0.05]), is_round=True).vertices()
    assert np.linalg.norm(rims[:, :2] - [0.1, 0.2], axis=1) == pytest.approx(0.06)
    assert {round(z, 6) for z in rims[:, 2]} == {0.03, 0.08}


def yaw_errors(top: bool) -> np.ndarray:
    """Yaw errors in degrees ``(n, 2)``, of the smallest rectangle and of the principal axis."""
    rng, errors = np.random.default_rng(4), []
    for _ in range(200):
        size = np.array([rng.uniform(0.1, 0.2), rng.uniform(0.05, 0.08), rng.uniform(0.03, 0.12)])
        box = Box(se3.from_yaw([*rng.uniform(-0.2, 0.2, 2), 0.0], rng.uniform(-np.pi, np.pi)), size)
        points = faces_seen(box, np.array([1.2, 0.1, 0.7]), rng, top=top)
        points = points + rng.normal(0, 5e-4, points.shape)
        axis = se3.from_yaw(np.zeros(3), principal_yaw(points))
        found = oriented_box(points, 0.0).T_world_obj
        errors.append([turned_yaw(T, box.T_world_obj, np.pi) for T in (found, axis)])
    return np.rad2deg(errors)


@pytest.mark.parametrize(("top", "principal_deg"), [(False, 10.0), (True, 5.0)])
def test_what_is_seen_from_one_side_turns_the_principal_axes_but_not_the_box(top, principal_deg):
    rectangle, principal = np.median(yaw_errors(top), axis=0)
    assert rectangle < 1.0
    assert principal > principal_deg
