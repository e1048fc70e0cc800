from dataclasses import replace

import numpy as np
import pytest
from tests.perception.builders import localise
from tests.perception.drawn_world import DISTRACTOR, SHAPES, cameras, draw_poses, render, views_of

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import project
from lerobot_openspm.perception.objects.base import Look, localise_all
from lerobot_openspm.perception.objects.shape.occlusion import behind
from lerobot_openspm.perception.pipeline import hand_mask
from lerobot_openspm.types import PoseEstimate, View

DOWN = np.diag([1.0, -1.0, -1.0])


def view(mount="world"):
    camera, T_world_cam = cameras()["front"]
    camera = type(camera)(**{**vars(camera), "mount": mount})
    return View(np.zeros((160, 160, 3), np.uint8), camera, T_world_cam)


def test_the_hand_hides_its_fingers_and_the_arm_behind_them_and_little_else():
    T_world_ee = se3.transform(DOWN, [0.0, 0.0, 0.1])
    mask = hand_mask(view(), T_world_ee, 0.05)
    for height, hidden in ((0.0, True), (0.1, True), (-0.09, False)):
        uv, _ = project(view().camera, view().T_world_cam, [0.0, 0.0, 0.1 + height])
        assert mask[round(float(uv[1])), round(float(uv[0]))] == hidden
    assert 0.01 < mask.mean() < 0.2


def test_a_larger_hand_hides_more_and_a_hand_camera_sees_past_its_own():
    T_world_ee = se3.transform(DOWN, [0.0, 0.0, 0.1])
    small, large = (hand_mask(view(), T_world_ee, radius) for radius in (0.03, 0.08))
    assert (large & small).sum() == small.sum() < large.sum()
    assert not hand_mask(view("ee"), T_world_ee, 0.08).any()


def test_what_the_fingers_are_around_is_hidden_too():
    T_world_ee = se3.transform(DOWN, [0.0, 0.0, 0.1])
    empty, loaded = (hand_mask(view(), T_world_ee, 0.05, load_m) for load_m in (0.0, 0.12))
    uv, _ = project(view().camera, view().T_world_cam, [0.0, 0.1, 0.09])
    row, column = round(float(uv[1])), round(float(uv[0]))
    assert (empty[row, column], loaded[row, column]) == (False, True)
    assert loaded[empty].all()
    # Right before the hand's camera it would look like anything.
    assert hand_mask(view("ee"), T_world_ee, 0.05, 0.12).all()


@pytest.fixture
def models(drawn_objects):
    return drawn_objects


def with_bar(views, name, T, share):
    """A grey bar over part of an object in every view, and the masks that tell of it."""
    covered, hidden = {}, {}
    for camera, one in views.items():
        uv, _ = project(one.camera, one.T_world_cam, T[:3, 3] + [0, 0, 0.03])
        left = round(float(uv[0]) + (0.5 - share) * 24)
        image, mask = one.image.copy(), np.zeros((160, 160), bool)
        mask[:, left : left + 40] = True
        image[mask] = (90, 90, 95)
        covered[camera], hidden[camera] = View(image, one.camera, one.T_world_cam), mask
    return covered, hidden


def test_what_is_known_to_be_hidden_does_not_pull_the_pose(models):
    rng = np.random.default_rng(11)
    told, untold, shares = [], [], []
    for _ in range(8):
        poses = draw_poses(rng)
        clear = localise(views_of(poses), models["block"])
        covered, hidden = with_bar(views_of(poses), "block", poses["block"], 0.35)
        for found, masks in ((told, hidden), (untold, None)):
            one = localise(covered, models["block"], hidden=masks, T_expected=clear.T_world_obj)
            found.append(np.linalg.norm(one.T_world_obj[:2, 3] - clear.T_world_obj[:2, 3]))
            if masks:
                shares.append(one.visible)
    # What pulls a pose at all pulls it far: of eight scenes it is a few, by centimetres.
    assert np.mean(told) < 0.5 * np.mean(untold)
    assert np.max(told) < 0.004
    assert all(0.2 < share < 0.95 for share in shares)


def test_an_object_is_found_again_where_it_is_expected_and_where_it_is_not(models):
    rng = np.random.default_rng(12)
    for _ in range(5):
        poses = draw_poses(rng)
        clear = localise(views_of(poses), models["cup"])
        for expected in (clear.T_world_obj, se3.from_yaw([0.3, -0.3, clear.T_world_obj[2, 3]], 0.0)):
            again = localise(views_of(poses), models["cup"], T_expected=expected)
            assert again.status == "found"
            assert np.linalg.norm(again.T_world_obj[:3, 3] - clear.T_world_obj[:3, 3]) < 0.002


def test_an_object_that_is_gone_is_missed_where_it_should_be_seen(models):
    rng = np.random.default_rng(13)
    poses = draw_poses(rng)
    clear = localise(views_of(poses), models["cup"])
    without = views_of({name: T for name, T in poses.items() if name != "cup"})
    gone = localise(without, models["cup"], T_expected=clear.T_world_obj)
    assert gone.status == "not_found"
    assert gone.visible > 0.9
    everything = {camera: np.ones((160, 160), bool) for camera in without}
    assert localise(without, models["cup"], hidden=everything, T_expected=clear.T_world_obj).visible == 0.0


# A pillar of the distractor's colours: half sizes, height, colours, whether it is round.
PILLAR = ((0.05, 0.05), 0.25, *DISTRACTOR[2:4], False)


