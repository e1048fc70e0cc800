"""What stands still is followed by earlier looks from elsewhere too."""

import dataclasses

import numpy as np
import torch
from numpy.testing import assert_allclose
from tests.perception.drawn_world import SHAPES, hand_camera, render
from tests.perception.objects.surface.filmed import HOME, MIDDLES, looking_down, moved, views_at

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.perception.objects.base import EarlierLook, Look
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.pipeline import Perception
from lerobot_openspm.types import Hand, PoseEstimate


def from_nearby(scene):
    """Views of a hand right above a corner of the block; the arm hides everything from the fixed cameras."""
    views = views_at(scene, looking_down(*(scene["block"][:2, 3] + [0.03, 0.03]), 0.13))
    return views, {name: np.full(view.image.shape[:2], name != "hand") for name, view in views.items()}


def test_where_a_look_from_nearby_shows_a_part_earlier_looks_tell_the_place(models):
    model, scene = models["block"], moved(0.12, 0.12, 0.3)
    first = Look(views_at(scene, looking_down(*HOME)))
    T = model.localise(first).T_world_obj
    views, hidden = from_nearby(scene)
    nudged = se3.from_yaw([0.006, -0.006, 0.0], 0.0) @ T
    off = []
    for before in ((), (EarlierLook(first, {"block": T}),)):
        look = Look(views, hidden=hidden, expected={"block": nudged}, before=before)
        off.append(float(se3.distances(model.localise(look).T_world_obj, T)[0]))
    assert off[1] < 0.003 < off[0]


def test_earlier_looks_do_not_hold_back_what_has_moved(models):
    model, scene = models["block"], moved(0.12, 0.12, 0.3)
    first = Look(views_at(scene, looking_down(*HOME)))
    T = model.localise(first).T_world_obj
    before = (EarlierLook(first, {"block": T}),)
    for x, yaw in ((0.015, 0.0), (0.008, 0.0), (0.0, 0.25)):
        now = views_at(moved(0.12 + x, 0.12, 0.3 + yaw), looking_down(0.0, 0.1, 0.35))
        found = model.localise(Look(now, expected={"block": T}, before=before))
        alone = model.localise(Look(now, expected={"block": T}))
        assert found.status == "found"
        metres, radians = se3.distances(found.T_world_obj, alone.T_world_obj)
        assert metres < 0.004
        assert radians < 0.1


def behind_a_board(views, T, edge=-3):
    """The views, a board of another colour standing before most of what is at a pose in the fixed cameras."""
    covered = {}
    for name, view in views.items():
        image = view.image.copy()
        if name != "hand":
            uv, _ = project(view.camera, view.T_world_cam, T[:3, 3] + [0.0, 0.0, 0.03])
            column, row = np.rint(uv).astype(int)
            image[max(0, row - 40) : row + 40, max(0, column - 40) : column + edge] = (30, 160, 60)
        covered[name] = dataclasses.replace(view, image=image)
    return covered


def test_what_a_fixed_camera_shows_no_less_of_than_when_it_was_found_is_still_there(models):
    model, scene = models["block"], moved(0.12, 0.12, 0.3)
    first = Look(behind_a_board(views_at(scene, looking_down(*HOME)), scene["block"]))
    found = model.localise(first)
    assert found.status == "found"
    T = found.T_world_obj
    before = (EarlierLook(first, {"block": T}),)
    away = looking_down(0.12, -0.3, 0.2)  # the hand's camera does not show it any more
    still = behind_a_board(views_at(scene, away), scene["block"])
    gone = behind_a_board(views_at({}, away), scene["block"])
    off = []
    for views, earlier in ((still, before), (still, ()), (gone, before)):
        seen = model.localise(Look(views, expected={"block": T}, before=earlier))
        assert seen.status == "not_found"
        off.append(float(np.linalg.norm(seen.T_world_obj[:3, 3] - T[:3, 3])))
    # Without the earlier look it is sought elsewhere, and so is what is gone.
    assert off[0] < 0.003 < min(off[1:])


def test_a_hidden_one_of_two_alike_is_not_where_the_other_one_stands(models):
    model, scene = models["block"], moved(0.12, 0.12, 0.3)
    T = model.localise(Look(views_at(scene, looking_down(*HOME)))).T_world_obj
    other = se3.from_yaw([*MIDDLES["block"][:2], 0.0], 0.0)  # where blocks stood in the demonstrations
    both = [(SHAPES["block"], scene["block"]), (SHAPES["block"], other)]
    views = render(both, None, hand_camera(looking_down(0.3, -0.3, 0.2)))
    views = behind_a_board(views, scene["block"], edge=-5)
    alone = model.localise(Look(views, expected={"block": T}))
    assert_allclose(alone.T_world_obj[:2, 3], other[:2, 3], atol=0.01)
    told = model.localise(Look(views, expected={"block": T}, told_apart={"block"}))
    assert (told.status, told.visible) == ("not_found", 0.0)
    assert_allclose(told.T_world_obj[:2, 3], T[:2, 3], atol=0.01)


