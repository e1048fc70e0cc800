"""Known objects made of random numbers, and shorthands for learning and looking for objects."""

from dataclasses import replace

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.perception.foreground import N_BINS
from lerobot_openspm.perception.objects.base import Examples, Look
from lerobot_openspm.perception.objects.box.model import BoxModel
from lerobot_openspm.perception.objects.patches.match import Patch, Probe
from lerobot_openspm.perception.objects.patches.model import PatchModel
from lerobot_openspm.perception.objects.shape.model import ShapeModel


def model(name, seed=0, yaw_period=2 * np.pi):
    rng = np.random.default_rng(seed)
    return ShapeModel(
        name, rng.normal(size=N_BINS).astype(np.float32),
        rng.normal(scale=0.05, size=(9, 3)).astype(np.float32),
        0.005, 0.01, yaw_period, 0.1, 0.2, 0.9,
    )  # fmt: skip


def masked_model(name):
    """An object whose shape was learned from a segmenter's masks."""
    return replace(model(name, 4), log_odds=None)


def box_model(name, yaw_period=np.pi, sides=(0.12, 0.06)):
    return BoxModel(name, np.array([*sides, 0.05]), 0.01, yaw_period, 0.3, 0.8)


def patch_model(name):
    rng = np.random.default_rng(5)
    T = se3.from_yaw([0.1, 0.2, 0.3], 0.4)
    camera = Camera(64, 48, -50.0, 50.0, 31.5, 23.5, "world", T)
    patches = tuple(
        Patch(rng.integers(0, 255, (9, 8, 3)).astype(np.uint8), np.array([3.0, 4.0]), np.array([0.0, i, 1.0]))
        for i in range(2)
    )
    return PatchModel(name, (Probe("observation.images.front", camera, T, patches, 0.001),), 1.0, 0.9)


def localise(views, known, instances=None, hidden=None, T_expected=None):
    """Find one object in views."""
    found = {} if instances is None else {known.name: instances}
    expected = {} if T_expected is None else {known.name: T_expected}
    return known.localise(Look(views, found, hidden or {}, expected))


def examples(names, scenes, known=(), segmenter=None, source="demonstrations", shapes=None):
    return Examples(names, scenes, known, np.random.default_rng(0), segmenter, source, shapes)