def pillar_points(T_world_obj):
    half, height = PILLAR[0][0], PILLAR[1]
    across, up = np.linspace(-half, half, 11), np.linspace(0, height, 26)
    sides = [
        np.stack(np.broadcast_arrays(*np.meshgrid(across, up), at), -1).reshape(-1, 3) for at in (-half, half)
    ]
    walls = [side[:, order] for side in sides for order in ([0, 2, 1], [2, 0, 1])]
    top = np.stack(np.broadcast_arrays(*np.meshgrid(across, across), height), -1).reshape(-1, 3)
    return se3.apply(T_world_obj, np.concatenate([*walls, top]))


class Pillar:
    """The pillar as an object that is found where it stands."""

    points, sought_again = pillar_points(np.eye(4)), False

    def __init__(self, T_world_obj):
        self.T_world_obj = T_world_obj

    def localise(self, look):
        return PoseEstimate("found", self.T_world_obj, 1e-6 * np.eye(4), 1.0)


def test_what_stands_before_a_place_hides_it_and_what_stands_behind_it_does_not():
    pillar = se3.from_yaw([0.0, 0.0, 0.0], 0.0)
    look = Look({"front": view()}, standing={"pillar": pillar_points(pillar)})
    # The front camera stands at x > 0 and looks down: the pillar hides what is at x < 0.
    far_point, near_point = [-0.12, 0.0, 0.03], [0.15, 0.0, 0.03]
    far, near = (behind(look, "cup", np.array(point)).hidden["front"] for point in (far_point, near_point))
    for hidden, point, is_hidden in ((far, far_point, True), (near, near_point, False)):
        uv, _ = project(view().camera, view().T_world_cam, point)
        assert hidden[round(float(uv[1])), round(float(uv[0]))] == is_hidden
    above = behind(look, "cup", np.array([0.3, 0.0, 0.4]))
    assert above is look, "nothing is before it, and nothing need be computed anew"
    drawn = render([(PILLAR, pillar)])["front"].image
    is_pillar = (np.abs(drawn.astype(int) - (196, 166, 128)) > 10).any(axis=2)
    assert np.mean(far == is_pillar) > 0.97


def test_a_thing_hides_itself_neither_by_its_name_nor_under_another_one():
    points = pillar_points(se3.from_yaw([0.0, 0.0, 0.0], 0.0))
    look, behind_it = Look({"front": view()}, standing={"pillar": points}), points.mean(0) - [0.1, 0.0, 0.0]
    assert behind(look, "post", points.mean(0)) is look
    assert behind(look, "pillar", behind_it) is look
    assert behind(look, "post", behind_it).hidden["front"].any()


@pytest.mark.parametrize("beside", [[0.09, -0.01], [0.07, -0.01]])
def test_what_is_followed_is_seen_past_what_stands_before_it(models, beside):
    model, cup = models["cup"], se3.from_yaw([-0.15, -0.05, 0.0], 0.0)
    expected = {"cup": model.localise(Look(render([(SHAPES["cup"], cup)]))).T_world_obj}
    pillar = se3.from_yaw([*(cup[:2, 3] + beside), 0.0], 0.0)
    standing = {"pillar": pillar_points(pillar)}
    there, gone = (render([*shapes, (PILLAR, pillar)]) for shapes in ([(SHAPES["cup"], cup)], []))
    assert model.localise(Look(there, expected=expected)).status == "not_found"
    found = model.localise(Look(there, expected=expected, standing=standing))
    assert found.status == "found"
    assert found.T_world_obj[:2, 3] == pytest.approx(cup[:2, 3], abs=0.005)
    assert model.localise(Look(gone, expected=expected, standing=standing)).status == "not_found"


def test_what_others_hide_where_it_is_expected_is_not_missed_there(models):
    model, cup = models["cup"], se3.from_yaw([-0.15, -0.05, 0.0], 0.0)
    pillars = [
        se3.from_yaw([*(cup[:2, 3] + by), 0.0], 0.0) for by in ([0.06, 0.0], [0.0, -0.06], [0.0, 0.06])
    ]
    look = Look(render([(PILLAR, T) for T in pillars]), expected={"cup": cup})
    standing = {f"pillar {i}": pillar_points(T) for i, T in enumerate(pillars)}
    alone, among = model.localise(look), model.localise(replace(look, standing=standing))
    assert (alone.status, among.status) == ("not_found", "not_found")
    assert among.visible < 0.5 < alone.visible


def test_one_of_two_that_is_hidden_in_a_view_by_what_is_known_is_found_too(models):
    cups = [se3.from_yaw([0.05, 0.15, 0.0], 0.0), se3.from_yaw([-0.15, -0.05, 0.0], 0.0)]
    pillar = se3.from_yaw([-0.06, -0.06, 0.0], 0.0)
    views = render([*((SHAPES["cup"], T) for T in cups), (PILLAR, pillar)])
    alone = models["cup"].localise(Look(views))
    told = models["cup"].localise(Look(views, standing={"pillar": pillar_points(pillar)}))
    assert alone.others == ()
    assert len(told.others) == 1
    objects = {"cup": models["cup"], "pillar": Pillar(pillar)}
    among = localise_all(objects, Look(views, told_apart=("cup",)))["cup"]
    for one in (told, among):
        found = np.array([T[:2, 3] for T in (one.T_world_obj, *one.others)])
        for T in cups:
            assert np.linalg.norm(found - T[:2, 3], axis=1).min() < 0.012
