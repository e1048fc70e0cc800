"""What was sought in vain is not sought again in the same pictures."""

import numpy as np
import pytest
import torch
from tests.perception.objects.surface.filmed import HOME, looking_down, moved, views_at

from lerobot_openspm.perception import pipeline
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.perception.pipeline import Perception
from lerobot_openspm.types import Hand, PoseEstimate


class Sought:
    """An object that is not found, or not told from another place, until it is said to be."""

    sought_again, points = False, np.zeros((0, 3))

    def __init__(self):
        self.looks, self.status = 0, "not_found"

    def localise(self, look):
        self.looks += 1
        return PoseEstimate(self.status, np.eye(4), 1e-6 * np.eye(4), 0.3)


class World:
    perception, simulator_objects = "demonstrations", ()

    def __init__(self):
        self.cameras = {name: view.camera for name, view in views_at({}, looking_down(*HOME)).items()}
        self.objects = {"cup": Sought(), "block": Sought()}


@pytest.fixture
def world(monkeypatch):
    # What each camera finds alone is asked once more, to compare cameras; that is not counted here.
    monkeypatch.setattr(pipeline, "disagreeing_cameras", lambda *_: {})
    return World()


def images(x=0.12, noise=0.0, lower_m=0.0):
    """What the cameras show of a scene, with noise of so many levels, from a hand that has sunk."""
    rng = np.random.default_rng(0)
    shown = {}
    T_world_ee = looking_down(*HOME)
    T_world_ee[2, 3] -= lower_m
    for name, view in views_at(moved(x, 0.12, 0.0), T_world_ee).items():
        image = view.image + noise * rng.standard_normal(view.image.shape)
        shown[name] = torch.as_tensor(image.clip(0, 255).transpose(2, 0, 1).copy()).float() / 255
    return shown


def detect(perception, shown, names=("cup", "block"), expected=None, told_apart=()):
    observation = Observation("", np.zeros(8), Hand(looking_down(*HOME), 0.08), shown, None)
    return perception.detect(observation, names, expected or {}, 0.0, told_apart).estimates


def looks(world):
    return [one.looks for one in world.objects.values()]


@pytest.mark.parametrize("status", ["not_found", "ambiguous"])
def test_the_same_pictures_are_searched_once(world, status):
    perception = Perception(world, 0.08)
    world.objects["block"].status = "found"
    world.objects["cup"].status = status
    first = detect(perception, images())
    again = detect(perception, images(noise=4.0), expected={"block": np.eye(4)})
    assert looks(world) == [1, 2]
    assert again["cup"] is first["cup"]
    assert list(again) == ["cup", "block"]


def test_a_hand_that_sinks_a_little_shows_the_same(world):
    perception = Perception(world, 0.08)
    detect(perception, images())
    detect(perception, images(lower_m=0.002))
    assert looks(world) == [1, 1]
    detect(perception, images(lower_m=0.05))
    assert looks(world) == [2, 2]


@pytest.mark.parametrize("metres", [0.01, 0.03])
def test_what_has_changed_is_searched(world, metres):
    perception = Perception(world, 0.08)
    detect(perception, images())
    detect(perception, images(0.12 + metres))
    assert looks(world) == [2, 2]
    world.objects["cup"].status = "found"
    assert detect(perception, images())["cup"].status == "found"


def test_what_is_asked_otherwise_is_searched(world):
    perception = Perception(world, 0.08)
    detect(perception, images(), ["cup"])
    detect(perception, images())
    assert looks(world) == [1, 1]  # the block is new
    detect(perception, images())
    assert looks(world) == [1, 1]
    detect(perception, images(), expected={"cup": np.eye(4)})
    assert looks(world) == [2, 1]  # the cup is looked for where it is expected
    detect(perception, images(), told_apart=["block"])
    assert looks(world) == [3, 2]
    detect(perception, {name: one for name, one in images().items() if name == "hand"}, told_apart=["block"])
    assert looks(world) == [4, 3]  # a camera has failed
