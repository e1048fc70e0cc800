"""Scenes in which what is known by its surface must not be taken to stand where it can be grasped."""

from dataclasses import replace

import numpy as np
import pytest
from tests.perception.drawn_world import DISTRACTOR, SHAPES, cameras, hand_camera, render
from tests.perception.objects.surface.filmed import HOME, MIDDLES, demonstration, looking_down, views_at

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.base import Look, localise_all
from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.objects.surface.model import SurfaceModel
from lerobot_openspm.perception.pipeline import LOAD_M, disagreeing_cameras, hand_mask
from lerobot_openspm.perception.tracking.tracker import Tracker, TrackerSettings

# Most of the table's one side is out of the hand's picture.
ASIDE = looking_down(-0.05, -0.2, 0.4)
HAND_RADIUS_M = 0.08
BLOCK = se3.from_yaw([0.1, -0.2, 0.0], 0.3)
# Block and cup keep their colours; the block is a box that the cup fits under.
BOX = ((0.07, 0.06), 0.08, *SHAPES["block"][2:])


def is_followed(name, estimate):
    return name in Tracker({}, TrackerSettings()).look({name: estimate}, looking_down(*HOME), 0.0)


@pytest.mark.parametrize("name", ["block", "cup"])
@pytest.mark.parametrize(("y", "is_in_view"), [(0.30, False), (0.26, True)])
def test_what_is_half_out_of_all_pictures_is_followed_once_it_is_in_one(models, name, y, is_in_view):
    model = models[name]
    found = model.localise(Look(views_at({name: se3.from_yaw([0.2, y, 0.0], 0.0)}, ASIDE)))
    # It is recognised either way.
    assert found.status == "found"
    middle = se3.apply(found.T_world_obj, np.array([[*model.surface.middle, 0.0]]))[0, :2]
    assert middle == pytest.approx([0.2, y], abs=0.01)
    assert (found.visible >= 0.5) == is_in_view
    assert is_followed(name, found) == is_in_view


def lifted(height):
    """The views of a cup in the air right below the hand's camera, and what the loaded hand hides of them."""
    cup, T_world_cam = se3.from_yaw([0.0, 0.1, height], 0.0), looking_down(0.03, 0.1, height + 0.14)
    views = views_at({"cup": cup, "block": BLOCK}, T_world_cam)
    between_the_fingers = looking_down(0.03, 0.1, height + 0.05)
    hand = between_the_fingers, HAND_RADIUS_M, LOAD_M
    return views, {name: hand_mask(view, *hand) for name, view in views.items()}


@pytest.mark.parametrize("height", [0.1, 0.15, 0.2])
def test_what_the_hand_holds_is_not_found_on_the_table_behind_it(models, height):
    views, hidden = lifted(height)
    # In the air it looks like one that stands on the table further off.
    assert localise_all(models, Look(views))["cup"].status == "found"
    found = localise_all(models, Look(views, hidden=hidden))
    assert found["block"].status == "found"
    assert found["cup"].status == "not_found"
    assert not is_followed("cup", found["cup"])


def test_what_is_mostly_out_of_the_picture_has_not_tipped(models):
    found = models["block"].localise(Look(views_at({"block": se3.from_yaw([0.0, 0.36, 0.0], 0.0)}, ASIDE)))
    assert (found.status, found.tipped) == ("not_found", False)


def test_what_another_covers_is_not_found(models):
    pose = se3.from_yaw([*MIDDLES["cup"][:2], 0.0], 0.4)
    cup, box = (SHAPES["cup"], pose), (BOX, pose)
    camera = hand_camera(looking_down(*HOME))
    views, bare = render([cup, box], None, camera), render([box], None, camera)
    assert all(np.array_equal(view.image, bare[name].image) for name, view in views.items())
    found = localise_all(models, Look(views))["cup"]
    assert found.status == "not_found"
    assert not is_followed("cup", found)


@pytest.fixture(scope="session")
def three(models):
    """Block, cup, and the third shape as it is learned from films in which the hand touches it alone."""
    rng = np.random.default_rng(1)
    films = [demonstration(rng, touched=("distractor",)) for _ in range(3)]
    return {**models, **learn_objects(films, np.random.default_rng(0)).models}


def from_three_cameras():
    placed = {**hand_camera(looking_down(*HOME)), "side": cameras()["side"]}
    standing = [
        (SHAPES.get(name, DISTRACTOR), se3.from_yaw([x, y, 0.0], yaw))
        for name, (x, y, yaw) in MIDDLES.items()
    ]
    return render(standing, None, placed)


def wrongly_calibrated(view, kind):
    """The view of a camera that is taken to be 2 cm beside where it is, or turned by 3 degrees."""
    shift, turn = ([0.02, 0, 0], [0.0, 0, 0]) if kind == "2 cm" else ([0.0, 0, 0], np.deg2rad([3.0, 0, 0]))
    T_cam_off = se3.transform(se3.exp_so3(turn), np.array(shift))
    camera = replace(view.camera, T_mount_cam=view.camera.T_mount_cam @ T_cam_off)
    return replace(view, camera=camera, T_world_cam=view.T_world_cam @ T_cam_off)


def faults(known, views):
    look = Look(views)
    return disagreeing_cameras(look, known, localise_all(known, look))


@pytest.mark.parametrize(
    ("camera", "kind"), [("front", "2 cm"), ("side", "3 degrees"), ("hand", "3 degrees")]
)
def test_a_wrong_calibration_is_told_by_surfaces(three, camera, kind):
    views = from_three_cameras()
    found = faults(three, {**views, camera: wrongly_calibrated(views[camera], kind)})
    assert list(found) == [camera]
    assert "views disagree: it shows objects " in found[camera].reason


def test_by_surfaces_cameras_that_are_calibrated_agree(three):
    assert {type(model) for model in three.values()} == {SurfaceModel}
    assert len(three) == 3
    assert faults(three, from_three_cameras()) == {}