def test_what_the_hand_covers_is_not_gone_to_where_another_one_stands(models):
    model, scene = models["block"], moved(0.12, 0.12, 0.3)
    first = Look(views_at(scene, looking_down(*HOME)))
    T = model.localise(first).T_world_obj
    other = se3.from_yaw([-0.12, -0.12, 0.0], 0.0)
    both = [(SHAPES["block"], scene["block"]), (SHAPES["block"], other)]
    views = render(both, None, hand_camera(looking_down(-0.12, -0.05, 0.3)))
    before = (EarlierLook(first, {"block": T}),)
    look = Look(views, hidden=around(views, T), expected={"block": T}, told_apart={"block"}, before=before)
    covered = model.localise(look)
    assert (covered.status, covered.visible) == ("not_found", 0.0)
    assert_allclose(covered.T_world_obj[:2, 3], T[:2, 3], atol=0.01)
    # Where nothing hides the place, one that has gone is found at the other.
    views = render(both[1:], None, hand_camera(looking_down(-0.12, -0.05, 0.3)))
    gone = model.localise(Look(views, expected={"block": T}, told_apart={"block"}, before=before))
    assert gone.status == "found"
    assert_allclose(gone.T_world_obj[:2, 3], other[:2, 3], atol=0.01)


def around(views, T):
    """Pixels about what stands at a pose, as the arm above it hides them."""
    hidden = {}
    for name, view in views.items():
        uv, _ = project(view.camera, view.T_world_cam, T[:3, 3] + [0.0, 0.0, 0.03])
        rows, columns = np.mgrid[: view.camera.height, : view.camera.width]
        hidden[name] = np.hypot(rows - uv[1], columns - uv[0]) < 40
    return hidden


def test_what_the_hand_alone_has_found_is_seen_to_be_gone(models):
    model, scene = models["block"], moved(0.12, 0.12, 0.3)
    views = views_at(scene, looking_down(*HOME))
    hidden = {name: np.full(view.image.shape[:2], name != "hand") for name, view in views.items()}
    first = Look(views, hidden=hidden)
    T = model.localise(first).T_world_obj
    before = (EarlierLook(first, {"block": T}),)
    now = views_at(moved(-0.1, -0.12, 0.3), looking_down(*HOME))
    found = model.localise(Look(now, expected={"block": T}, before=before))
    assert found.status == "found"
    assert_allclose(found.T_world_obj[:2, 3], [-0.1, -0.12], atol=0.01)


def test_a_look_that_finds_more_from_the_same_place_is_remembered_instead():
    perception = Perception(None, 0.08)
    looks = [Look(views_at({}, looking_down(0.0, 0.0, 0.4))) for _ in range(3)]
    found = PoseEstimate("found", np.eye(4), np.eye(4), 1.0)
    missed = dataclasses.replace(found, status="not_found")
    for look, block in zip(looks, (missed, found, missed), strict=True):
        perception.remember(look, {"cup": found, "block": block})
    (kept,) = perception.before
    perception.remember(looks[2], {"cup": found, "block": found, "box": found}, is_still=False)
    assert perception.before == (kept,)
    assert kept.poses.keys() == {"cup", "block"}
    assert kept.look.views["hand"] is looks[1].views["hand"]
    assert kept.look.views.keys() == looks[1].views.keys()


def test_the_first_look_and_the_last_ones_from_elsewhere_are_remembered():
    perception = Perception(None, 0.08)
    places = [(0.0, 0.0), (0.0, 0.0), (0.1, 0.0), (0.2, 0.0), (0.2, 0.4), (0.3, 0.4), (0.3, 0.4)]
    looks = [Look(views_at({}, looking_down(x, 0.0, 0.4, tilt))) for x, tilt in places]
    found = PoseEstimate("found", np.eye(4), np.eye(4), 1.0)
    missed = dataclasses.replace(found, status="not_found")
    perception.remember(looks[-1], {"cup": missed})
    assert perception.before == ()
    for look in looks:
        look = dataclasses.replace(look, before=perception.before)
        perception.remember(look, {"cup": found, "block": missed})
    kept = [one.look.views for one in perception.before]
    assert [views["hand"] for views in kept] == [looks[i].views["hand"] for i in (0, 3, 4, 5)]
    assert [len(views) for views in kept] == [len(looks[0].views), 1, 1, 1]
    assert all(one.poses.keys() == {"cup"} and not one.look.before for one in perception.before)


def test_earlier_looks_are_handed_on_and_tell_nothing_of_what_was_displaced(models):
    class Known:
        perception, simulator_objects = "demonstrations", ()

        def __init__(self):
            self.cameras = {name: view.camera for name, view in views_at({}, looking_down(*HOME)).items()}
            self.looks, self.objects = [], {"cup": self, "block": self}

        def localise(self, look):
            self.looks.append(look)
            return PoseEstimate("found", np.eye(4), 1e-6 * np.eye(4), 1.0)

        points, sought_again = np.zeros((0, 3)), False

    known = Known()
    perception = Perception(known, 0.08)
    for i, displaced in enumerate(((), (), ("cup",))):
        T_world_ee = looking_down(0.1 * i, 0.0, 0.4)
        views = views_at(moved(0.12, 0.12, 0.0), T_world_ee)
        images = {
            name: torch.as_tensor(view.image.transpose(2, 0, 1).copy()).float() / 255
            for name, view in views.items()
        }
        observation = Observation("", np.zeros(8), Hand(T_world_ee, 0.08), images, None)
        perception.detect(observation, ["cup", "block"], {}, float(i), displaced=displaced)
    told = [[sorted(one.poses) for one in look.before] for look in known.looks if len(look.views) > 1]
    both, block = ["block", "cup"], ["block"]
    assert told == [[], [], [both], [both], [block, block], [block, block]]
    assert [sorted(one.poses) for one in perception.before] == [block, block, block]
