import numpy as np
import pytest
import torch

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.pipeline import Perception
from lerobot_openspm.perception.tracking.camera_health import MIN_COMMON, CameraWatch, disagreements
from lerobot_openspm.types import Hand, PoseEstimate, View

DOWN = np.diag([1.0, -1.0, -1.0])
T_WORLD_CAM = se3.transform(DOWN, [0.0, 0.0, 1.0])  # looks down at the table
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, "world", T_WORLD_CAM)


def hand(x=0.0, y=0.0):
    return se3.transform(DOWN, [x, y, 0.2])


def view(seed=0, mount="world", level=None):
    image = np.random.default_rng(seed).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    if level is not None:
        image[:] = level
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, mount, T_WORLD_CAM)
    return View(image, camera, T_WORLD_CAM)


@pytest.mark.parametrize("level", [0, 3, 255])
def test_a_picture_without_contrast_shows_nothing(level):
    faults = CameraWatch().check({"front": view(level=level), "side": view()}, {}, hand(), 0.0)
    assert list(faults) == ["front"]
    assert "black or blank" in faults["front"].reason


def test_a_picture_that_does_not_change_while_the_hand_in_it_moves_is_frozen():
    watch = CameraWatch()
    assert watch.check({"front": view()}, {}, hand(), 0.0) == {}
    assert watch.check({"front": view()}, {}, hand(0.01), 0.1) == {}, "a hand that hardly moved"
    frozen = watch.check({"front": view()}, {}, hand(0.05), 0.2)
    assert "frozen" in frozen["front"].reason
    assert watch.check({"front": view(seed=1)}, {}, hand(0.05), 0.3) == {}


def test_a_picture_that_the_hand_is_not_in_may_stay_as_it_is():
    watch = CameraWatch()
    for x in (2.0, 2.5, 3.0):
        assert watch.check({"front": view()}, {}, hand(x), x) == {}
    watch = CameraWatch()
    watch.check({"wrist": view(mount="ee")}, {}, hand(2.0), 0.0)
    assert "wrist" in watch.check({"wrist": view(mount="ee")}, {}, hand(2.5), 0.1), (
        "a hand camera moves itself"
    )


