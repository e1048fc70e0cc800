"""Learners say why they leave an object out."""

from dataclasses import replace

import numpy as np
import pytest
from tests.perception.drawn_world import demonstration

from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.types import DemonstrationScene, View


def scenes(n: int = 4) -> list[DemonstrationScene]:
    rng = np.random.default_rng(3)
    return [only_the_cup(demonstration(rng)) for _ in range(n)]


def only_the_cup(scene: DemonstrationScene) -> DemonstrationScene:
    return replace(scene, cues=tuple(cue for cue in scene.cues if cue.name == "cup"), film=None)


def touched_elsewhere(scene: DemonstrationScene) -> DemonstrationScene:
    """The hand touched something far outside the pictures."""
    cues = tuple(replace(cue, point_world=cue.point_world - np.array([0.0, 0.0, 50.0])) for cue in scene.cues)
    return replace(scene, cues=cues)


def grey(scene: DemonstrationScene) -> DemonstrationScene:
    """Nothing can be told from anything else."""
    return seen_as(scene, lambda view: replace(view, image=np.full_like(view.image, 120)))


def through_one_camera(scene: DemonstrationScene) -> DemonstrationScene:
    first = next(iter(scene.views))
    later = None if scene.later_views is None else {first: scene.later_views[first]}
    return replace(scene, views={first: scene.views[first]}, later_views=later)


def seen_as(scene: DemonstrationScene, change) -> DemonstrationScene:
    def changed(views: dict[str, View]) -> dict[str, View]:
        return {name: change(view) for name, view in views.items()}

    later = None if scene.later_views is None else changed(scene.later_views)
    return replace(scene, views=changed(scene.views), later_views=later)


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (touched_elsewhere, "no camera sees where the hand touched it"),
        (grey, "nothing where the hand touched it stands out from what is around it"),
        (through_one_camera, "no two cameras show it at once"),
    ],
)
def test_why_an_object_cannot_be_learned_is_said(spoil, why: str):
    learned = learn_objects([spoil(scene) for scene in scenes()], np.random.default_rng(0))
    assert learned.models == {}
    assert why in learned.left_out["cup"]


def test_nothing_is_said_of_what_is_learned():
    learned = learn_objects(scenes(), np.random.default_rng(0))
    assert set(learned.models) == {"cup"}
    assert learned.left_out == {}
