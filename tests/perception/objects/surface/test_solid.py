"""What pictures see through is taken out of a solid, and a table's height is told by its grain."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera, ray_directions
from lerobot_openspm.perception.objects.surface.backdrop import Backdrop, Colour, learn_backdrop
from lerobot_openspm.perception.objects.surface.carving import Carved, Frame, Frames
from lerobot_openspm.perception.objects.surface.solid import (
    Depths,
    Solid,
    carve_by_colour,
    fill_silhouettes,
)
from lerobot_openspm.types import View

CELL = 0.01
BACK = np.array([230, 225, 215])


def looking_down(x, y, z, tilt):
    """``T_world_cam`` of a camera at a place that looks down, leaning by ``tilt`` radians about x."""
    T_down = se3.transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    return (
        se3.transform(np.eye(3), [x, y, z]) @ T_down @ se3.transform(se3.exp_so3([tilt, 0, 0]), np.zeros(3))
    )


def picture(T_world_cam, height, texture, cell, mount="ee"):
    """A view of a textured square at a height, its middle above the origin, on a plain ground."""
    camera = Camera(128, 128, 150.0, 150.0, 63.5, 63.5, mount, np.eye(4) if mount == "ee" else T_world_cam)
    v, u = np.mgrid[:128, :128]
    rays = ray_directions(camera, T_world_cam, np.stack([u, v], -1).astype(float))
    along = (height - T_world_cam[2, 3]) / rays[..., 2]
    places = T_world_cam[:2, 3] + along[..., None] * rays[..., :2]
    index = np.floor(places / cell).astype(int) + len(texture) // 2
    inside = ((index >= 0) & (index < len(texture))).all(-1)
    image = np.tile(BACK, (128, 128, 1))
    image[inside] = texture[tuple(index[inside].T)]
    return View(image.astype(np.uint8), camera, T_world_cam), inside


PLACES = [
    (x, y, 0.4, tilt) for x in (-0.08, 0.0, 0.08) for y, tilt in ((-0.1, 0.25), (0.0, 0.0), (0.1, -0.25))
]


def block(size, height):
    """A full solid of so many cells a side and so many layers."""
    x = (np.arange(size + 4) - (size + 3) / 2) * CELL
    filled = np.zeros((size + 4, size + 4, height + 2), bool)
    filled[2:-2, 2:-2, :height] = True
    return Solid(x, CELL * (np.arange(height + 2) + 0.5), filled)


def test_a_solids_surface_is_what_borders_on_nothing_and_looks_outwards():
    solid = block(6, 4)
    # All but the inner cells, which reach down to the table.
    assert len(solid.points) == 6 * 6 * 4 - 4 * 4 * 3
    outwards = solid.normals[:, :2] * solid.points[:, :2]
    walls = (np.abs(solid.points[:, :2]).max(1) > 2 * CELL) & (solid.points[:, 2] < 2 * CELL)
    assert (outwards[walls].sum(1) > 0).all()
    top = (solid.points[:, 2] > 3 * CELL) & (np.abs(solid.points[:, :2]).max(1) < CELL)
    assert_allclose(solid.normals[top, 2], 1.0, atol=0.02)


def test_what_pictures_disagree_about_is_taken_out_down_to_where_they_agree():
    # Nine layers are filled, the picture is that of a mat at the height of the fourth.
    texture = np.random.default_rng(0).integers(0, 200, (32, 32, 3))
    top = 3.5 * CELL  # the fourth layer's middle
    frames = []
    for place in PLACES:
        view, shown = picture(looking_down(*place), top, texture, CELL / 2)
        frames.append(Frame("hand", view, shown, None, {"mat": np.eye(4)}))
    carved = carve_by_colour(Frames("mat", frames), block(16, 9), Depths({}))
    heights = carved.filled[4:-4, 4:-4].sum(-1)
    assert 4 <= np.median(heights) <= 5
    assert (np.abs(heights - 4) <= 2).mean() > 0.85


@pytest.mark.parametrize(
    ("reach_m", "pictures", "layers"),
    [(1.0, 9, 17), (0.05, 9, 2), (1.0, 4, 17), (1.0, 3, 2)],
    ids=["above it", "beyond the table", "enough pictures", "too few pictures"],
)
def test_a_solid_rises_to_what_enough_pictures_show_above_it(reach_m, pictures, layers):
    # Two layers are filled, and the pictures show a small plate at the height of the seventeenth.
    texture = np.full((4, 4, 3), 90)
    frames = []
    for place in PLACES[:pictures]:
        view, shown = picture(looking_down(*place), 16.5 * CELL, texture, CELL)
        frames.append(Frame("hand", view, shown, None, {"mat": np.eye(4)}))
    space = block(4, 17)
    solid = Solid(space.x, space.z, space.filled & (np.arange(19) < 2))
    area = reach_m * np.array([[-1.0, -1.0], [1.0, 1.0]]) + (reach_m < 1) * 0.5
    backdrop = Backdrop(Colour(np.zeros(3), np.eye(3)), 0.0, area)
    carved = Carved(space.x, space.z, space.filled)
    filled = fill_silhouettes(Frames("mat", frames), carved, solid, Depths({"mat": solid}), backdrop).filled
    assert filled.sum(-1).max() == layers


def test_only_frames_in_which_nothing_has_moved_are_untouched():
    view, shown = picture(looking_down(*PLACES[0]), 0.0, np.zeros((1, 1, 3)), CELL)
    frames = [Frame("hand", view, shown, None, {}, is_untouched) for is_untouched in (True, False)]
    assert Frames("mat", frames).untouched.frames == frames[:1]


def test_every_surface_is_drawn_once_a_picture_and_the_nearest_counts(monkeypatch):
    drawn = []
    draw = Solid.depth
    monkeypatch.setattr(
        Solid, "depth", lambda self, frame, name: drawn.append(name) or draw(self, frame, name)
    )
    view, shown = picture(looking_down(*PLACES[0]), 0.0, np.zeros((1, 1, 3)), CELL)
    frame = Frame("hand", view, shown, None, {"low": np.eye(4), "high": np.eye(4), "unknown": np.eye(4)})
    depths = Depths({"low": block(16, 2), "high": block(6, 9), "absent": block(6, 20)})
    both, low, high = depths.nearest(frame), depths.nearest(frame, "high"), depths.nearest(frame, "low")
    assert_array_equal(both, np.minimum(low, high))
    assert (both < low).any()
    assert (both < high).any()
    assert_array_equal(depths.covered(frame) | ~np.isfinite(both), True)
    assert not np.isfinite(depths.nearest(Frame("hand", view, shown, None, {}))).any()
    assert sorted(drawn) == ["high", "low"]


def test_a_single_cell_is_no_part():
    solid = block(6, 2)
    alone = solid.filled.copy()
    alone[0, 0, 0] = True
    view, shown = picture(looking_down(*PLACES[0]), 0.0, np.zeros((1, 1, 3)), CELL)
    frames = Frames("block", [Frame("hand", view, shown, None, {"block": np.eye(4)})])
    kept = carve_by_colour(frames, Solid(solid.x, solid.z, alone), Depths({}))
    assert_array_equal(kept.filled, solid.filled)


@pytest.mark.parametrize("stands", [True, False])
def test_a_part_that_stands_beside_the_largest_piece_is_kept(stands):
    solid = block(12, 2)
    knob = np.pad(solid.filled, ((0, 8), (0, 8), (0, 4)))
    knob[-6:-1, -6:-1, (0 if stands else 3) : (2 if stands else 5)] = True
    x = (np.arange(len(knob)) - len(knob) / 2) * CELL
    both = Solid(x, CELL * (np.arange(knob.shape[2]) + 0.5), knob)
    view, shown = picture(looking_down(*PLACES[0]), 0.0, np.zeros((1, 1, 3)), CELL)
    frames = Frames("stove", [Frame("hand", view, shown, None, {"stove": np.eye(4)})])
    kept = carve_by_colour(frames, both, Depths({})).filled
    assert kept[-6:-1, -6:-1].any() == stands


@pytest.mark.parametrize("height", [-0.12, -0.004, 0.0, 0.011])
@pytest.mark.parametrize("cell", [0.006, 0.02])
def test_a_table_with_grain_or_tiles_tells_its_height(height, cell):
    grain = BACK + np.random.default_rng(1).integers(-6, 7, (300, 300, 1))
    places = [
        (x, y, z, tilt) for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (0.3, 0.45) for tilt in (-0.3, 0.3)
    ]
    views = [picture(looking_down(*place), height, grain, cell)[0] for place in places]
    backdrop = learn_backdrop({"hand": views}, 0.003)
    assert backdrop is not None
    assert backdrop.table_height == pytest.approx(height, abs=0.0015)
