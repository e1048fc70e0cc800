"""A kind of object is known by its line in the table alone."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from tests.perception.builders import box_model, masked_model, model, patch_model
from tests.perception.drawn_world import demonstration

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects import store
from lerobot_openspm.perception.objects.base import Kind
from lerobot_openspm.perception.objects.kinds import KINDS, learn_objects
from lerobot_openspm.perception.pipeline import detect
from lerobot_openspm.types import PoseEstimate


@dataclass(frozen=True)
class Marker:
    """Found wherever it was learned."""

    name: str
    place: float
    height: float = 0.0
    yaw_period: float = 0.0
    points = np.zeros((0, 3))
    symmetry = None
    sought_again = False

    def localise(self, look):
        return PoseEstimate("found", se3.from_yaw([self.place, 0, 0], 0.0), np.eye(4), 1.0)

    def to_record(self):
        return {"kind": "marker", "name": self.name}, {"place": np.array([self.place])}


def learn_markers(examples):
    return {name: Marker(name, 0.5) for name in examples.names}


def read_marker(fields, arrays, where):
    return Marker(fields["name"], float(arrays["place"][0]))


@pytest.fixture
def marker(monkeypatch):
    for name in tuple(KINDS):
        monkeypatch.setitem(KINDS, name, replace(KINDS[name], learn=lambda examples: {}))
    monkeypatch.setitem(KINDS, "marker", Kind("marker", learn_markers, read_marker))


def test_a_new_kind_is_learned_found_and_kept(marker):
    scene = demonstration(np.random.default_rng(0))
    objects = learn_objects([scene], np.random.default_rng(0)).models
    assert objects == {name: Marker(name, 0.5) for name in ("block", "cup")}
    assert detect(scene.views, objects)["cup"].T_world_obj[0, 3] == 0.5
    assert store.from_parts(*store.to_parts(objects["cup"]), "here") == objects["cup"]


@pytest.mark.parametrize("known", [model("mug"), masked_model("mug"), box_model("mug"), patch_model("mug")])
def test_every_kind_is_written_under_a_name_of_the_table(known):
    fields, arrays = store.to_parts(known)
    assert fields["kind"] in KINDS
    assert type(store.from_parts(fields, arrays, "here")) is type(known)


def test_kinds_learn_in_turn_what_those_before_them_left(marker, monkeypatch):
    asked = {}

    def learn_cups(examples):
        asked["before"] = list(examples.names)
        return {"cup": Marker("cup", 0.1)}

    def learn_rest(examples):
        asked["after"] = list(examples.names)
        return {}

    monkeypatch.setitem(KINDS, "patches", replace(KINDS["patches"], learn=learn_cups))
    monkeypatch.setitem(KINDS, "box", replace(KINDS["box"], learn=learn_rest))
    learned = learn_objects([demonstration(np.random.default_rng(0))], np.random.default_rng(0)).models
    assert asked == {"before": ["block", "cup"], "after": ["block"]}
    assert learned["cup"] == Marker("cup", 0.1)