def test_a_late_camera_that_repeats_a_frame_now_and_then_is_forgiven():
    """Ten pictures a second for twenty steps of a slow hand."""
    watch = CameraWatch()
    for step in range(40):
        assert watch.check({"front": view(seed=step // 2)}, {}, hand(0.008 * step), 0.05 * step) == {}


def test_faults_are_timed_from_the_last_sound_picture():
    watch = CameraWatch()
    watch.check({"front": view()}, {}, hand(), 0.75)
    seconds = [
        watch.check({}, {"front": "is missing"}, hand(), time_s)["front"].seconds for time_s in (1.0, 1.5)
    ]
    assert seconds == [0.25, 0.75]
    assert watch.check({"front": view(seed=1)}, {}, hand(), 1.75) == {}
    assert watch.check({"front": view(level=0)}, {}, hand(), 2.0)["front"].seconds == 0.25


def test_a_camera_that_never_worked_is_timed_from_the_start():
    assert CameraWatch().check({"front": view(level=0)}, {}, hand(), 1.5)["front"].seconds == 1.5


def test_a_frozen_picture_is_timed_from_when_the_hand_began_to_move():
    watch = CameraWatch()
    for time_s in (0.0, 1.0, 2.0):
        assert watch.check({"front": view()}, {}, hand(), time_s) == {}
    watch.check({"front": view()}, {}, hand(0.01), 2.25)
    assert watch.check({"front": view()}, {}, hand(0.03), 2.5)["front"].seconds == 0.5


NAMES = ("bowl", "plate", "box", "rack", "stove")


def shown(seed: int, shift=(0.0, 0.0), names=NAMES) -> dict[str, list[np.ndarray]]:
    """Where one camera shows objects: within millimetres, but one of them quite elsewhere."""
    rng = np.random.default_rng(seed)
    places = {
        name: [0.1 * np.array([i, -i]) + rng.normal(0, 0.001, 2) + shift] for i, name in enumerate(NAMES)
    }
    places[NAMES[seed % len(NAMES)]][0] += 0.08
    return {name: places[name] for name in names}


def test_cameras_that_show_most_objects_at_the_same_place_agree():
    assert disagreements({"front": shown(1), "side": shown(2), "wrist": shown(3)}) == {}


def test_a_camera_that_shows_all_objects_elsewhere_is_named_with_how_far():
    found = disagreements({"front": shown(1), "side": shown(2, (0.02, 0.0)), "wrist": shown(3)})
    assert list(found) == ["side"]
    assert found["side"].startswith("views disagree: it shows objects 2")
    assert "from where front and wrist do" in found["side"]


def test_a_camera_that_is_turned_is_off_too():
    turned = shown(2)
    R = se3.from_yaw(np.zeros(3), np.deg2rad(6))[:2, :2]
    turned = {name: [R @ place for place in places] for name, places in turned.items()}
    assert list(disagreements({"front": shown(1), "side": turned})) == ["front", "side"]


def test_objects_that_are_each_seen_badly_tell_nothing_of_the_cameras():
    front, side = shown(1, names=NAMES[:3]), shown(2, names=NAMES[:3])
    for name, off in zip(NAMES[:3], ((-0.008, 0.001), (-0.008, -0.001), (0.018, 0.002)), strict=True):
        side[name] = [front[name][0] + off]
    assert disagreements({"front": front, "side": side}) == {}


def test_a_camera_that_sees_objects_badly_clears_no_other_one():
    rng = np.random.default_rng(5)
    badly = {name: [place + rng.normal(0, 0.015, 2) for place in ps] for name, ps in shown(3).items()}
    found = disagreements({"front": shown(1), "side": shown(2, (0.02, 0.0)), "wrist": badly})
    assert {"front", "side"} <= found.keys()


def test_of_two_cameras_that_disagree_both_are_named():
    assert list(disagreements({"front": shown(1), "side": shown(2, (0.0, 0.02))})) == ["front", "side"]


def test_one_object_tells_nothing_of_the_cameras():
    one = shown(2, (0.02, 0.0), NAMES[:1])
    assert disagreements({"front": shown(1), "side": one}) == {}


@pytest.mark.parametrize(
    ("second", "told"), [((0.021, 0.002), True), ((0.02, 0.01), False), ((0.0, 0.0), False)]
)
def test_two_objects_tell_of_a_camera_where_they_are_shifted_alike(second: tuple[float, float], told: bool):
    front = {"bowl": [np.zeros(2)], "plate": [np.array([0.0, 0.2])]}
    side = {"bowl": [np.array([0.02, 0.0])], "plate": [np.array([0.0, 0.2]) + second]}
    assert list(disagreements({"front": front, "side": side})) == (["front", "side"] if told else [])


def test_two_objects_that_are_shifted_alike_by_little_are_seen_badly():
    front = {"bowl": [np.zeros(2)], "plate": [np.array([0.0, 0.2])]}
    side = {name: [place + np.array([0.01, 0.0]) for place in places] for name, places in front.items()}
    assert disagreements({"front": front, "side": side}) == {}


def test_a_camera_with_two_objects_in_common_clears_no_other_one():
    few = {"bowl": shown(3)["bowl"], "plate": [np.array([0.5, 0.5])]}
    found = disagreements({"front": shown(1), "side": shown(2, (0.02, 0.0)), "wrist": few})
    assert list(found) == ["front", "side"]


def test_of_several_like_objects_any_may_be_the_one_that_the_other_camera_shows():
    both = shown(1)
    both["bowl"].insert(0, np.array([0.5, 0.5]))
    assert disagreements({"front": both, "side": shown(2)}) == {}


class Masked:
    """An object that is found by a segmenter's masks alone."""

    points, sought_again = np.zeros((0, 3)), False

    def __init__(self, name):
        self.name, self.cameras = name, []

    def localise(self, look):
        look.instances_of(self.name)
        self.cameras.append(sorted(look.views))
        return PoseEstimate("found", np.eye(4), 1e-6 * np.eye(4), 1.0)


class Segmenter:
    def segment(self, views, phrases):
        return {phrase: dict.fromkeys(views, ()) for phrase in phrases}


class World:
    perception, simulator_objects = "demonstrations", ()

    def __init__(self):
        self.cameras = dict.fromkeys(("front", "side"), CAMERA)
        self.objects = {name: Masked(name) for name in NAMES[:4]}


def observed(**levels):
    images = {
        camera: torch.as_tensor(view(seed, level=levels.get(camera)).image.transpose(2, 0, 1).copy()) / 255
        for seed, camera in enumerate(("front", "side"))
    }
    return Observation("", np.zeros(8), Hand(hand(), 0.08), images, None)


@pytest.mark.parametrize("asked", [NAMES[1:3], NAMES[1:4]])
def test_views_are_compared_by_what_the_segmenter_was_asked_for(asked):
    world = World()
    perception = Perception(world, 0.08, Segmenter())
    perception.detect(observed(front=0), NAMES[:2], {}, 0.0)  # one camera is dark
    assert perception.detect(observed(), asked, {}, 0.1).faults == {}
    compared = {name for name, one in world.objects.items() if ["front"] in one.cameras}
    assert compared == (set(asked) if len(asked) >= MIN_COMMON else set())
